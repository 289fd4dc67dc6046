"""Axis-angle/pose pairs of the ABB IRB 1410 from an offline-programming controller (source in the fixture)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drivers.kinematics.se3 import FloatArray

FIXTURE = Path(__file__).parents[2] / "fixtures" / "robots" / "irb1410_robotstudio_pairs.csv"


def pairs() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Axis angles (n, 6) in rad, flange positions (n, 3) in mm and quaternions (n, 4), w first."""
    with FIXTURE.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    table = np.array([[float(value) for value in row.values()] for row in rows])
    return np.deg2rad(table[:, 1:7]), table[:, 7:10], table[:, 10:]
