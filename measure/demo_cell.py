"""The demo's cell: what stands in it, what its cell file believes, and the hidden truth that only the simulator reads.

The robot is the paper's IRB 1410 with the errors of its Table 1, the camera has the paper's pillow error, and milder
physics is added that no calibrator of ours models. One certified 500 mm ball bar stands in three orientations
(spheres A to F); a ball plate with four spheres (G to J), which no calibration sees, stands between them for `verify`.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np

from drivers.files.disk import write_text_atomic
from drivers.files.yaml import dump_yaml
from drivers.kinematics.se3 import FloatArray

ROBOT_MODEL = "irb1410_paper"
RESOLUTION_PX = (448, 280)
TABLE_TOP_MM = 60.0
DIAMETER_MM = 38.1
DIAMETER_U_MM = 0.001
LENGTH_U_MM = 0.005
PLACED_WITHIN_MM = 2.0
"""How well the cell file knows where the spheres stand."""

_BAR_MM = 500.0
# middle and direction of the bar in its three orientations
_BARS = {("A", "B"): ((880, 0, 220), (0, 1, 0)), ("C", "D"): ((900, 60, 320), (1, 0.1, 0)), ("E", "F"): ((920, -20, 360), (-0.1, 0.55, 0.83))}
_PLATE = {"G": (720.0, -260.0, 330.0), "H": (1060.0, -190.0, 200.0), "I": (1050.0, 255.0, 480.0), "J": (740.0, 210.0, 180.0)}

CALIBRATION_SPHERES = tuple(name for pair in _BARS for name in pair)
VERIFICATION_SPHERES = tuple(_PLATE)
WORKPIECE_CENTRE_MM = (1020.0, 30.0, TABLE_TOP_MM)
WORKPIECE_SIZE_MM = (160.0, 100.0, 75.0)


def true_centres_in_base_mm() -> dict[str, FloatArray]:
    """Where the spheres truly stand."""
    centres = {}
    for (first, second), (middle, direction) in _BARS.items():
        half = np.array(direction, dtype=np.float64) / np.linalg.norm(direction) * _BAR_MM / 2
        centres[first], centres[second] = np.array(middle) - half, np.array(middle) + half
    return centres | {name: np.array(centre) for name, centre in _PLATE.items()}


def write_demo_cell(folder: Path, seed: int, resolution_px: tuple[int, int] = RESOLUTION_PX) -> Path:
    """Write truth.yaml and cell.yaml into a folder; returns the path of the cell file.

    Args:
        folder: where they go.
        seed: draws the noise, the hand-eye error and the certificates.
        resolution_px: width and height of the camera.

    Raises:
        FileError: the folder cannot be written.
    """
    rng = np.random.default_rng([seed, 500])
    _write_truth(folder / "truth.yaml", seed, resolution_px)
    path = folder / "cell.yaml"
    write_text_atomic(path, dump_yaml(_cell_data(rng)))
    return path


def _cell_data(rng: np.random.Generator) -> dict[str, object]:
    from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA

    centres = true_centres_in_base_mm()
    certificate = "demo: the true value and an error drawn within its uncertainty"
    return {
        "format": "spherecal-cell/1",
        "name": "demo",
        "robot": {"driver": "simulated", "model": ROBOT_MODEL, "truth": "truth.yaml"},
        "camera": {
            "driver": "simulated",
            "kind": "area",
            "working_range_mm": [250, 450],
            "field_of_view_deg": [55, 36],
            "sight_crossing_mm": [60, 0, 500],
        },
        "flange_from_camera": [list(row) for row in PAPER_FLANGE_FROM_CAMERA],
        "spheres": {
            name: {
                "diameter_mm": DIAMETER_MM,
                "expanded_uncertainty_mm": DIAMETER_U_MM,
                "centre_in_base_mm": [round(float(x), 1) for x in centre + rng.uniform(-1, 1, 3) * PLACED_WITHIN_MM],
                "certificate": certificate,
            }
            for name, centre in centres.items()
        },
        "lengths": _lengths(centres, rng),
        "limits": {"centre_rms_mm": 0.2, "length_error_mm": 0.2, "diameter_error_mm": 0.2, "form_mm": 0.4},
        "work_volume_mm": [[650, -300, 100], [1150, 300, 600]],
        "obstacles": [{"name": "table", "kind": "box", "centre_in_base_mm": [900, 0, TABLE_TOP_MM - 20], "size_mm": [1200, 1600, 40]}],
        "motion": {"speed_rad_s": 0.5, "settle_s": 0.5, "frames": 1},
        "identity": {"robot_serial": "simulated", "camera_serial": "simulated"},
    }


def _lengths(centres: dict[str, FloatArray], rng: np.random.Generator) -> list[dict[str, object]]:
    bar_error_mm = float(rng.normal(0, LENGTH_U_MM / 2))  # one bar, one certificate, three orientations
    errors_mm = dict.fromkeys(_BARS, bar_error_mm) | {pair: float(rng.normal(0, LENGTH_U_MM / 2)) for pair in combinations(_PLATE, 2)}
    return [
        {
            "between": list(pair),
            "length_mm": round(float(np.linalg.norm(centres[pair[0]] - centres[pair[1]])) + error_mm, 4),
            "expanded_uncertainty_mm": LENGTH_U_MM,
        }
        for pair, error_mm in errors_mm.items()
    ]


def _write_truth(path: Path, seed: int, resolution_px: tuple[int, int]) -> None:
    from drivers.kinematics import se3
    from drivers.models import load_robot_model
    from drivers.simulated.draws import paper_truth, post, table, transform_rows
    from drivers.simulated.truth import SphereTruth, WorkpieceTruth
    from drivers.simulated.truth_file import write_truth

    spheres = {
        name: SphereTruth((float(c[0]), float(c[1]), float(c[2])), DIAMETER_MM, optical_offset_mm=0.01)
        for name, c in true_centres_in_base_mm().items()
    }
    turned = se3.exp_so3([0.0, 0.0, 0.35])
    truth = paper_truth(
        load_robot_model(ROBOT_MODEL),
        seed=seed,
        spheres=spheres,
        boxes=(table(TABLE_TOP_MM), *(post(sphere, TABLE_TOP_MM) for sphere in spheres.values())),
        workpiece=WorkpieceTruth(transform_rows(se3.from_rotation_translation(turned, WORKPIECE_CENTRE_MM))),
        resolution_px=resolution_px,
    )
    write_truth(truth, path)
