"""From a session on disk without any first guess to held-out shots, against the first-order bound of its shots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from acquire.cell import cell_of_session, robot_model_of
from calibrate.camera_error import PillowError
from calibrate.observations import gather_observations
from calibrate.solve import CalibrationSettings, solve_observations
from drivers.files.session import read_session
from tests.support.bound import Recovery, bound_mm, held_out_rms_mm
from tests.support.solving import draw_shots, noise_free, one_thread, problem_of
from tests.support.synthetic import paper_cell
from tests.support.synthetic_session import write_session


def recover_from_nothing(folder: Path, seed: int, *, coupled: bool, n_shots: int = 100, n_points: int = 1000, n_tests: int = 60) -> Recovery:
    """METHOD.md 4's pose law and noise; the file says nothing of hand-eye or sphere, the camera error model is the true one."""
    cell, rng = paper_cell(coupled), np.random.default_rng([seed, 17])
    shots = draw_shots(cell, rng, n_shots, n_points=n_points)
    session = read_session(write_session(folder, cell, {"A": shots}, flange_from_camera=None))
    told = cell_of_session(session)
    robot = robot_model_of(told, session)
    with one_thread():
        observations = gather_observations([session], cell=told, model=robot)
        solved, _ = solve_observations(observations, told, robot, CalibrationSettings(camera_error="pillow"))
        # the terms of the arm are held at next to nothing, and this cell's arm does not yield
        state = replace(solved.solution.state, terms_rad=np.zeros(0))
        problem = problem_of(cell, shots, PillowError())
        test = problem_of(cell, noise_free(cell, rng, n_tests, n_points=n_points), PillowError())
        bound = bound_mm(problem, replace(state, pose_noise=np.zeros((n_shots, 6))), test)
        return Recovery(held_out_rms_mm(test, state), bound, solved.solution)
