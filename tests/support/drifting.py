"""Simulated cells that change after they were calibrated, and the eight shots of a quick check."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from acquire.poses import PoseLaw, sphere_candidates
from acquire.visibility import camera_view
from calibrate.check_design import LARGEST_TILT_RAD, CheckDesign, choose_check_poses
from calibrate.drift_causes import BOW_AT_MM, Diagnosis, causes_of, diagnose
from calibrate.drift_pairs import Together, two_causes
from calibrate.observations import SphereShot
from calibrate.quick_check import check_residuals, known_state
from calibrate.result import Calibration
from calibrate.solve import CalibrationSettings
from drivers.files.ply import encode_ply
from drivers.files.yaml import dump_yaml
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, transform_rows
from drivers.simulated.truth import SphereTruth
from tests.support.volume import DIAMETER_MM, VolumeCell, calibrated, observed, random_shots, volume_cell

STAND = ("A",)
"""Spheres of the calibration that stay where they are."""
N_SHOTS = 8
TAKEN_UTC = "2026-01-02T00:00:00Z"
CAUSES = ("hand-eye", "axis 2", "axis 3", "axis 4", "axis 5", "camera")
"""That a check must name; `axis 1`, `axis 6` and `sphere moved` are told with what they cannot be told from."""


@dataclass(frozen=True)
class CheckedCell:
    """A calibrated cell and the poses of its quick check."""

    seed: int
    volume: VolumeCell
    calibration: Calibration
    joints_rad: FloatArray
    spheres: tuple[str, ...]
    design: CheckDesign
    candidates_rad: FloatArray
    """(c, n) that the poses were chosen from."""


def checked_cell(
    seed: int,
    *,
    stand: Sequence[str] = STAND,
    n_calibration: int = 120,
    n_points: int = 500,
    n_candidates: int = 280,
    camera_error: str = "auto",
) -> CheckedCell:
    """Draw a cell whose errors are not the solver's models, calibrate it on a bar in three orientations, plan its check."""
    volume = volume_cell(seed, "bar3")
    rng = np.random.default_rng([seed, 1])
    shots = random_shots(volume, volume.spheres, n_calibration // len(volume.spheres), rng, n_points=n_points)
    calibration = calibrated(volume, shots, CalibrationSettings(camera_error))
    return planned_check(seed, volume, calibration, stand=stand, n_candidates=n_candidates)


def planned_check(
    seed: int, volume: VolumeCell, calibration: Calibration, *, stand: Sequence[str] = STAND, n_candidates: int = 280, n_shots: int = N_SHOTS
) -> CheckedCell:
    """A calibrated cell with the poses of its check."""
    rng = np.random.default_rng([seed, 2])
    joints, spheres = [], []
    for name in stand:
        centre, n = np.array(volume.cell.spheres[name].centre_in_base_mm), n_candidates // len(stand)
        view = camera_view(volume.cell.camera)
        pool = sphere_candidates(
            volume.model,
            np.array(PAPER_FLANGE_FROM_CAMERA),
            centre,
            DIAMETER_MM / 2,
            view,
            4 * n,
            rng,
            law=PoseLaw(largest_tilt_rad=LARGEST_TILT_RAD, floor_mm=-200.0),
        )
        rows = rng.permutation(len(pool.view))[:n]
        joints.append(pool.joints_rad[rows])
        spheres += [name] * len(rows)
    together = np.concatenate(joints)
    design = choose_check_poses(calibration, together, spheres, n_shots, rng, dict.fromkeys(stand, DIAMETER_MM / 2))
    return CheckedCell(seed, volume, calibration, together[design.rows], tuple(spheres[i] for i in design.rows), design, together)


def after_two(checked: CheckedCell, causes: tuple[str, str], rng: np.random.Generator, *, size: float = 1.0) -> list[SphereShot]:
    """The shots of a check after two changes; a camera that bends is not one of them."""
    volume = changed(changed(checked.volume, causes[0], rng, size), causes[1], rng, size)
    return check_shots(replace(checked, volume=volume), None, rng)


def check_shots(checked: CheckedCell, cause: str | None, rng: np.random.Generator, *, size: float = 1.0) -> list[SphereShot]:
    """The shots of a check after a change; `size` is a factor on the sizes of the issue.

    Hand-eye: 0.3 mm in a random direction; axes: 0.2 mrad on what the controller reads; camera: depth wrong by 0.1 mm at
    150 mm from the axis, on top of what was wrong before; sphere moved: 0.2 mm.
    """
    volume = changed(checked.volume, cause, rng, size)
    bow_mm = 0.1 * size * float(rng.choice([-1.0, 1.0])) if cause == "camera" else 0.0
    poses = zip(checked.joints_rad, checked.spheres, strict=True)
    return [bowed(observed(volume, name, q, rng, index=i, n_points=500), bow_mm) for i, (q, name) in enumerate(poses)]


def changed(volume: VolumeCell, cause: str | None, rng: np.random.Generator, size: float = 1.0) -> VolumeCell:
    """The same cell after something happened to it; a bow of the camera is made by `bowed`."""
    truth, model = volume.simulated.truth, volume.model
    sign = size * float(rng.choice([-1.0, 1.0]))
    if cause is None or cause == "camera":
        return volume
    if cause == "hand-eye":
        way = rng.standard_normal(3)
        bump = np.concatenate([0.3 * size * way / np.linalg.norm(way), np.zeros(3)])
        moved = se3.exp(bump) @ np.array(truth.camera.flange_from_camera)
        truth = replace(truth, camera=replace(truth.camera, flange_from_camera=transform_rows(moved)))
    elif cause.startswith("axis"):
        offset = 2e-4 * sign * model.coupling[:, int(cause.split()[1]) - 1]
        before = np.array(truth.robot.theta_error_rad or np.zeros(model.n_joints))
        truth = replace(truth, robot=replace(truth.robot, theta_error_rad=tuple(float(x) for x in before + offset)))
    else:
        way = rng.standard_normal(3)
        shift = 0.2 * size * way / np.linalg.norm(way)
        truth = replace(truth, spheres={name: _moved(sphere, shift) for name, sphere in truth.spheres.items()})
    return replace(volume, simulated=SimulatedCell(truth, model))


def bowed(shot: SphereShot, bow_mm: float) -> SphereShot:
    """A shot by a camera whose depth is wrong by so much at `BOW_AT_MM` from its axis."""
    points = shot.points_in_camera_mm.copy()
    points[:, 2] += bow_mm * (points[:, 0] ** 2 + points[:, 1] ** 2) / BOW_AT_MM**2
    return replace(shot, points_in_camera_mm=points)


def diagnosis_of(checked: CheckedCell, shots: Sequence[SphereShot]) -> Diagnosis:
    """What a check says of some shots."""
    return told_of(checked, shots)[0]


def told_of(checked: CheckedCell, shots: Sequence[SphereShot]) -> tuple[Diagnosis, Together | None]:
    """The same, and whether two causes are told."""
    residuals = check_residuals(checked.calibration, shots)
    state = known_state(checked.calibration, residuals.problem.n_scans)
    causes = causes_of(residuals, state, tuple(checked.calibration.sphere_centres_in_base_mm))
    diagnosis = diagnose(residuals, causes)
    return diagnosis, two_causes(residuals, causes, diagnosis)


def _moved(sphere: SphereTruth, shift: FloatArray) -> SphereTruth:
    x, y, z = (float(c + s) for c, s in zip(sphere.centre_in_base_mm, shift, strict=True))
    return replace(sphere, centre_in_base_mm=(x, y, z))


@cache
def small_checked_cell() -> CheckedCell:
    """One cell for the quick tests: few shots, a camera model that is not chosen, few candidates."""
    return checked_cell(61_001, n_calibration=60, n_candidates=70, camera_error="affine", n_points=200)


def write_check_session(folder: Path, checked: CheckedCell, shots: Sequence[SphereShot]) -> Path:
    """Shots as a session on disk."""
    (folder / "scans").mkdir(parents=True)
    (folder / "cell.yaml").write_text(checked.volume.text, encoding="utf-8")
    head = {"format": "spherecal-session/1", "purpose": "verification", "cell": "cell.yaml", "created_utc": TAKEN_UTC, "software": "tests"}
    (folder / "session.yaml").write_text(dump_yaml(head), encoding="utf-8")
    lines = []
    for shot in shots:
        data = bytes(encode_ply(shot.points_in_camera_mm.astype(np.float32), comments=("unit mm", "frame camera")))
        scan, joints = f"scans/{shot.index:04d}.ply", np.asarray(shot.joints_rad).tolist()
        (folder / scan).write_bytes(data)
        line = {"index": shot.index, "sphere": shot.sphere, "joints_rad": joints, "base_from_flange": None, "scan": scan}
        lines.append(json.dumps(line | {"sha256": hashlib.sha256(data).hexdigest(), "time_utc": TAKEN_UTC}))
    (folder / "shots.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
