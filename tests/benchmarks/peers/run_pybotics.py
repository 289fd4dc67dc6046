"""pybotics' kinematic chain under scipy's least squares, with a residual written by hand: `python run_pybotics.py task.npz answer.npz`.

pybotics has no notion of a sphere seen by a camera on the flange, so only `Robot.fk` and `OptimizationHandler` are used:
24 MDH parameters, the tool vector as hand-eye transform, and the spheres' places, all free, as a user would write it.
Nothing holds the gauge, so that scipy, once at the noise floor, may go on along it for minutes: `max_nfev` bounds the
iterations (each costs one run of the chain per parameter and shot).
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
from pybotics.geometry import matrix_2_vector  # type: ignore[import-not-found]
from pybotics.optimization import OptimizationHandler  # type: ignore[import-not-found]
from pybotics.robot import Robot  # type: ignore[import-not-found]
from pybotics.tool import Tool  # type: ignore[import-not-found]
from scipy.optimize import least_squares

NOISE_MM = 0.1
"""Weight of a measured coordinate against a certified length."""


def handler_of(task: dict[str, Any]) -> Any:
    """Robot and camera of a task, all parameters free."""
    links = np.stack([task["alpha_rad"], task["a_mm"], task["theta_offset_rad"], task["d_mm"]], axis=1)
    robot = Robot.from_parameters(links.ravel())
    robot.tool = Tool()
    robot.tool.vector = matrix_2_vector(task["flange_from_camera"])
    return OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=True, world_mask=False)


def residual(vector: Any, task: dict[str, Any], handler: Any) -> Any:
    """(3 m + lengths,) of points in the base from their sphere, mm, and of certified lengths."""
    n_spheres = len(task["sphere_names"])
    handler.apply_optimization_vector(vector[: -3 * n_spheres])
    centres = vector[-3 * n_spheres :].reshape(-1, 3)
    poses = [handler.robot.fk(q) for q in task["theta_rad"]]
    points = [pose[:3, :3] @ p + pose[:3, 3] for pose, p in zip(poses, task["centre_in_camera_mm"], strict=True)]
    ends = task["length_ends"].reshape(-1, 2)
    lengths = np.linalg.norm(centres[ends[:, 0]] - centres[ends[:, 1]], axis=1)
    rows = (lengths - task["length_mm"]) * NOISE_MM / task["length_sigma_mm"]
    return np.concatenate([(np.array(points) - centres[task["sphere"]]).ravel(), rows])


def main() -> None:
    data = np.load(sys.argv[1])
    task: dict[str, Any] = {name: data[name] for name in data.files if name != "settings"} | json.loads(str(data["settings"]))
    handler = handler_of(task)
    start = np.concatenate([handler.generate_optimization_vector(), task["first_centres_mm"].ravel()])
    began = time.perf_counter()
    result = least_squares(residual, start, max_nfev=task.get("max_nfev"), args=(task, handler))
    seconds = time.perf_counter() - began
    handler.apply_optimization_vector(result.x[: -3 * len(task["sphere_names"])])
    np.savez(
        sys.argv[2],
        base_from_camera=np.array([[handler.robot.fk(q) for q in task["test_theta_rad"]]]),
        seconds=[seconds],
        n_parameters=[len(result.x)],
        evaluations=[int(result.nfev)],
        success=[bool(result.success)],
        excluded=[0],
    )


if __name__ == "__main__":
    main()
