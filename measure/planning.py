"""From a cell to a plan: feasible views of each sphere or of a region, a choice among them, an order with little travel.

Calibration poses are those that tell most about lengths in the work volume (`calibrate.design`); verification poses are
spread evenly, so that they judge and do not repeat what the design found convenient.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from acquire.cell import Cell, robot_model_of
from acquire.collision import CollisionCheck, cell_collisions
from acquire.obstacles import MeshObstacle
from acquire.ordering import choose_spread, unwound
from acquire.plan import Plan, PlannedPose, with_part
from acquire.poses import DEFAULT_LAW, CandidatePool, sphere_candidates, workpiece_poses
from acquire.routing import route
from acquire.visibility import CameraView, camera_view
from drivers.errors import DataError, SettingsError
from drivers.kinematics.mdh import RobotModel, within_limits
from drivers.kinematics.se3 import FloatArray
from measure.covering import Coverage, coverage_of, part_pool

if TYPE_CHECKING:
    from calibrate.design_shots import Expectation

Purpose: TypeAlias = Literal["calibration", "verification", "workpiece"]

CANDIDATES_PER_POSE = 12
FEWEST_CANDIDATES = 200
MOST_DESIGNED_FROM = 1500
"""Candidates that the design looks at: more make it slower and hardly better."""
NO_WAY = "no way"
"""Of a chosen pose to which no clear way was found."""
_NOTE = "one sigma, first order; unmodelled physics of usual size is included, a damaged robot or camera is not"

# Plans for different purposes are drawn from different streams: a verification that repeats the poses of the
# calibration would prove nothing.
_STREAM: Mapping[Purpose, int] = {"calibration": 1, "verification": 2, "workpiece": 3}


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """What is to be planned."""

    purpose: Purpose = "calibration"
    n_poses: int = 40
    spheres: tuple[str, ...] = ()
    """All spheres of known place if empty."""
    region_mm: FloatArray | None = None
    """(2, 3) box in the base that workpiece poses cover; the cell's work volume if None."""
    part: MeshObstacle | None = None
    """Whose surface workpiece poses cover, instead of a box."""
    seed: int = 0
    start_rad: FloatArray | None = None
    """(n,) where the robot stands before the run; None if nobody knows."""
    expectation: Expectation | None = None
    """What shots are like, e.g. of an earlier calibration; stated defaults if None. For calibrations."""
    away_from_rad: FloatArray | None = None
    """(m, n) poses of a calibration, which its verification keeps away from."""


@dataclass(frozen=True, slots=True)
class Lengths:
    """What lengths a verification will see."""

    longest_mm: float
    """Between two spheres of the plan, by their places in the cell file."""
    diagonal_mm: float | None
    """Of the work volume, None where the cell has none."""

    @property
    def wanted_mm(self) -> float | None:
        """Two thirds of the diagonal: shorter lengths say little of the volume's ends."""
        return None if self.diagonal_mm is None else 2 / 3 * self.diagonal_mm


@dataclass(frozen=True, slots=True, eq=False)
class PlanResult:
    """A plan, and what became of the candidates."""

    plan: Plan
    n_candidates: int
    n_feasible: int
    rejected: Mapping[str, int] = field(default_factory=dict)
    n_one_sided: int = 0
    """Poses that are reached by turning every axis forwards."""
    coverage: Coverage | None = None
    """Of the part, where there is one."""
    lengths: Lengths | None = None
    """Of a verification."""

    def to_json_dict(self) -> Mapping[str, object]:
        """What `spherecal plan --json` prints; predictions are null but for calibrations."""
        return {
            "n_candidates": self.n_candidates,
            "n_feasible": self.n_feasible,
            "rejected": self.rejected,
            "poses": [{"id": p.id, "sphere": p.sphere, "joints_rad": p.joints_rad, "via_rad": p.via_rad} for p in self.plan.poses],
            "n_one_sided": self.n_one_sided,
            **({} if self.coverage is None else {"coverage": self.coverage.to_json_dict()}),
            **({} if self.lengths is None else {"longest_length_mm": self.lengths.longest_mm, "wanted_length_mm": self.lengths.wanted_mm}),
            "predicted": {"centre_rms_mm": None, "length_rms_mm": None} | {k: v for k, v in self.plan.predicted.items() if k != "coverage"},
        }


