"""What the data determine and what is gauge: rank, gap, condition and observability of the scaled normal equations (METHOD.md 3).

Singular values are those of the Jacobian of robot, hand-eye and camera, everything else projected out, in scaled units
(mm, rad x 500 mm) and whitened by the noise: one over a singular value is the standard deviation in mm to which the
shots alone tell that direction. Which directions stay open, and in whose words, is `calibrate.gauge`'s.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from calibrate.camera_error import FreeCrossing
from calibrate.clouds import Solution
from calibrate.distinct_views import most_rank
from calibrate.gauge import ANGLE_SCALE_MM, OpenDirections, camera_gauge_twists, named_directions, parameter_scale
from calibrate.normal import symmetric_inverse
from calibrate.problem import Layout, Problem
from calibrate.robot_terms import RobotTerm
from drivers.kinematics.se3 import FloatArray

__all__ = [
    "ANGLE_SCALE_MM",
    "Identifiability",
    "Observability",
    "identifiability_of",
    "observability_of",
    "parameter_names",
    "parameter_scale",
]

_RELATIVE_ZERO = 1e-8
"""Of squared singular values: what the pose noise breaks of the gauge stays below it, what shots determine above."""


@dataclass(frozen=True, slots=True)
class Observability:
    """Observability indices of the determined directions (Sun and Hollerbach 2008 give all five), larger is better.

    With the singular values s_1 >= ... >= s_r of m shots (1 / mm, see the module):
    """

    o1: float
    """(s_1 ... s_r)^(1/r) / sqrt(m), Borm and Menq 1991; does not depend on the scaling of the unknowns."""
    o2: float
    """s_r / s_1, Driels and Pathre 1990."""
    o3: float
    """s_r, Nahvi, Hollerbach and Hayward 1994."""
    o4: float
    """s_r^2 / s_1, the noise amplification index of Nahvi and Hollerbach 1996."""
    o5: float
    """1 / (1/s_1 + ... + 1/s_r), Sun and Hollerbach 2008."""


def observability_of(singular_values: FloatArray, n_shots: int) -> Observability:
    """The indices of the singular values (r,), falling and positive, of so many shots; zeros where there are none."""
    if not len(singular_values) or not n_shots:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    largest, smallest = float(singular_values[0]), float(singular_values[-1])
    geometric_mean = float(np.exp(np.log(singular_values).mean()))
    o5 = float(1.0 / (1.0 / singular_values).sum())
    return Observability(geometric_mean / n_shots**0.5, smallest / largest, smallest, smallest**2 / largest, o5)


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
    observability: Observability | None = None
    """None where nobody asked."""
    directions: tuple[OpenDirections, ...] = ()
    """What the shots do not tell, in words."""

    def to_json_dict(self) -> dict[str, object]:
        """For the calibration file and `--json`."""
        return {
            "rank": self.rank,
            "expected_rank": self.expected_rank,
            "n_parameters": self.n_parameters,
            "condition": self.condition if np.isfinite(self.condition) else None,
            "gap": self.gap if np.isfinite(self.gap) else None,
            "observability": None if self.observability is None else asdict(self.observability),
            "singular_values": self.singular_values.tolist(),
            "directions": [asdict(group) for group in self.directions],
        }

    @classmethod
    def from_json_dict(cls, data: Mapping[str, object]) -> Identifiability:
        """What `to_json_dict` wrote; KeyError, TypeError or ValueError for anything else."""
        indices, groups = data["observability"], data["directions"]
        return cls(
            rank=int(str(data["rank"])),
            n_parameters=int(str(data["n_parameters"])),
            expected_rank=int(str(data["expected_rank"])),
            condition=_number(data["condition"]),
            gap=_number(data["gap"]),
            singular_values=np.asarray(data["singular_values"], dtype=np.float64),
            observability=Observability(**{key: _number(value) for key, value in indices.items()}) if isinstance(indices, Mapping) else None,
            directions=tuple(OpenDirections.from_data(group) for group in groups) if isinstance(groups, list | tuple) else (),
        )


def identifiability_of(problem: Problem, solution: Solution) -> Identifiability:
    """Look at a solution's information about its geometric unknowns, priors of these left out."""
    layout = problem.layout
    n = layout.camera.stop
    scale = parameter_scale(layout)
    values, vectors = np.linalg.eigh(_projected_information(problem, solution) / scale[:, None] / scale)
    values, vectors = values[::-1], vectors[:, ::-1]
    rank = int((values > _RELATIVE_ZERO * values[0]).sum())
    if problem.along_sight and problem.n_shots and problem.external is None:
        # repeats of a pose differ by noise: each would seem to tell a little more
        rank = min(rank, most_rank(problem))
    singular = np.sqrt(np.maximum(values, 0.0))
    return Identifiability(
        rank=rank,
        n_parameters=n,
        expected_rank=(4 * layout.n_links if layout.n_links else 6) + layout.n_camera - camera_gauge(problem) - _held_by_prior(problem),
        condition=float(singular[0] / singular[rank - 1]) if rank else float("inf"),
        gap=float(singular[rank - 1] / max(singular[rank], 1e-300)) if 0 < rank < n else float("inf"),
        singular_values=singular,
        observability=observability_of(singular[:rank], problem.n_shots),
        directions=named_directions(problem, solution.state, vectors[:, rank:], (vectors * values) @ vectors.T),
    )


def camera_gauge(problem: Problem) -> int:
    """Number of directions in which the camera error model only repeats the hand-eye transform (lateral terms turn the view)."""
    return len(camera_gauge_twists(problem))


def _held_by_prior(problem: Problem) -> int:
    """Number of camera terms that shots are not asked to tell: where a pillow's lines of sight cross says little beside its size."""
    return len(problem.camera_error.crossing_terms) if isinstance(problem.camera_error, FreeCrossing) else 0


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


def _projected_information(problem: Problem, solution: Solution) -> FloatArray:
    """(n, n) of robot, hand-eye and camera, the other unknowns projected out."""
    layout = problem.layout
    n, rest = layout.camera.stop, np.arange(layout.radius_offset.start, layout.size)
    information = _data_information(solution)
    nuisance = information[np.ix_(rest, rest)] + np.diag(_nuisance_prior(problem))
    cross = information[:n, rest]
    return np.asarray(information[:n, :n] - cross @ symmetric_inverse(nuisance) @ cross.T)


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


def _number(value: object) -> float:
    """A number of a file, where infinity is null."""
    return float("inf") if value is None else float(str(value))
