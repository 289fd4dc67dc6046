"""From observations to a problem, and from a problem to a part of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from calibrate.camera_error import CameraError
from calibrate.observations import SphereShot
from calibrate.problem import LengthConstraint, Priors, Problem, State
from calibrate.robot_terms import arm_terms, load_basis
from drivers.errors import DataError
from drivers.kinematics.mdh import RobotModel

_SMALLEST_RADIUS_SIGMA_MM = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Assembled:
    """A problem and what its indices stand for."""

    problem: Problem
    shots: tuple[SphereShot, ...]
    sphere_names: tuple[str, ...]

    def subset(self, keep: NDArray[np.int64], camera_error: CameraError | None = None) -> Assembled:
        """The same problem on some of its shots (indices); every sphere stays."""
        problem = subset(self.problem, keep)
        if camera_error is not None:
            problem = replace(problem, camera_error=camera_error)
        return Assembled(problem, tuple(self.shots[i] for i in keep), self.sphere_names)


def assemble(shots: Sequence[SphereShot], *, cell: Cell, model: RobotModel | None, camera_error: CameraError, priors: Priors) -> Assembled:
    """The problem of all shots; spheres in the order of their names, shots in the order given.

    Raises:
        DataError: no shots, or some with axis angles and some without.
    """
    if not shots:
        raise DataError("no shot shows a sphere", remedy="`spherecal centres` says of every shot why its sphere was refused.")
    with_joints = [shot.joints_rad is not None and model is not None for shot in shots]
    if any(with_joints) != all(with_joints):
        raise DataError("some shots have axis angles and some have not", remedy="Calibrate sessions with axis angles and pose-only sessions apart.")
    names = tuple(sorted({shot.sphere for shot in shots}))
    scans = {key: i for i, key in enumerate(dict.fromkeys((s.session, s.scan_sha256) for s in shots))}
    points = np.concatenate([shot.points_in_camera_mm for shot in shots])
    sizes = [len(shot.points_in_camera_mm) for shot in shots]
    terms = arm_terms(model) if model is not None and all(with_joints) else ()
    joints = np.array([shot.joints_rad for shot in shots], dtype=np.float64) if all(with_joints) else None
    problem = Problem(
        model=model if all(with_joints) else None,
        joints_rad=joints,
        base_from_flange=np.array([shot.base_from_flange for shot in shots]),
        scan=np.array([scans[s.session, s.scan_sha256] for s in shots], dtype=np.int64),
        sphere=np.array([names.index(s.sphere) for s in shots], dtype=np.int64),
        points_in_camera_mm=points,
        starts=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        camera_error=camera_error,
        radius_mm=np.array([cell.spheres[name].radius_mm for name in names]),
        radius_sigma_mm=np.array([max(cell.spheres[name].radius_standard_uncertainty_mm, _SMALLEST_RADIUS_SIGMA_MM) for name in names]),
        lengths=tuple(
            LengthConstraint(names.index(length.between[0]), names.index(length.between[1]), length.length_mm, length.standard_uncertainty_mm)
            for length in cell.lengths
            if length.between[0] in names and length.between[1] in names
        ),
        priors=priors,
        terms=terms,
        load=load_basis(terms, model, joints) if model is not None and joints is not None else np.zeros((len(shots), 0, 0)),
        along_sight=cell.camera.kind == "area",
    )
    return Assembled(problem, tuple(shots), names)


def subset(problem: Problem, keep: NDArray[np.int64]) -> Problem:
    """The problem on some of its shots (indices), scans numbered anew."""
    pieces = [np.arange(problem.starts[i], problem.starts[i + 1]) for i in keep]
    rows = np.concatenate(pieces) if pieces else np.zeros(0, dtype=np.int64)
    _, scan = np.unique(problem.scan[keep], return_inverse=True)
    return replace(
        problem,
        joints_rad=None if problem.joints_rad is None else problem.joints_rad[keep],
        base_from_flange=problem.base_from_flange[keep],
        load=problem.load[keep] if len(problem.load) else problem.load,
        scan=scan.astype(np.int64),
        sphere=problem.sphere[keep],
        points_in_camera_mm=problem.points_in_camera_mm[rows],
        starts=np.concatenate([[0], np.cumsum([len(p) for p in pieces])]).astype(np.int64),
    )


def without_pose_noise(state: State, n_scans: int) -> State:
    """The state for other shots, whose pose noise is unknown."""
    return replace(state, pose_noise=np.zeros((n_scans, 6)))