def make_plan(cell: Cell, settings: PlanSettings) -> PlanResult:
    """Plan the poses of a run.

    Raises:
        SettingsError: the cell lacks what planning needs (robot model, hand-eye guess, camera view, places of spheres).
        DataError: too few poses are feasible.
        FileError: the robot model is missing or broken.
    """
    model, flange_from_camera = needed_of(cell)
    _check_start(settings.start_rad, model)
    if settings.purpose == "workpiece" and settings.part is not None:
        return _covering(cell, settings, settings.part, model, flange_from_camera)
    rng = np.random.default_rng([settings.seed, _STREAM[settings.purpose]])
    view, check = camera_view(cell.camera), cell_collisions(cell, model)
    pools: list[tuple[str | None, CandidatePool]] = []
    if settings.purpose == "workpiece":
        pools.append((None, _workpiece_pool(cell, settings, model, flange_from_camera, view, check, rng)))
    else:
        spheres = _spheres(cell, settings.spheres)
        for name, n in zip(spheres, _shared_out(settings.n_poses, len(spheres)), strict=True):
            pool = _sphere_pool(cell, name, n, model, flange_from_camera, view, check, rng)
            pools.append((name, pool if settings.purpose == "calibration" else pool.take(choose_spread(pool, n, rng, settings.away_from_rad))))
    if settings.purpose == "calibration":
        return _result(cell, settings, model, check, *_designed(cell, model, pools, settings, rng))
    result = _result(cell, settings, model, check, pools)
    return replace(result, lengths=_lengths(cell, result.plan)) if settings.purpose == "verification" else result


def _lengths(cell: Cell, plan: Plan) -> Lengths | None:
    """The longest distance between spheres that a plan looks at, against the work volume's diagonal."""
    names = sorted({pose.sphere for pose in plan.poses if pose.sphere is not None})
    centres = np.array([cell.spheres[name].centre_in_base_mm for name in names], dtype=np.float64).reshape(-1, 3)
    box = cell.work_volume_box_mm
    longest_mm = float(np.linalg.norm(centres[:, None] - centres, axis=-1).max(initial=0.0))
    return Lengths(longest_mm, None if box is None else float(np.linalg.norm(box[1] - box[0])))


def _covering(cell: Cell, settings: PlanSettings, part: MeshObstacle, model: RobotModel, flange_from_camera: FloatArray) -> PlanResult:
    """A plan that covers a part."""
    full = with_part(cell, Plan(cell.sha256, "workpiece", (), part=part))
    rng, check = np.random.default_rng([settings.seed, _STREAM["workpiece"]]), cell_collisions(full, model)
    pool, cover = part_pool(full, part, settings.n_poses, model, flange_from_camera, camera_view(cell.camera), check, rng)
    result = _result(full, settings, model, check, [(None, pool)])
    plan = replace(result.plan, part=part)
    coverage = coverage_of(plan, cell, model, cover)
    return replace(result, plan=replace(plan, predicted={"coverage": coverage.to_json_dict()}), coverage=coverage)


def _designed(
    cell: Cell, model: RobotModel, pools: Sequence[tuple[str | None, CandidatePool]], settings: PlanSettings, rng: np.random.Generator
) -> tuple[list[tuple[str | None, CandidatePool]], Mapping[str, object]]:
    """The pools with only the poses that tell most, and what these will make of the work volume."""
    from threadpoolctl import threadpool_limits

    from calibrate.design import choose_shots
    from calibrate.design_cell import aim_of_cell, scene_of_cell

    most = max(MOST_DESIGNED_FROM, CANDIDATES_PER_POSE * settings.n_poses) // len(pools)
    fewer = [(name, pool.take(np.sort(rng.permutation(len(pool.view))[:most]))) for name, pool in pools]
    sphere = np.repeat(np.arange(len(fewer)), [len(pool.view) for _, pool in fewer])
    joints = np.concatenate([pool.joints_rad for _, pool in fewer])
    with threadpool_limits(limits=1, user_api="blas"):
        scene = scene_of_cell(cell, model, [str(name) for name, _ in fewer], expectation=settings.expectation)
        design = choose_shots(scene, aim_of_cell(cell, scene, rng), joints, sphere, settings.n_poses)
    first = np.concatenate([[0], np.cumsum([len(pool.view) for _, pool in fewer])])
    chosen = [(name, pool.take(np.sort(design.rows[sphere[design.rows] == i]) - first[i])) for i, (name, pool) in enumerate(fewer)]
    return chosen, design.predicted.to_json_dict() | {"note": _NOTE}


def _result(
    cell: Cell,
    settings: PlanSettings,
    model: RobotModel,
    check: CollisionCheck,
    pools: Sequence[tuple[str | None, CandidatePool]],
    predicted: Mapping[str, object] | None = None,
) -> PlanResult:
    names = [name for name, pool in pools for _ in pool.view]
    joints = unwound(model, np.concatenate([pool.joints_rad for _, pool in pools])).round(6)
    ways = route(model, check, joints, start_rad=settings.start_rad)
    poses = tuple(
        PlannedPose(f"{i:03d}", names[row], joints[row], vias) for i, (row, vias) in enumerate(zip(ways.rows, ways.via_rad, strict=True), start=1)
    )
    rejected: Counter[str] = Counter()
    for _, pool in pools:
        rejected.update(pool.rejected)
    if ways.lost:
        rejected[NO_WAY] += len(ways.lost)
    n_candidates = sum(pool.n_candidates for _, pool in pools)
    plan = Plan(cell.sha256, settings.purpose, poses, dict(predicted or {}))
    return PlanResult(plan, n_candidates, n_candidates - rejected.total(), dict(rejected), ways.n_one_sided)


