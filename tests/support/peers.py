"""Our solvers and those of peers on the same data sets, each peer in an environment of its own.

figaroh brings pinocchio and pybotics holds numpy below 2, so neither can live beside us: they are installed with pinned
versions into `.bench-venvs/NAME` (made at first use, kept), and a script of tests/benchmarks/peers runs there on one
.npz file and answers with another. Times are the solvers' own: no process start, no import, no reading of files.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibrate.assemble import assemble, without_pose_noise
from calibrate.camera_error import CameraError, NoCameraError, PillowError, correction_in_camera_mm
from calibrate.centres import solve_centres
from calibrate.clouds import solve_clouds
from calibrate.normal import NoiseModel
from calibrate.problem import Priors, Problem, State
from calibrate.robot_terms import deflection_rad
from calibrate.solve import CalibrationSettings, solve_observations
from calibrate.start import start_from_centres
from calibrate.stepwise import StepwiseSettings, solve_stepwise, stepwise_data
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from tests.support.peer_cells import DataSet, Found
from tests.support.solving import one_thread
from tests.support.source import ROOT
from tests.support.timing import best_of

ENVIRONMENTS = ROOT / ".bench-venvs"
SCRIPTS = ROOT / "tests" / "benchmarks" / "peers"
FIRST_NOISE = NoiseModel(point_mm=0.05, pose_mm=0.3, pose_rad=5e-4)
"""As `calibrate` starts."""
_INSTALL_S, _RUN_S = 600, 900


def peer_python(name: str) -> Path:
    """The interpreter of a peer's environment, installed on first use; skips the test, with the reason, where it cannot be."""
    folder, requirements = ENVIRONMENTS / name, SCRIPTS / f"{name}.txt"
    python, stamp = folder / "bin" / "python", folder / "installed"
    wanted = hashlib.sha256(requirements.read_bytes()).hexdigest()
    if stamp.exists() and stamp.read_text() == wanted:
        return python
    shutil.rmtree(folder, ignore_errors=True)
    pip: list[str | Path] = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-r", requirements]
    for command in ([sys.executable, "-m", "venv", folder], pip):
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, timeout=_INSTALL_S)
        if done.returncode:
            pytest.skip(f"{name} cannot be installed into {folder} (no network?): {done.stderr.strip().splitlines()[-1:]}")
    stamp.write_text(wanted)
    return python


def run_peer(name: str, data: DataSet, folder: Path, **settings: object) -> list[Found]:
    """One peer on one data set; `settings` go to its script (see there). figaroh answers once per outlier threshold."""
    task, answer = folder / "task.npz", folder / "answer.npz"
    arrays: dict[str, Any] = peer_task(data) | {"settings": np.array(json.dumps(settings))}
    np.savez(task, **arrays)
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    command = [peer_python(name), SCRIPTS / f"run_{name}.py", task, answer]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_RUN_S, env=environment)
    assert done.returncode == 0, done.stderr
    with np.load(answer) as file:
        found = {key: file[key] for key in file.files}
    notes = zip(found["n_parameters"], found["evaluations"], found["excluded"], found["success"], strict=True)
    texts = [
        f"{n} parameters, {evaluations} evaluations, {excluded} shots cut{'' if done else ', stopped by the limit'}"
        for n, evaluations, excluded, done in notes
    ]
    return [
        Found(poses, seconds=float(seconds), note=text)
        for poses, seconds, text in zip(found["base_from_camera"], found["seconds"], texts, strict=True)
    ]


