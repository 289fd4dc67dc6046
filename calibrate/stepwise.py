"""The paper's solver, Algorithm 1: one block of unknowns after the other (L. Wu et al., Sensors 2023, 23, 7447, eqs. 6-15).

    P_j = prod_i T_i(theta_i) exp(xi_i) X exp(xi_EC) (p_j + A(p_j) k)                     (6)
    f = 1/2 sum_j |P_j - P_{j+1}|²  over consecutive shots of a sphere, in capture order   (8)

Each block (xi_1 ... xi_n, xi_EC, k) is moved by one linear least-squares step of the first-order expansion, with
`exp(xi) <- exp(delta) exp(xi)`, until f no longer falls or L sweeps are done. Kept as it was printed but for two things:
every block is solved by a rank-revealing least squares (the xi_1 block is singular: its rotation and slide about axis 1
move all points alike), and k is sought in units of mm at 250 mm (the normal equations of the printed k, 1e-9 to 1e-18,
lose all digits); `PillowError.coefficients_k` gives the paper's k back. METHOD.md 3 lists what is wrong with the method.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_error import CameraError, PillowError, correction_of_basis
from calibrate.datum import twist_columns
from drivers.errors import DataError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

IntArray = NDArray[np.int64]

TWIST_SCALE = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
"""Unit of each twist component in a block: 1 mm, and 1 mrad, which moves points about as far."""
RELATIVE_ZERO = 1e-2
"""Singular values of a scaled block below this share of the largest are taken as zero.

The turn about axis 1 is no exact zero: points that do not coincide yet (millimetres of a metre) lend it some thousandths,
and noise then decides how far it goes. The weakest direction that the shots determine has a tenth.
"""
CAMERA_RELATIVE_ZERO = 1e-6
"""The same for the scaled camera terms, which are nearly parallel though none of them is a gauge."""
LEAST_SHOTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class StepwiseData:
    """What Algorithm 1 is given; m shots in capture order, n axes."""

    link_transforms: FloatArray
    """(m, n, 4, 4) nominal T_i of every shot; for a robot that is taken as it reports, its poses (m, 1, 4, 4)."""
    centres_in_camera_mm: FloatArray
    """(m, 3) fitted sphere centres."""
    pairs: IntArray
    """(p, 2) shots whose difference is taken."""

    @property
    def n_links(self) -> int:
        """Number of axes n."""
        return int(self.link_transforms.shape[1])


@dataclass(frozen=True, slots=True)
class StepwiseSettings:
    """Which errors are sought, and when to stop."""

    robot: bool = True
    hand_eye: bool = True
    camera_error: CameraError | None = None
    """The pillow of eq. 5 in the paper; None leaves the camera as it is."""
    max_sweeps: int = 1000
    """The paper's L."""
    relative_zero: float = RELATIVE_ZERO
    """Of the twist blocks."""
    least_fall: float = 1e-6
    """f counts as fallen when it is smaller by this share: near its end the descent creeps on for ever."""


@dataclass(frozen=True, slots=True, eq=False)
class StepwiseState:
    """Values of the unknowns."""

    link_errors: FloatArray
    """(n, 4, 4): exp(xi_i)."""
    hand_eye_guess: FloatArray
    """(4, 4): X."""
    hand_eye_error: FloatArray
    """(4, 4): exp(xi_EC)."""
    camera_mm: FloatArray
    """(k,) scaled coefficients."""

    @property
    def link_twists(self) -> FloatArray:
        """(n, 6): xi_i = (rho mm, phi rad)."""
        return se3.log(self.link_errors)

    @property
    def flange_from_camera(self) -> FloatArray:
        """(4, 4): X exp(xi_EC)."""
        return np.asarray(self.hand_eye_guess @ self.hand_eye_error)


@dataclass(frozen=True, slots=True, eq=False)
class StepwiseResult:
    """Where Algorithm 1 stopped."""

    state: StepwiseState
    objective_mm2: FloatArray
    """(sweeps + 1,) f at the start and after every sweep that was kept."""
    stopped_by: str
    """`f no longer falls` or `L sweeps`."""
    seconds: float
    history: tuple[StepwiseState, ...] = ()
    """States after the sweeps asked for."""

    @property
    def sweeps(self) -> int:
        """Sweeps that were kept."""
        return len(self.objective_mm2) - 1