def needed_of(cell: Cell) -> tuple[RobotModel, FloatArray]:
    """Robot model and hand-eye guess of a cell; SettingsError where it lacks one."""
    model = robot_model_of(cell)
    if model is None:
        raise SettingsError("poses cannot be planned without a robot model", file=cell.path, where="robot.model", remedy="Name a model.")
    if cell.flange_from_camera is None:
        remedy = "Give a first guess, from a drawing: a few mm and degrees are near enough."
        raise SettingsError("poses cannot be planned without a hand-eye guess", file=cell.path, where="flange_from_camera", remedy=remedy)
    return model, np.asarray(cell.flange_from_camera, dtype=np.float64)


def _check_start(start_rad: FloatArray | None, model: RobotModel) -> None:
    if start_rad is None or (len(start_rad) == model.n_joints and within_limits(model, start_rad)):
        return
    remedy = f"Give {model.n_joints} axis angles, as the controller shows them."
    raise SettingsError(f"the start is no pose of {model.name}: its axes or their limits differ", where="--start", remedy=remedy)


def _spheres(cell: Cell, wanted: Sequence[str]) -> tuple[str, ...]:
    if unknown := [name for name in wanted if name not in cell.spheres]:
        known = ", ".join(cell.spheres) or "none"
        raise SettingsError(f"there is no sphere {unknown[0]!r}", file=cell.path, where="spheres", remedy=f"Spheres of the cell: {known}.")
    placed = tuple(name for name in wanted or cell.spheres if cell.spheres[name].centre_in_base_mm is not None)
    missing = [name for name in wanted if name not in placed]
    if missing or not placed:
        where = f"spheres.{missing[0]}" if missing else "spheres"
        remedy = "Add centre_in_base_mm: [x, y, z], known to a few mm."
        raise SettingsError("no poses can be planned around a sphere of unknown place", file=cell.path, where=where, remedy=remedy)
    return placed


def _shared_out(n: int, among: int) -> list[int]:
    if n < among:
        raise SettingsError(f"{n} poses are fewer than {among} spheres", where="-n", remedy="Ask for more poses, or name fewer spheres.")
    return [n // among + (i < n % among) for i in range(among)]


def _sphere_pool(
    cell: Cell,
    name: str,
    n: int,
    model: RobotModel,
    flange_from_camera: FloatArray,
    view: CameraView,
    check: CollisionCheck,
    rng: np.random.Generator,
) -> CandidatePool:
    sphere = cell.spheres[name]
    others = [(o.centre_in_base_mm, o.radius_mm) for key, o in cell.spheres.items() if key != name and o.centre_in_base_mm is not None]
    pool = sphere_candidates(
        model,
        flange_from_camera,
        np.asarray(sphere.centre_in_base_mm, dtype=np.float64),
        sphere.radius_mm,
        view,
        max(FEWEST_CANDIDATES, CANDIDATES_PER_POSE * n),
        rng,
        other_spheres=[(np.asarray(centre), radius) for centre, radius in others],
        blocked=check,
    )
    if pool.n_feasible < n:
        reasons = ", ".join(f"{reason} {count}" for reason, count in pool.rejected.items())
        raise DataError(
            f"only {pool.n_feasible} of {pool.n_candidates} views of sphere {name} are feasible ({reasons}), {n} are wanted",
            file=cell.path,
            where=f"spheres.{name}",
            remedy="Move the sphere to the middle of the robot's reach, or ask for fewer poses.",
        )
    return pool


def _workpiece_pool(
    cell: Cell,
    settings: PlanSettings,
    model: RobotModel,
    flange_from_camera: FloatArray,
    view: CameraView,
    check: CollisionCheck,
    rng: np.random.Generator,
) -> CandidatePool:
    region = settings.region_mm if settings.region_mm is not None else cell.work_volume_box_mm
    if region is None:
        remedy = "Give --region X0 Y0 Z0 X1 Y1 Z1, or work_volume_mm in the cell file."
        raise SettingsError("no region to cover is known", file=cell.path, where="work_volume_mm", remedy=remedy)
    law = replace(DEFAULT_LAW, largest_tilt_rad=0.6)
    pool = workpiece_poses(model, flange_from_camera, view, region, settings.n_poses, rng, law=law, blocked=check)
    if len(pool.view) == 0:
        reasons = ", ".join(f"{reason} {count}" for reason, count in pool.rejected.items())
        remedy = "Name a region within the robot's reach."
        raise DataError(f"no view of the region is feasible ({reasons})", file=cell.path, where="region", remedy=remedy)
    return pool
