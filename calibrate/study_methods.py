"""The methods that the study compares: the paper's 1 to 4 (Table 3), a joint Gauss-Newton solve, whole clouds."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from calibrate import stepwise_dh
from calibrate.camera_error import CameraError, NoCameraError, PillowError, correction_in_camera_mm
from calibrate.clouds import solve_clouds
from calibrate.normal import NoiseModel
from calibrate.problem import Problem, State
from calibrate.start import start_from_centres
from calibrate.stepwise import StepwiseSettings, solve_stepwise, stepwise_data
from calibrate.study_cell import SIGHT_CROSSING_MM, StudyCell, StudyShots, fitted_centres
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

PILLOW = PillowError(SIGHT_CROSSING_MM)
_FIRST_NOISE = NoiseModel(point_mm=0.1, pose_mm=2.0, pose_rad=3e-3)

LABELS: Mapping[str, str] = MappingProxyType(
    {
        "1": "1 all (stepwise)",
        "2": "2 robot + hand-eye (stepwise)",
        "3": "3 none",
        "4": "4 robot + hand-eye (D-H)",
        "4 free": "4 with its gauge left to noise",
        "joint": "all at once (Gauss-Newton)",
        "clouds": "whole clouds",
    }
)
"""Methods by key; 1 to 4 as in Table 3."""


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A calibrated chain, whatever method made it."""

    method: str
    model: RobotModel
    link_twists: FloatArray
    """(n, 6)."""
    flange_from_camera: FloatArray
    camera_error: CameraError
    camera_mm: FloatArray
    radius_offset_mm: float = 0.0
    steps: int = 0
    """Sweeps, iterations or passes."""
    seconds: float = 0.0

    def base_from_flange(self, joints_rad: FloatArray) -> FloatArray:
        """(m, 4, 4) of axis angles (m, n)."""
        return mdh.base_from_flange(self.model, joints_rad, self.link_twists)

    def corrected(self, points_in_camera_mm: FloatArray) -> FloatArray:
        """Points (..., 3) with the camera's error taken out."""
        flat = points_in_camera_mm.reshape(-1, 3)
        return np.asarray(flat + correction_in_camera_mm(self.camera_error, self.camera_mm, flat)).reshape(points_in_camera_mm.shape)

    def in_base_mm(self, joints_rad: FloatArray, points_in_camera_mm: FloatArray) -> FloatArray:
        """Points (m, 3), or clouds (m, n, 3), of shots (m, n_axes) in the base."""
        base_from_camera = self.base_from_flange(joints_rad) @ self.flange_from_camera
        extra = points_in_camera_mm.ndim - 2
        return se3.apply(base_from_camera.reshape(len(joints_rad), *[1] * extra, 4, 4), self.corrected(points_in_camera_mm))


def fit_centres(
    method: str, cell: StudyCell, joints_rad: FloatArray, centres_in_camera_mm: FloatArray, *, max_sweeps: int, relative_zero: float | None = None
) -> Fitted:
    """One of the methods that know a sphere by its centre alone, on shots in capture order.

    Args:
        method: "1", "2", "3", "4", "4 free" or "joint".
        cell: for what is known before; its truth is not looked at.
        joints_rad: (m, n).
        centres_in_camera_mm: (m, 3).
        max_sweeps: the paper's L.
        relative_zero: rank tolerance of the twist blocks, or of the D-H system; the method's own if None.
    """
    guess, none = cell.flange_from_camera_guess, np.zeros((cell.nominal.n_joints, 6))
    began = time.perf_counter()
    if method == "3":
        return Fitted(method, cell.nominal, none, guess, NoCameraError(), np.zeros(0))
    if method in {"4", "4 free"}:
        cut = relative_zero or (stepwise_dh.RANK_REVEALING if method == "4" else stepwise_dh.GAUGE_LEFT_TO_NOISE)
        dh = stepwise_dh.solve_linearised_dh(cell.nominal, joints_rad, centres_in_camera_mm, guess, relative_zero=cut)
        return Fitted(method, dh.model, none, dh.flange_from_camera, NoCameraError(), np.zeros(0), 0.0, dh.iterations, time.perf_counter() - began)
    if method == "joint":
        problem = problem_of(cell, joints_rad, np.zeros((len(joints_rad), 0, 3)))
        start = start_from_centres(problem, centres_in_camera_mm, guess)
        return _of_state(method, cell, start.state, 0, time.perf_counter() - began)
    camera = PILLOW if method == "1" else None
    settings = StepwiseSettings(camera_error=camera, max_sweeps=max_sweeps)
    if relative_zero is not None:
        settings = StepwiseSettings(camera_error=camera, max_sweeps=max_sweeps, relative_zero=relative_zero)
    solved = solve_stepwise(stepwise_data(cell.nominal, joints_rad, centres_in_camera_mm), guess, settings)
    state, model = solved.state, camera or NoCameraError()
    return Fitted(method, cell.nominal, state.link_twists, state.flange_from_camera, model, state.camera_mm, 0.0, solved.sweeps, solved.seconds)