def stepwise_data(
    model: RobotModel | None,
    poses: FloatArray,
    centres_in_camera_mm: FloatArray,
    sphere: IntArray | None = None,
) -> StepwiseData:
    """Data of shots in capture order.

    Args:
        model: nominal robot; None where poses are flange poses.
        poses: axis angles (m, n), or `base_from_flange` (m, 4, 4) without a model.
        centres_in_camera_mm: (m, 3).
        sphere: (m,) index of each shot's sphere; one sphere if None.

    Raises:
        DataError: fewer than four pairs of shots.
    """
    transforms = poses[:, None] if model is None else mdh.link_transforms(model, poses)
    pairs = consecutive_pairs(np.zeros(len(poses), dtype=np.int64) if sphere is None else sphere)
    if len(pairs) < LEAST_SHOTS:
        raise DataError(f"{len(pairs)} pairs of consecutive shots are too few to calibrate on", remedy="Take at least 20 shots of a sphere.")
    return StepwiseData(transforms, np.asarray(centres_in_camera_mm, dtype=np.float64), pairs)


def consecutive_pairs(sphere: IntArray) -> IntArray:
    """(p, 2): every shot with the next one of the same sphere."""
    pairs = [np.stack([rows[:-1], rows[1:]], axis=1) for s in np.unique(sphere) for rows in [np.flatnonzero(sphere == s)]]
    return np.concatenate(pairs).astype(np.int64)


def initial_state(data: StepwiseData, hand_eye_guess: FloatArray, camera_error: CameraError | None) -> StepwiseState:
    """All errors zero."""
    n_camera = 0 if camera_error is None else len(camera_error.axis)
    return StepwiseState(se3.identity(data.n_links), hand_eye_guess, np.eye(4), np.zeros(n_camera))


def points_in_base_mm(data: StepwiseData, state: StepwiseState, camera_error: CameraError | None) -> FloatArray:
    """(m, 3): P_j of eq. 6."""
    chain = np.eye(4)
    for i in range(data.n_links):
        chain = chain @ data.link_transforms[:, i] @ state.link_errors[i]
    return se3.apply(chain @ state.flange_from_camera, corrected_centres(data, state, camera_error))


def corrected_centres(data: StepwiseData, state: StepwiseState, camera_error: CameraError | None) -> FloatArray:
    """(m, 3): p_j + A(p_j) k."""
    centres = data.centres_in_camera_mm
    if camera_error is None:
        return centres
    return centres + correction_of_basis(camera_error, state.camera_mm, camera_error.basis(centres))


def objective_mm2(data: StepwiseData, state: StepwiseState, camera_error: CameraError | None) -> float:
    """The sum f of eq. 8."""
    difference = _differences(points_in_base_mm(data, state, camera_error), data.pairs)
    return 0.5 * float((difference**2).sum())


def solve_stepwise(
    data: StepwiseData,
    hand_eye_guess: FloatArray,
    settings: StepwiseSettings | None = None,
    *,
    keep_sweeps: Sequence[int] = (),
) -> StepwiseResult:
    """Algorithm 1. `keep_sweeps` are sweeps whose states are wanted in `history`, to watch the descent."""
    settings = settings or StepwiseSettings(camera_error=PillowError())
    began = time.perf_counter()
    state = initial_state(data, hand_eye_guess, settings.camera_error)
    falling = [objective_mm2(data, state, settings.camera_error)]
    history: list[StepwiseState] = []
    stopped_by = "L sweeps"
    for sweep in range(1, settings.max_sweeps + 1):
        trial = swept(data, state, settings)
        value = objective_mm2(data, trial, settings.camera_error)
        if not value < falling[-1] * (1 - settings.least_fall):
            stopped_by = "f no longer falls"
            break
        state = trial
        falling.append(value)
        if sweep in keep_sweeps:
            history.append(state)
    return StepwiseResult(state, np.array(falling), stopped_by, time.perf_counter() - began, tuple(history))


