"""A small cell with a UR5e, once with the plain simulated robot and once with the same robot behind a controller."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from drivers.files.yaml import dump_yaml
from drivers.models import load_robot_model
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, random_truth
from drivers.simulated.truth import SphereTruth
from drivers.simulated.truth_file import write_truth

HOME_RAD = (0.0, -1.57, 1.2, -1.2, -1.57, 0.0)
DIAMETER_MM = 38.1
CENTRES_MM = {
    "A": (420.0, -150.0, 120.0),
    "B": (420.0, 150.0, 120.0),
    "C": (330.0, -60.0, 220.0),
    "D": (560.0, 60.0, 180.0),
    "G": (380.0, -100.0, 160.0),
    "H": (520.0, 90.0, 140.0),
}
_LENGTH_U_MM = 0.005


def write_cells(folder: Path, *, controller: str, resolution_px: tuple[int, int], seed: int) -> tuple[Path, Path]:
    """Cell files with the simulated robot and with the driver `ur_rtde`; the same truth, which does not drift.

    Drift goes by the clock, and the controller's clock is the real one.
    """
    rng = np.random.default_rng([seed, 30004])
    spheres = {name: SphereTruth(centre, DIAMETER_MM) for name, centre in CENTRES_MM.items()}
    truth = random_truth(load_robot_model("ur5e"), rng, spheres=spheres)
    robot = replace(truth.robot, drift_per_hour=(0.0,) * 6, home_rad=HOME_RAD, acceleration_rad_s2=10.0)
    write_truth(replace(truth, robot=robot, camera=replace(truth.camera, resolution_px=resolution_px)), folder / "truth.yaml")
    simulated = {"driver": "simulated", "truth": "truth.yaml"}
    plain = _cell({**simulated, "model": "ur5e"}, {"driver": "simulated"})
    wired = _cell({"driver": "ur_rtde", "model": "ur5e", "host": controller}, {**simulated, "controller": controller})
    paths = folder / "plain.yaml", folder / "wired.yaml"
    for path, data in zip(paths, (plain, wired), strict=True):
        path.write_text(dump_yaml(data), encoding="utf-8")
    return paths


def _cell(robot: dict[str, object], camera: dict[str, object]) -> dict[str, object]:
    return {
        "format": "spherecal-cell/1",
        "name": "ur",
        "robot": robot,
        "camera": {**camera, "kind": "area", "working_range_mm": [250, 450], "field_of_view_deg": [55, 36]},
        "flange_from_camera": [list(row) for row in PAPER_FLANGE_FROM_CAMERA],
        "spheres": {
            name: {"diameter_mm": DIAMETER_MM, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": list(centre)}
            for name, centre in CENTRES_MM.items()
        },
        "lengths": [_length(first, second) for first, second in (("A", "B"), ("C", "D"), *pairwise("GH"))],
        "limits": {"centre_rms_mm": 0.5, "length_error_mm": 0.5, "diameter_error_mm": 0.5, "form_mm": 0.8},
        "motion": {"speed_rad_s": 1.0, "settle_s": 0.05},
    }


def _length(first: str, second: str) -> dict[str, object]:
    length_mm = float(np.linalg.norm(np.subtract(CENTRES_MM[first], CENTRES_MM[second])))
    return {"between": [first, second], "length_mm": round(length_mm, 4), "expanded_uncertainty_mm": _LENGTH_U_MM}
