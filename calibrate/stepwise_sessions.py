"""`calibrate --method stepwise`: the paper's solver on recorded sessions, its result described as any other.

The paper has no uncertainty. The result's covariance is that of an efficient estimate from the same shots, multiplied by
what the held-out shots miss it by: honest in size, not in the single directions in which the descent stopped early.
Certified lengths and the radius offset are not used, shots are not rejected; the paper does neither.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from calibrate import normal
from calibrate.assemble import Assembled, assemble
from calibrate.camera_error import CameraError, NoCameraError, PillowError
from calibrate.clouds import Solution
from calibrate.normal import NoiseModel
from calibrate.observations import Observations
from calibrate.problem import Problem, State, linearise_geometry
from calibrate.solve import CalibrationSettings, Solved
from calibrate.start import initial_state, start_from_centres
from calibrate.stepwise import StepwiseSettings, points_in_base_mm, solve_stepwise, stepwise_data
from calibrate.sums import patch_sums, shot_moments
from calibrate.validation import cross_validate
from calibrate.variance import estimate_point_noise, estimate_pose_noise
from drivers.errors import SettingsError
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_DEFAULT_SIGHT_CROSSING_MM = (60.0, 0.0, 500.0)
_FIRST_NOISE = NoiseModel(point_mm=0.05, pose_mm=0.3, pose_rad=5e-4)
_NOISE_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class _Shots:
    """What the paper's solver sees of a problem: centres, in capture order."""

    problem: Problem
    centres_in_camera_mm: FloatArray
    """(m, 3)."""
    hand_eye_guess: FloatArray

    def solved(self, keep: NDArray[np.int64]) -> tuple[State, int]:
        """The state from some of the shots (rising indices), and the sweeps it took."""
        problem, camera = self.problem, self.problem.camera_error
        poses = problem.base_from_flange if problem.joints_rad is None else problem.joints_rad
        data = stepwise_data(problem.model, poses[keep], self.centres_in_camera_mm[keep], problem.sphere[keep])
        sought = camera if len(camera.axis) else None
        result = solve_stepwise(data, self.hand_eye_guess, StepwiseSettings(robot=problem.model is not None, camera_error=sought))
        in_base, sphere = points_in_base_mm(data, result.state, sought), problem.sphere[keep]
        centres = np.array([in_base[sphere == s].mean(axis=0) if (sphere == s).any() else np.zeros(3) for s in range(len(problem.radius_mm))])
        state = initial_state(problem, result.state.flange_from_camera, centres)
        twists = state.link_twists if problem.model is None else result.state.link_twists
        return replace(state, link_twists=twists, camera_mm=result.state.camera_mm), result.sweeps


def solve_stepwise_sessions(observations: Observations, cell: Cell, model: RobotModel | None, settings: CalibrationSettings) -> Solved:
    """Algorithm 1 on the fixed-radius centres of all shots, in the order of their indices.

    Raises:
        DataError: too few shots.
        SettingsError: a line-profile sensor, which shows no centres, or a camera error that is not the paper's.
    """
    if cell.camera.kind == "line_profile":
        raise SettingsError("the stepwise method needs sphere centres, and a line profile shows none", remedy="Use --method clouds.")
    assembled = assemble(observations.shots, cell=cell, model=model, camera_error=_camera_error(cell, settings), priors=settings.priors)
    # a length that the solver does not use must not make its result look better
    assembled = replace(assembled, problem=replace(assembled.problem, lengths=()))
    centres = np.array([shot.centre_in_camera_mm for shot in assembled.shots], dtype=np.float64)
    guess = cell.flange_from_camera
    if guess is None:
        guess = start_from_centres(assembled.problem, centres, None).state.flange_from_camera
    shots = _Shots(assembled.problem, centres, guess)
    state, sweeps = shots.solved(np.arange(len(centres)))
    solution = described_at(assembled.problem, state, sweeps)
    held_out = cross_validate(solution, solve=lambda keep: shots.solved(keep)[0])
    return Solved(Assembled(solution.problem, assembled.shots, assembled.sphere_names), solution, held_out, ())


def described_at(problem: Problem, state: State, passes: int) -> Solution:
    """Noise and information of a problem's shots at a state that another solver found; only pose noise is solved for."""
    noise = _FIRST_NOISE
    n_points = np.diff(problem.starts).astype(np.float64)
    for _ in range(_NOISE_ROUNDS):
        geometry = linearise_geometry(problem, state)
        noise = estimate_point_noise(patch_sums(problem, state, geometry, np.inf), noise)
        moments, counts = shot_moments(problem, state, geometry, np.inf)
        linearised = normal.linearise(problem, state, geometry, moments, noise.point_weight(n_points))
        noise = estimate_pose_noise(linearised, noise)
        reduced = normal.reduce(linearised, noise.pose_precision)
        described = Solution(problem, state, noise, linearised, reduced, geometry, moments, np.sqrt(counts[:, 1] / counts[:, 2]), passes)
        noise_step = -(reduced.noise_inverse @ reduced.noise_gradient[..., None])[..., 0]
        state = state.moved(problem.layout, np.zeros(problem.layout.size), noise_step)
    return described


def _camera_error(cell: Cell, settings: CalibrationSettings) -> CameraError:
    match settings.camera_error:
        case "auto" | "pillow":
            return PillowError(cell.camera.sight_crossing_mm or _DEFAULT_SIGHT_CROSSING_MM)
        case "none":
            return NoCameraError()
        case other:
            remedy = "Choose auto, none or pillow, or --method clouds."
            raise SettingsError(f"the stepwise method knows no camera error model {other!r}", remedy=remedy)
