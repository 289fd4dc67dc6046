"""The way of the paper's peers, as a reference: a joint analytic solve on fixed-radius centres, the radius held.

Gauss-Newton over link twists, hand-eye transform, camera error and sphere centres, with certified lengths and weak priors;
every shot is its fitted centre, each as good as any other, and the camera correction moves the centre alone. All that is
left out is what this repository claims to gain by: correction of points, an optical radius, a model of the pose noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.assemble import assemble
from calibrate.camera_error import CameraError, camera_error_models, correction_in_camera_mm
from calibrate.observations import Observations
from calibrate.problem import Priors, Problem, State, linearise_geometry
from calibrate.start import start_from_centres
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from tests.support.volume import VolumeCell

_ROUNDS = 12


@dataclass(frozen=True)
class AnalyticSolution:
    """Where the solve ended."""

    problem: Problem
    state: State
    sigma_mm: float
    """Of one component of a centre, from the residuals."""

    def centres_in_base_mm(self, observations: Observations) -> dict[str, FloatArray]:
        """(3,) of each sphere: the mean over its shots' centres, corrected as centres, in the solver's base."""
        found: dict[str, list[FloatArray]] = {}
        for shot in observations.shots:
            assert self.problem.model is not None
            assert shot.joints_rad is not None
            assert shot.centre_in_camera_mm is not None
            flange = mdh.base_from_flange(self.problem.model, shot.joints_rad, self.state.link_twists)
            centre = shot.centre_in_camera_mm[None]
            corrected = centre + correction_in_camera_mm(self.problem.camera_error, self.state.camera_mm, centre)
            found.setdefault(shot.sphere, []).append(se3.apply(flange @ self.state.flange_from_camera, corrected)[0])
        return {name: np.mean(members, axis=0) for name, members in found.items()}


def solve_analytic(problem: Problem, centres_in_camera_mm: FloatArray, guess: FloatArray) -> AnalyticSolution:
    """Least squares on centres (m, 3), from a first guess (4, 4) of flange_from_camera."""
    state = start_from_centres(problem, centres_in_camera_mm, guess).state
    layout, sigma_mm = problem.layout, 0.1
    used = np.r_[layout.links, layout.hand_eye, layout.camera, layout.centres]
    shift = _shift_at(problem.camera_error, centres_in_camera_mm)
    for _ in range(_ROUNDS):
        geometry = linearise_geometry(problem, state)
        columns = geometry.columns[:, :3].copy()
        columns[:, :, layout.camera] = shift
        miss = centres_in_camera_mm + shift @ state.camera_mm - geometry.centre_in_camera_mm
        prior_rows, prior_miss = _priors(problem, state)
        length_rows, length_miss = _lengths(problem, state)
        rows = np.concatenate([columns.reshape(-1, layout.size) / sigma_mm, length_rows, prior_rows])[:, used]
        right = np.concatenate([miss.ravel() / sigma_mm, length_miss, prior_miss])
        step = np.zeros(layout.size)
        scale = np.linalg.norm(rows, axis=0)
        step[used] = -np.linalg.lstsq(rows / scale, right, rcond=1e-12)[0] / scale
        state = state.moved(layout, step, np.zeros_like(state.pose_noise))
        sigma_mm = float(np.sqrt((miss**2).sum() / (miss.size - 4 * layout.n_links - layout.n_camera - 3)))
    return AnalyticSolution(problem, state, sigma_mm)


def _shift_at(camera_error: CameraError, centres: FloatArray) -> FloatArray:
    """(m, 3, k): motion of a centre per camera coefficient."""
    basis = camera_error.basis(centres)
    result = np.zeros((len(centres), 3, basis.shape[1]))
    result[:, camera_error.axis, np.arange(basis.shape[1])] = basis
    return result


def _priors(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    layout, priors = problem.layout, problem.priors
    sigma, value = np.full(layout.size, np.inf), np.zeros(layout.size)
    sigma[layout.links] = np.tile([priors.link_rho_mm] * 3 + [priors.link_phi_rad] * 3, layout.n_links)
    value[layout.links] = state.link_twists.ravel()
    sigma[layout.camera] = problem.camera_error.prior_sigma_mm
    value[layout.camera] = state.camera_mm
    return np.diag(1.0 / sigma), value / sigma


def _lengths(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    rows, miss = np.zeros((len(problem.lengths), problem.layout.size)), np.zeros(len(problem.lengths))
    for i, length in enumerate(problem.lengths):
        way = state.centres_in_base_mm[length.first] - state.centres_in_base_mm[length.second]
        distance = float(np.linalg.norm(way))
        for index, sign in ((length.first, 1.0), (length.second, -1.0)):
            start = problem.layout.centres.start + 3 * index
            rows[i, start : start + 3] = sign * way / distance / length.sigma_mm
        miss[i] = (distance - length.length_mm) / length.sigma_mm
    return rows, miss


def solve_analytic_on(volume: VolumeCell, observations: Observations, camera_error: str, *, lengths: bool = True) -> AnalyticSolution:
    """The solve on the shots of a simulated cell; without `lengths` as the peers do it, which know none."""
    points = np.concatenate([shot.points_in_camera_mm for shot in observations.shots])
    crossing = volume.cell.camera.sight_crossing_mm or (60.0, 0.0, 500.0)
    model = camera_error_models((camera_error,), points_in_camera_mm=points, sight_crossing_mm=crossing)[0]
    problem = assemble(observations.shots, cell=volume.cell, model=volume.model, camera_error=model, priors=Priors()).problem
    centres = np.array([shot.centre_in_camera_mm for shot in observations.shots], dtype=np.float64)
    guess = volume.cell.flange_from_camera
    return solve_analytic(problem if lengths else replace(problem, lengths=()), centres, np.eye(4) if guess is None else guess)
