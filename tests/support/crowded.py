"""Whole sessions on disk with everything that goes wrong: clutter, flying pixels, a camera that no pillow describes, spoiled shots.

Frames are cast from a scene (table, stand, boxes, spheres of other sizes) at the robot's true pose, so that sphere finding
and gathering see what a camera would see. Which shots are spoiled, and how, is drawn from the seed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acquire.cell import cell_of_session, robot_model_of
from calibrate.observations import Observations, gather_observations
from calibrate.solve import CalibrationSettings, Solved, solve_observations
from drivers.files.ply import encode_ply
from drivers.files.session import read_session
from drivers.files.yaml import dump_yaml
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.camera import frame_points
from drivers.simulated.draws import post, table, transform_rows
from drivers.simulated.scene import nearest_hits, ray_grid
from drivers.simulated.truth import BoxTruth, CameraTruth, SphereTruth, Truth
from tests.support.bound import held_out_rms_mm
from tests.support.solving import noise_free, off_by, one_thread, problem_of
from tests.support.synthetic import SyntheticCell, bowl_ripple_mm, draw_view, paper_cell, solve_joints
from tests.support.synthetic_session import TIME, cell_data

NEIGHBOURS = ((25.4, (70.0, 35.0, -12.0)), (50.8, (-45.0, 85.0, -20.0)), (30.0, (-80.0, -60.0, -5.0)))
"""Diameters of other spheres, and where they stand from the one that counts."""


@dataclass(frozen=True)
class Taken:
    """What one shot really saw, and what was recorded of it."""

    true_base_from_flange: FloatArray
    recorded_joints_rad: FloatArray
    truth: Truth


Spoil = Callable[[SyntheticCell, Taken, np.random.Generator], Taken]


def draw_scene(cell: SyntheticCell, rng: np.random.Generator, resolution_px: tuple[int, int]) -> Truth:
    """The sphere on its stand on a table, boxes and spheres of other sizes about it; the camera still without its depth error."""
    own = SphereTruth(_triple(cell.centre_in_base_mm), 2 * cell.radius_mm)
    others = [SphereTruth(_triple(cell.centre_in_base_mm + offset), diameter) for diameter, offset in NEIGHBOURS]
    top = float(cell.centre_in_base_mm[2] - rng.uniform(60.0, 90.0))
    boxes = [table(top), *(post(sphere, top) for sphere in (own, *others))]
    for _ in range(4):
        side = rng.uniform(10.0, 40.0, 3)
        x, y = cell.centre_in_base_mm[:2] + rng.choice([-1.0, 1.0], 2) * rng.uniform(60.0, 160.0, 2)
        turned = se3.from_rotation_translation(se3.exp_so3([0, 0, rng.uniform(0, np.pi)]), [x, y, top + side[2] / 2])
        boxes.append(BoxTruth((float(side[0]), float(side[1]), float(side[2])), transform_rows(turned)))
    camera = CameraTruth(
        resolution_px=resolution_px,
        range_noise_mm=0.08,
        flying_pixel_fraction=0.5,
        incidence_limit_deg=75.0,
        incidence_softness_deg=8.0,
        invalid_fraction=0.01,
    )
    return Truth(camera=camera, spheres={"A": own, **{f"other{i}": sphere for i, sphere in enumerate(others)}}, boxes=tuple(boxes))


def frame(cell: SyntheticCell, taken: Taken, rng: np.random.Generator, flying: float = 0.05) -> FloatArray:
    """Measured points (h, w, 3) of one shot; a share `flying` of all pixels lies up to 10 mm off along its sight."""
    camera = taken.truth.camera
    grid = ray_grid(camera)
    hits = nearest_hits(taken.truth, taken.true_base_from_flange @ cell.flange_from_camera, grid)
    xyz = frame_points(camera, grid, hits, rng).astype(np.float64)
    xyz[..., 2] += cell.camera_error_mm(xyz.reshape(-1, 3)).reshape(xyz.shape[:2])
    flies = rng.random(xyz.shape[:2]) < flying
    along = xyz[flies] / np.linalg.norm(xyz[flies], axis=1, keepdims=True)
    xyz[flies] += rng.uniform(-10.0, 10.0, len(along))[:, None] * along
    return xyz


def take(cell: SyntheticCell, truth: Truth, rng: np.random.Generator) -> Taken:
    """A clean shot by METHOD.md's pose law."""
    while True:
        centre_in_camera, rotation = draw_view(rng)
        target = se3.from_rotation_translation(rotation, cell.centre_in_base_mm - rotation @ centre_in_camera) @ se3.inverse(cell.flange_from_camera)
        joints = solve_joints(cell.nominal, target, rng)
        if joints is not None:
            break
    noise = np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, 1e-4, 3)])
    return Taken(cell.true_base_from_flange(joints) @ se3.exp(noise), joints, truth)


def moved_sphere(cell: SyntheticCell, taken: Taken, rng: np.random.Generator) -> Taken:
    """Somebody touched the sphere: it stands 2 to 6 mm off."""
    own = taken.truth.spheres["A"]
    there = replace(own, centre_in_base_mm=_triple(np.array(own.centre_in_base_mm) + rng.uniform(2.0, 6.0) * _direction(rng)))
    return replace(taken, truth=replace(taken.truth, spheres={**taken.truth.spheres, "A": there}))


def wrong_joints(cell: SyntheticCell, taken: Taken, rng: np.random.Generator) -> Taken:
    """The axis angles of a moment before or after: every axis up to a degree off."""
    return replace(taken, recorded_joints_rad=taken.recorded_joints_rad + rng.uniform(-1.0, 1.0, 6) * np.radians(1.0))


