"""Refinement by registration must not spoil what it never looked at: held-out features of machined parts, 100 simulated cells."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from calibrate.result import Calibration
from drivers.files.session import Session, read_scan
from drivers.kinematics import se3
from measure.fuse import FusedCloud
from measure.inspecting.geometry import distance_mm
from measure.inspecting.inspection import inspect_cloud
from measure.stitch import Stitcher, StitchSettings, scans_once
from measure.stitching.refine import Refinement, ScanSurface, refine
from tests.qualify.test_inspection import calibrated_cell
from tests.support.machined import MeasuredPart, drawn_spec, measure_part, measured_cloud, nominal_of, true_elements

FIRST_SEED = 47_000
HELD_OUT = ("large_bore", "bore_circle", "slot", "boss", "boss_top")
_RADIUS_MM = {"large_bore": 21.0, "slot": 26.0, "boss": 15.0}
"""About the axes of held-out features, rims included."""
PAIRS = [("large_bore", "slot"), ("slot", "boss"), ("large_bore", "boss")]
ALLOWED_MM = 0.005
_FOUND_MM = 0.4


def fused_cloud(
    calibration: Calibration, session: Session, *, refinement: Refinement | None = None, collect: bool = False
) -> tuple[FusedCloud, Sequence[ScanSurface]]:
    motions = None if refinement is None else refinement.motions
    stitcher = Stitcher(calibration, session, StitchSettings(0.5, refine=collect), motions=motions)
    for shot in scans_once(session):
        stitcher.add(shot, read_scan(session, shot))
    return stitcher.grid.fused(), stitcher.surfaces


def without_held_out(surface: ScanSurface, part: MeasuredPart) -> ScanSurface:
    """What registration may see of a scan."""
    local = se3.apply(se3.inverse(part.base_from_part), surface.points_in_base_mm)
    elements = true_elements(part.part)
    seen = np.ones(len(local), dtype=np.bool_)
    for name, radius in _RADIUS_MM.items():
        seen &= np.hypot(*(local[:, :2] - elements[name].point_mm[:2]).T) > radius
    return replace(surface, points_in_base_mm=surface.points_in_base_mm[seen], normals=surface.normals[seen])


def errors_mm(part: MeasuredPart, cloud: FusedCloud) -> dict[str, float]:
    """Of sizes of the held-out features and of distances between them, which no choice of frame changes."""
    checks = [{"kind": "distance", "between": list(pair), "tolerance": 1.0} for pair in PAIRS]
    spec = drawn_spec(checks=checks, alignment={"base_from_part": part.base_from_part.tolist()})
    measured = measured_cloud(cloud.points_mm, cloud.weight.astype(np.float64), voxel_mm=0.5, sigma_mm=0.02)
    found = inspect_cloud(measured, nominal_of(part.part, 48), spec, with_map=False)
    true = true_elements(part.part)
    errors = {}
    for feature in found.features:
        if feature.coverage is not None and feature.coverage.arc_deg < 90:
            continue  # nobody would judge by it
        truths = {"diameter": true[feature.name].diameter_mm, "width": true[feature.name].width_mm, "length": true[feature.name].length_mm}
        for value in feature.values:
            truth = truths.get(value.name)
            if feature.name in HELD_OUT and truth is not None:
                errors[f"{feature.name} {value.name}"] = value.measured - truth
    for check in found.checks:
        if check.measured is not None and check.doubt is None:
            a, b = (true[name] for name in check.features)
            errors[check.name] = check.measured - distance_mm(a, b, None)
    return errors


def run(seed: int, folder: Path) -> dict[str, object]:
    """Held-out errors of one cell, before and after."""
    folder.mkdir()
    volume, calibration, rng = calibrated_cell(seed)
    part = measure_part(volume.simulated.truth, volume.model, folder, rng)
    session = part.session(folder / "session", volume.cell)
    plain, surfaces = fused_cloud(calibration, session, collect=True)
    found = refine(calibration, [without_held_out(surface, part) for surface in surfaces])
    refined, _ = fused_cloud(calibration, session, refinement=found)
    before, after = errors_mm(part, plain), errors_mm(part, refined)
    # a feature that was not found at all says nothing of refinement
    both = [name for name in sorted(before.keys() & after.keys()) if max(abs(before[name]), abs(after[name])) < _FOUND_MM]
    rms = [float(np.sqrt(np.mean([errors[name] ** 2 for name in both]))) for errors in (before, after)]
    return {
        "seed": seed,
        "pairs": found.n_pairs,
        "bounded": len(found.bounded),
        "moved_mm": max(found.shift_mm.values(), default=0.0),
        "before_mm": rms[0],
        "after_mm": rms[1],
        "figures": {name: (before[name], after[name]) for name in both},
    }


@pytest.mark.qualify
def test_held_out_features_become_worse_by_more_than_5_um_in_at_most_2_of_100(tmp_path: Path) -> None:
    pytest.importorskip("small_gicp")
    first, n_runs = int(os.environ.get("REFINEMENT_SEED", FIRST_SEED)), int(os.environ.get("REFINEMENT_RUNS", "100"))
    worse, gains = 0, []
    for seed in range(first, first + n_runs):
        told = run(seed, tmp_path / str(seed))
        shutil.rmtree(tmp_path / str(seed))
        gain = float(str(told["before_mm"])) - float(str(told["after_mm"]))
        gains.append(gain)
        worse += gain < -ALLOWED_MM
        print(json.dumps({**told, "worse": gain < -ALLOWED_MM}), flush=True)
    print(f"seeds {first} to {first + n_runs - 1}: {worse} of {n_runs} worse by more than 5 um; gain {np.mean(gains) * 1e3:+.1f} um in the mean")
    # 2 of 100 is what is meant; more than this many would be seen in 1 run of 20 of such a program
    assert worse <= binom.ppf(0.95, n_runs, 0.02)