def swept(data: StepwiseData, state: StepwiseState, settings: StepwiseSettings) -> StepwiseState:
    """The state after one step of every block that is sought, in the paper's order."""
    centres = corrected_centres(data, state, settings.camera_error)
    before = se3.identity(len(centres))
    if settings.robot:
        errors, beyond = state.link_errors.copy(), _points_beyond_links(data, state, centres)
        for i in range(data.n_links):
            frame = before @ data.link_transforms[:, i]
            delta = _twist_step(frame, se3.apply(errors[i], beyond[i]), data.pairs, settings.relative_zero)
            errors[i] = se3.exp(delta) @ errors[i]
            before = frame @ errors[i]
        state = replace(state, link_errors=errors)
    else:
        for i in range(data.n_links):
            before = before @ data.link_transforms[:, i] @ state.link_errors[i]
    frame = before @ state.hand_eye_guess
    if settings.hand_eye:
        delta = _twist_step(frame, se3.apply(state.hand_eye_error, centres), data.pairs, settings.relative_zero)
        state = replace(state, hand_eye_error=se3.exp(delta) @ state.hand_eye_error)
    if settings.camera_error is None or not len(state.camera_mm):
        return state
    return replace(state, camera_mm=state.camera_mm + _camera_step(data, state, frame, centres, settings.camera_error))


def twist_block(frame: FloatArray, points_in_frame_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (m, 3) in the base, and their motion (m, 3, 6) per left twist in frames (m, 4, 4): eqs. 12 and 13."""
    in_base = se3.apply(frame, points_in_frame_mm)
    return in_base, twist_columns(frame, in_base)


def camera_block(frame: FloatArray, hand_eye_error: FloatArray, centres_in_camera_mm: FloatArray, camera_error: CameraError) -> FloatArray:
    """(m, 3, k): motion of the points in the base per scaled camera coefficient, H of eq. 14."""
    rotation = frame[:, :3, :3] @ hand_eye_error[:3, :3]
    basis = camera_error.basis(centres_in_camera_mm)
    return np.asarray(rotation[:, :, camera_error.axis] * basis[:, None, :])


def rank_revealing_step(columns: FloatArray, difference: FloatArray, relative_zero: float) -> FloatArray:
    """Least-norm delta (k,) that brings differences (p, 3) nearest to zero, columns (p, 3, k): eqs. 11 and 15."""
    flat = columns.reshape(-1, columns.shape[-1])
    return np.asarray(-np.linalg.lstsq(flat, difference.reshape(-1), rcond=relative_zero)[0])


def _twist_step(frame: FloatArray, points_in_frame_mm: FloatArray, pairs: IntArray, relative_zero: float) -> FloatArray:
    in_base, columns = twist_block(frame, points_in_frame_mm)
    scaled = _differences(columns, pairs) * TWIST_SCALE
    return np.asarray(rank_revealing_step(scaled, _differences(in_base, pairs), relative_zero) * TWIST_SCALE)


def _camera_step(data: StepwiseData, state: StepwiseState, frame: FloatArray, corrected: FloatArray, camera_error: CameraError) -> FloatArray:
    in_base = se3.apply(frame @ state.hand_eye_error, corrected)
    columns = camera_block(frame, state.hand_eye_error, data.centres_in_camera_mm, camera_error)
    return rank_revealing_step(_differences(columns, data.pairs), _differences(in_base, data.pairs), CAMERA_RELATIVE_ZERO)


def _points_beyond_links(data: StepwiseData, state: StepwiseState, centres: FloatArray) -> list[FloatArray]:
    """C_k of every link: the points (m, 3) in the frame that its error leads into."""
    points = se3.apply(state.flange_from_camera, centres)
    found = [points]
    for i in range(data.n_links - 1, 0, -1):
        points = se3.apply(data.link_transforms[:, i] @ state.link_errors[i], points)
        found.append(points)
    return found[::-1]


def _differences(values: FloatArray, pairs: IntArray) -> FloatArray:
    return np.asarray(values[pairs[:, 0]] - values[pairs[:, 1]])
