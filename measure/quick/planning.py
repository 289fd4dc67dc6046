"""`spherecal plan --for check`: the few poses that tell the causes of a drift apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from acquire.candidates import CandidatePool
from acquire.cell import Cell
from acquire.collision import cell_collisions
from acquire.ordering import unwound
from acquire.plan import Plan, PlannedPose
from acquire.poses import PoseLaw, sphere_candidates
from acquire.routing import route
from acquire.visibility import camera_view
from calibrate.check_design import LARGEST_TILT_RAD, CheckDesign, choose_check_poses
from calibrate.result import Calibration
from drivers.errors import DataError, SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from measure.planning import NO_WAY, PlanResult

N_POSES = 8
_CANDIDATES = 280
_DRAWN_FOR_ONE = 4
_STREAM = 4
SCAN_S = 3.0
_NOTE = "how far a change of 0.3 mm of the hand-eye, 0.2 mrad of an axis, 0.1 mm of bow stands out from other causes, in standard deviations"


def plan_check(cell: Cell, calibration: Calibration, spheres: Sequence[str], n: int = N_POSES, seed: int = 0) -> PlanResult:
    """Choose the poses of a quick check.

    Args:
        cell: robot, camera, obstacles and motion.
        calibration: that will be checked; places of spheres and hand-eye are taken from it.
        spheres: that still stand as they were calibrated; the only one if empty.
        n: how many poses.
        seed: another one draws other poses.

    Raises:
        SettingsError: a calibration without a robot model, spheres that it has not seen, or several to choose from.
        DataError: too few poses are feasible.
    """
    model = calibration.model
    if model is None:
        raise SettingsError("a check cannot be planned for a calibration without a robot model", remedy="Take the poses of the calibration again.")
    names = _standing(cell, calibration, spheres)
    rng = np.random.default_rng([seed, _STREAM])
    pools = [_pool(cell, calibration, model, name, -(-_CANDIDATES // len(names)), rng) for name in names]
    joints = np.concatenate([pool.joints_rad for pool in pools])
    if len(joints) < n:
        message = f"only {len(joints)} views of {', '.join(names)} are feasible, {n} are wanted"
        raise DataError(message, file=cell.path, remedy="Move the stand to the middle of the robot's reach, or ask for fewer poses.")
    at = [name for name, pool in zip(names, pools, strict=True) for _ in pool.view]
    radius = {name: cell.spheres[name].radius_mm for name in names}
    design = _chosen(calibration, joints.round(6), at, n, rng, radius)
    chosen = unwound(model, joints[design.rows]).round(6)
    ways = route(model, cell_collisions(cell, model), chosen)
    order = list(ways.rows)
    poses = tuple(
        PlannedPose(f"{i:03d}", at[design.rows[row]], chosen[row], vias)
        for i, (row, vias) in enumerate(zip(order, ways.via_rad, strict=True), start=1)
    )
    rejected: Counter[str] = Counter()
    for pool in pools:
        rejected.update(pool.rejected)
    rejected.update({NO_WAY: len(ways.lost)} if ways.lost else {})
    drawn = sum(pool.n_candidates for pool in pools)
    predicted = {
        "separation_sigmas": {name: round(value, 2) for name, value in design.separations.items()},
        "seconds": round(seconds_of(cell, chosen[order]), 1),
        "note": _NOTE,
    }
    return PlanResult(Plan(cell.sha256, "verification", poses, predicted), drawn, drawn - rejected.total(), dict(rejected), ways.n_one_sided)


def seconds_of(cell: Cell, joints_rad: FloatArray) -> float:
    """How long a run through axis angles (m, n) takes: the slowest axis of every way at the cell's speed, settling, 3 s a scan."""
    ways = np.abs(np.diff(joints_rad, axis=0)).max(axis=1).sum() / cell.motion.speed_rad_s
    return float(ways + len(joints_rad) * (cell.motion.settle_s + SCAN_S))


def _chosen(
    calibration: Calibration, joints: FloatArray, at: Sequence[str], n: int, rng: np.random.Generator, radius: dict[str, float]
) -> CheckDesign:
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        return choose_check_poses(calibration, joints, at, n, rng, radius)


def _standing(cell: Cell, calibration: Calibration, wanted: Sequence[str]) -> tuple[str, ...]:
    known = [name for name in calibration.sphere_centres_in_base_mm if name in cell.spheres]
    if unknown := [name for name in wanted if name not in known]:
        raise SettingsError(
            f"sphere {unknown[0]!r} is not one of the calibration and the cell", where="--sphere", remedy=f"Choose of: {', '.join(known)}."
        )
    if wanted:
        return tuple(dict.fromkeys(wanted))
    if len(known) != 1:
        remedy = "Name those that have not been moved since, with --sphere NAME."
        raise SettingsError(
            f"the calibration saw the spheres {', '.join(known) or 'of no cell'}: which still stand as they did?", where="--sphere", remedy=remedy
        )
    return tuple(known)


def _pool(cell: Cell, calibration: Calibration, model: RobotModel, name: str, n: int, rng: np.random.Generator) -> CandidatePool:
    """Some feasible views of a sphere where the calibration has it, fewer than all: the search grows with their number."""
    pool = sphere_candidates(
        model,
        calibration.flange_from_camera,
        calibration.sphere_centres_in_base_mm[name],
        cell.spheres[name].radius_mm,
        camera_view(cell.camera),
        _DRAWN_FOR_ONE * n,
        rng,
        law=PoseLaw(largest_tilt_rad=LARGEST_TILT_RAD),
        blocked=cell_collisions(cell, model),
    )
    return pool.take(np.sort(rng.permutation(len(pool.view))[:n]))
