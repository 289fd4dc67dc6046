"""What the data determine and what is gauge: rank, gap and condition of the scaled normal equations (METHOD.md 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.clouds import Solution
from calibrate.normal import symmetric_inverse
from calibrate.problem import Layout, Problem
from calibrate.robot_terms import RobotTerm
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

ANGLE_SCALE_MM = 500.0
"""A radian counts as what it moves at this distance."""
_RELATIVE_ZERO = 1e-8
"""Of squared singular values: what the pose noise breaks of the gauge stays below it, what shots determine above."""


@dataclass(frozen=True, slots=True, eq=False)
class Identifiability:
    """Rank of robot, hand-eye and camera, everything else projected out."""

    rank: int
    n_parameters: int
    expected_rank: int
    """What a well-spread set of shots determines: 4 per axis (or 6 of a hand-eye alone), and every camera term."""
    condition: float
    """Of the Jacobian over the determined directions."""
    gap: float
    """Ratio of the weakest determined to the strongest undetermined singular value; infinite without gauge."""
    singular_values: FloatArray
    """Of the Jacobian in scaled units (mm), whitened by the noise; falling."""


def identifiability_of(problem: Problem, solution: Solution) -> Identifiability:
    """Look at a solution's information about its geometric unknowns, priors of these left out."""
    layout = problem.layout
    n = layout.camera.stop
    information = _data_information(solution)
    rest = np.arange(layout.radius_offset.start, layout.size)
    nuisance = information[np.ix_(rest, rest)] + np.diag(_nuisance_prior(problem))
    cross = information[:n, rest]
    projected = information[:n, :n] - cross @ symmetric_inverse(nuisance) @ cross.T
    scale = parameter_scale(layout)
    values = np.linalg.eigvalsh(projected / scale[:, None] / scale)[::-1]
    rank = int((values > _RELATIVE_ZERO * values[0]).sum())
    singular = np.sqrt(np.maximum(values, 0.0))
    return Identifiability(
        rank=rank,
        n_parameters=n,
        expected_rank=(4 * layout.n_links if layout.n_links else 6) + layout.n_camera - camera_gauge(problem),
        condition=float(singular[0] / singular[rank - 1]),
        gap=float(singular[rank - 1] / max(singular[rank], 1e-300)) if rank < n else float("inf"),
        singular_values=singular,
    )


def camera_gauge(problem: Problem) -> int:
    """Number of directions in which the camera error model only repeats the hand-eye transform (lateral terms turn the view)."""
    lower, upper = problem.points_in_camera_mm.min(axis=0), problem.points_in_camera_mm.max(axis=0)
    points = np.random.default_rng(3).uniform(lower, upper, (200, 3))
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (200, 3, 3)), -se3.hat(points) / ANGLE_SCALE_MM], axis=-1)
    basis, axis = problem.camera_error.basis(points), problem.camera_error.axis
    camera = np.zeros((200, 3, len(axis)))
    camera[:, axis, np.arange(len(axis))] = basis
    fields = np.concatenate([rigid, camera], axis=-1).reshape(600, -1)
    singular = np.linalg.svd(fields, compute_uv=False)
    return int(fields.shape[1] - (singular > 1e-9 * singular[0]).sum())


def parameter_scale(layout: Layout) -> FloatArray:
    """(n,) mm per unit of each geometric unknown."""
    twist = [1.0] * 3 + [ANGLE_SCALE_MM] * 3
    return np.array(twist * (layout.n_links + 1) + [1.0] * layout.n_camera)


def parameter_names(layout: Layout, terms: tuple[RobotTerm, ...], spheres: tuple[str, ...]) -> tuple[str, ...]:
    """Names of all unknowns, with their units."""
    twist = ["rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad"]
    names = [f"link{i + 1}.{part}" for i in range(layout.n_links) for part in twist]
    names += [f"hand_eye.{part}" for part in twist]
    names += [f"camera.{k}_mm" for k in range(layout.n_camera)]
    names += [f"{term.name}_rad" for term in terms]
    names += ["radius_offset_mm"]
    names += [f"sphere.{name}.radius_mm" for name in spheres]
    names += [f"sphere.{name}.{axis}_mm" for name in spheres for axis in "xyz"]
    return tuple(names)


def _data_information(solution: Solution) -> FloatArray:
    """Points and lengths alone, pose noise eliminated."""
    gain = solution.reduced.noise_inverse @ solution.linearised.cross
    flat = solution.linearised.cross.reshape(-1, gain.shape[-1])
    return np.asarray(solution.linearised.data_hessian - flat.T @ gain.reshape(flat.shape))


def _nuisance_prior(problem: Problem) -> FloatArray:
    layout = problem.layout
    precision = np.zeros(layout.size)
    precision[layout.radius_offset] = problem.priors.radius_offset_mm**-2
    precision[layout.sphere_radius] = problem.radius_sigma_mm**-2.0
    return precision[layout.radius_offset.start :]