def fit_clouds(cell: StudyCell, shots: StudyShots) -> Fitted:
    """The whole-cloud solve of this package, pillow model."""
    began = time.perf_counter()
    problem = problem_of(cell, shots.joints_rad, shots.clouds_in_camera_mm)
    centres, _ = fitted_centres(shots, cell.radius_mm, free_radius=False)
    start = start_from_centres(problem, centres, cell.flange_from_camera_guess)
    solution = solve_clouds(problem, start.state, _FIRST_NOISE)
    return _of_state("clouds", cell, solution.state, solution.passes, time.perf_counter() - began)


def problem_of(cell: StudyCell, joints_rad: FloatArray, clouds_in_camera_mm: FloatArray) -> Problem:
    """The whole-cloud problem of shots (m, n_axes) with clouds (m, n, 3) of one sphere; n may be 0."""
    m, n_points = clouds_in_camera_mm.shape[:2]
    points = np.ascontiguousarray(clouds_in_camera_mm.reshape(-1, 3))
    return Problem(
        model=cell.nominal,
        joints_rad=joints_rad,
        base_from_flange=mdh.base_from_flange(cell.nominal, joints_rad),
        scan=np.arange(m),
        sphere=np.zeros(m, dtype=np.int64),
        points_in_camera_mm=points,
        starts=(np.arange(m + 1) * n_points).astype(np.int64),
        camera_error=PILLOW,
        radius_mm=np.array([cell.radius_mm]),
        radius_sigma_mm=np.array([0.00025]),
    )


def centres_seen(fitted: Fitted, cell: StudyCell, shots: StudyShots, source: str) -> FloatArray:
    """Sphere centres (m, 3) in the base as a calibrated chain measures them.

    Args:
        fitted: the chain.
        cell: for the certified radius.
        shots: what to measure.
        source: "given" for the paper's simulated centres, "free" or "fixed" for spheres fitted to the clouds as
            measured and corrected afterwards, "points" for spheres fitted to corrected points.
    """
    if source == "points":
        corrected = replace(shots, clouds_in_camera_mm=fitted.corrected(shots.clouds_in_camera_mm))
        centres, _ = fitted_centres(corrected, cell.radius_mm + fitted.radius_offset_mm, free_radius=False)
        return se3.apply(fitted.base_from_flange(shots.joints_rad) @ fitted.flange_from_camera, centres)
    if source == "given":
        return fitted.in_base_mm(shots.joints_rad, shots.centre_in_camera_mm)
    centres, _ = fitted_centres(shots, cell.radius_mm, free_radius=source == "free")
    return fitted.in_base_mm(shots.joints_rad, centres)


def _of_state(method: str, cell: StudyCell, state: State, steps: int, seconds: float) -> Fitted:
    return Fitted(method, cell.nominal, state.link_twists, state.flange_from_camera, PILLOW, state.camera_mm, state.radius_offset_mm, steps, seconds)