def peer_task(data: DataSet) -> dict[str, np.ndarray]:
    """What a peer is given: fixed-radius centres, link angles without offsets (no peer knows a coupled axis), lengths."""
    model, shots = data.model, data.train.shots
    joints = np.array([shot.joints_rad for shot in shots])
    centres = np.array([shot.centre_in_camera_mm for shot in shots])
    names = sorted({shot.sphere for shot in shots})
    sphere = np.array([names.index(shot.sphere) for shot in shots])
    in_base = se3.apply(mdh.base_from_flange(model, joints) @ data.hand_eye_guess, centres)
    lengths = data.cell.lengths
    return {
        "a_mm": model.a_mm,
        "alpha_rad": model.alpha_rad,
        "d_mm": model.d_mm,
        "theta_offset_rad": model.theta_offset_rad,
        "theta_rad": joints @ model.coupling.T,
        "test_theta_rad": data.test_joints_rad @ model.coupling.T,
        "centre_in_camera_mm": centres,
        "sphere": sphere,
        "sphere_names": np.array(names),
        "flange_from_camera": data.hand_eye_guess,
        "first_centres_mm": np.array([np.median(in_base[sphere == s], axis=0) for s in range(len(names))]),
        "length_ends": np.array([[names.index(end) for end in length.between] for length in lengths], dtype=np.int64).reshape(-1, 2),
        "length_mm": np.array([length.length_mm for length in lengths]),
        "length_sigma_mm": np.array([length.standard_uncertainty_mm for length in lengths]),
    }


def run_ours(method: str, data: DataSet, camera_error: str = "auto") -> Found:
    """`spherecal calibrate --method ...` after the spheres were found: its camera models compared, folds and all."""
    began = time.perf_counter()
    with one_thread():
        solved, _ = solve_observations(data.train, data.cell, data.model, CalibrationSettings(method=method, camera_error=camera_error))
    seconds = time.perf_counter() - began
    problem = solved.assembled.problem
    note = f"{problem.camera_error.name}, {len(solved.rejected)} shots rejected"
    return replace(found_at(data, problem, solved.solution.state), seconds=seconds, note=note)


def found_at(data: DataSet, problem: Problem, state: State) -> Found:
    """A state of ours at the test shots."""
    joints = data.test_joints_rad
    deflection = deflection_rad(problem.terms, state.terms_rad, data.model, joints) if problem.terms else None
    base_from_camera = mdh.chain(data.model, joints, state.link_twists, deflection)[:, -1] @ state.flange_from_camera
    shifts = tuple(correction_in_camera_mm(problem.camera_error, state.camera_mm, shot.points_in_camera_mm) for shot in data.test.shots)
    return Found(base_from_camera, shifts, state.radius_offset_mm)


def run_stepwise(data: DataSet) -> Found:
    """The paper's Algorithm 1 on fitted centres, as `--method stepwise` runs it, timed alone."""
    camera = PillowError(data.cell.camera.sight_crossing_mm or (60.0, 0.0, 500.0))
    shots = data.train.shots
    joints, centres = np.array([shot.joints_rad for shot in shots]), np.array([shot.centre_in_camera_mm for shot in shots])
    names = sorted({shot.sphere for shot in shots})
    sphere = np.array([names.index(shot.sphere) for shot in shots], dtype=np.int64)
    with one_thread():
        result = solve_stepwise(stepwise_data(data.model, joints, centres, sphere), data.hand_eye_guess, StepwiseSettings(camera_error=camera))
    state = result.state
    base_from_camera = mdh.chain(data.model, data.test_joints_rad, state.link_twists)[:, -1] @ state.flange_from_camera
    shifts = tuple(correction_in_camera_mm(camera, state.camera_mm, shot.points_in_camera_mm) for shot in data.test.shots)
    return Found(base_from_camera, shifts, seconds=result.seconds, note=f"pillow, {result.sweeps} sweeps")


def solve_seconds(method: str, data: DataSet, camera_error: CameraError | None = None, n_runs: int = 5) -> float:
    """Best time of first guess, solve and covariance with one camera model, no folds; run once before, to compile."""
    solve = {"centres": solve_centres, "clouds": solve_clouds}[method]
    assembled = assemble(data.train.shots, cell=data.cell, model=data.model, camera_error=camera_error or NoCameraError(), priors=Priors())
    problem = assembled.problem
    centres = np.array([shot.centre_in_camera_mm for shot in data.train.shots], dtype=np.float64)

    def whole() -> FloatArray:
        start = start_from_centres(problem, centres, data.hand_eye_guess).state
        return solve(problem, without_pose_noise(start, problem.n_scans), FIRST_NOISE).covariance

    with one_thread():
        whole()
        return best_of(n_runs, whole)