def wrong_object(cell: SyntheticCell, taken: Taken, rng: np.random.Generator) -> Taken:
    """In the sphere's place, some mm off, a ball 2 mm larger, half of it behind a board."""
    own = taken.truth.spheres["A"]
    centre = np.array(own.centre_in_base_mm) + 5.0 * _direction(rng)
    ball = SphereTruth(_triple(centre), own.diameter_mm + 2.0)
    base_from_camera = taken.true_base_from_flange @ cell.flange_from_camera
    towards = base_from_camera[:3, 3] - centre
    across = base_from_camera[:3, 0]
    board = centre + 45.0 * towards / np.linalg.norm(towards) + rng.choice([-1.0, 1.0]) * 20.0 * across
    at = se3.from_rotation_translation(base_from_camera[:3, :3], board)
    boxes = (*taken.truth.boxes, BoxTruth((40.0, 80.0, 4.0), transform_rows(at)))
    return replace(taken, truth=replace(taken.truth, spheres={**taken.truth.spheres, "A": ball}, boxes=boxes))


def bumped_robot(cell: SyntheticCell, taken: Taken, rng: np.random.Generator) -> Taken:
    """Somebody leaned on the arm: the flange 1.5 to 4 mm and 3 mrad from where its axes say."""
    bump = np.concatenate([rng.uniform(1.5, 4.0) * _direction(rng), 3e-3 * _direction(rng)])
    return replace(taken, true_base_from_flange=taken.true_base_from_flange @ se3.exp(bump))


SPOILS: Mapping[str, Spoil] = {f.__name__: f for f in (moved_sphere, wrong_joints, wrong_object, bumped_robot)}


@dataclass(frozen=True)
class CrowdedSession:
    """A session on disk and the truth about it."""

    folder: Path
    cell: SyntheticCell
    spoiled: Mapping[int, str]
    """How each spoiled shot is spoiled, by index."""


def write_crowded_session(
    folder: Path,
    seed: int,
    *,
    n_shots: int = 90,
    resolution_px: tuple[int, int] = (400, 250),
    camera_error_mm: Callable[[FloatArray], FloatArray] = bowl_ripple_mm,
) -> CrowdedSession:
    """A session whose shots are cast from a crowded scene, one spoiled in each way; the hand-eye guess is 2 mm and 7 mrad off."""
    rng = np.random.default_rng([seed, 90])
    cell = replace(paper_cell(), camera_error_mm=camera_error_mm)
    truth = draw_scene(cell, rng, resolution_px)
    chosen = {int(index): name for index, name in zip(rng.permutation(n_shots), SPOILS, strict=False)}
    (folder / "scans").mkdir(parents=True)
    data = cell_data(cell, ("A",), off_by(cell.flange_from_camera, rng), (), None)
    (folder / "cell.yaml").write_text(dump_yaml(data))
    head = {"format": "spherecal-session/1", "purpose": "calibration", "cell": "cell.yaml", "created_utc": TIME, "software": "tests"}
    (folder / "session.yaml").write_text(dump_yaml(head))
    lines = []
    for index in range(n_shots):
        taken = take(cell, truth, rng)
        if index in chosen:
            taken = SPOILS[chosen[index]](cell, taken, rng)
        scan = encode_ply(frame(cell, taken, rng).astype(np.float32), comments=("unit mm", "frame camera"))
        (folder / f"scans/{index:04d}.ply").write_bytes(scan)
        line = {"index": index, "sphere": "A", "joints_rad": taken.recorded_joints_rad.tolist(), "base_from_flange": None}
        lines.append(json.dumps(line | {"scan": f"scans/{index:04d}.ply", "sha256": hashlib.sha256(scan).hexdigest(), "time_utc": TIME}))
    (folder / "shots.jsonl").write_text("\n".join(lines) + "\n")
    return CrowdedSession(folder, cell, chosen)


@dataclass(frozen=True)
class CrowdedResult:
    """One crowded session, solved with several camera models."""

    solved: Mapping[str, Solved]
    rms_mm: Mapping[str, float]
    """Held-out centre rms of noise-free shots by camera error model."""
    missed: tuple[str, ...]
    """Ways of spoiling that were not rejected."""
    lost: int
    """Good shots that were rejected."""
    reasons: Mapping[int, str]


def solve_crowded(session: CrowdedSession, models: tuple[str, ...], seed: int, *, n_tests: int = 60) -> CrowdedResult:
    """From the folder to held-out shots; spheres are found once for all models."""
    read = read_session(session.folder)
    cell = cell_of_session(read)
    robot = robot_model_of(cell, read)
    with one_thread():
        observations: Observations = gather_observations([read], cell=cell, model=robot)
        solved = {name: solve_observations(observations, cell, robot, CalibrationSettings(camera_error=name))[0] for name in models}
        tests = noise_free(session.cell, np.random.default_rng([seed, 91]), n_tests, n_points=200)
        rms = {}
        for name, one in solved.items():
            # the terms of the arm are held at next to nothing
            state = replace(one.solution.state, terms_rad=np.zeros(0))
            rms[name] = held_out_rms_mm(problem_of(session.cell, tests, one.assembled.problem.camera_error), state)
    reasons = {shot.index: shot.reason for shot in observations.rejected + solved[models[0]].rejected}
    missed = tuple(name for index, name in session.spoiled.items() if index not in reasons)
    return CrowdedResult(solved, rms, missed, len(set(reasons) - set(session.spoiled)), reasons)


def _direction(rng: np.random.Generator) -> FloatArray:
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
