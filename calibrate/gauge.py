"""Which directions the shots leave open, in words: gauge that no shot can tell, what these shots miss, what priors hold.

Gauge is known from the chain itself. A link may slide along and turn about its own axis if the link before it takes
that back; the last link and the hand-eye transform are one displacement; lateral camera terms can repeat the hand-eye.
What else is open is laid beside motions that an engineer knows (the camera's orientation, the length scale, ...), and
what is left of it is named by the parameters that dominate it, after a varimax rotation (Kaiser 1958) made them few.
Everything is in scaled unknowns: mm, and rad as what they move at half a metre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calibrate.problem import Layout, Problem, State
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

ANGLE_SCALE_MM = 500.0
"""A radian counts as what it moves at this distance."""
Kind = Literal["gauge", "open", "prior"]
_INSIDE = 0.8
"""Cosine from which a known motion counts as one of the open directions."""
_TAKES_PART, _DOMINATES = 0.1, 0.35
"""Share of the largest component from which a parameter is named: of a known motion, and of any other direction."""
_MOST_UNNAMED, _MOST_WORDS = 3, 6
"""More directions are told as one group, more parameters by the links they belong to."""
_NEGLIGIBLE = 1e-6
_ROUNDS = 60
_UNNAMED = {"open": "not told apart by these shots", "prior": "told less by these shots than by what was believed before"}
_PARTS = ("shift x", "shift y", "shift z", "rotation x", "rotation y", "rotation z")
_COMPONENTS = ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad")


@dataclass(frozen=True, slots=True)
class OpenDirections:
    """Directions of like kind that the shots do not tell."""

    kind: Kind
    """`gauge`: no shot can tell it and no measurement depends on it; `open`: other shots would tell it; `prior`: what was
    believed before counts more than what the shots tell."""
    n_directions: int
    text: str
    parameters: tuple[str, ...] = ()
    """Names of the parameters that dominate them."""

    @property
    def is_known(self) -> bool:
        """Whether it is a motion that has a name of its own."""
        return not self.text.startswith(tuple(_UNNAMED.values()))

    @classmethod
    def from_data(cls, data: Mapping[str, object]) -> OpenDirections:
        """From plain data; KeyError or ValueError where it does not fit."""
        names, kind = data["parameters"], str(data["kind"])
        if kind not in {"gauge", "open", "prior"}:
            raise ValueError(f"unknown kind of direction {kind!r}")
        parameters = tuple(str(name) for name in names) if isinstance(names, list | tuple) else ()
        return cls(kind, int(str(data["n_directions"])), str(data["text"]), parameters)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Motions of one kind that an engineer knows."""

    text: str
    vectors: FloatArray
    """(n, k) scaled."""


def parameter_scale(layout: Layout) -> FloatArray:
    """(n,) mm per unit of each geometric unknown."""
    twist = [1.0] * 3 + [ANGLE_SCALE_MM] * 3
    return np.array(twist * (layout.n_links + 1) + [1.0] * layout.n_camera)


def named_directions(problem: Problem, state: State, null_vectors: FloatArray, information: FloatArray) -> tuple[OpenDirections, ...]:
    """What a null space (n, k) and an information (n, n), both in scaled unknowns, leave open, grouped."""
    layout = problem.layout
    found, taken = _explained("gauge", _gauge_motions(problem, state), null_vectors, np.zeros((len(null_vectors), 0)), layout)
    known = _known_motions(problem, state)
    missed, taken = _explained("open", known, null_vectors, taken, layout)
    missed += _unnamed("open", _without(null_vectors, taken), layout)
    weak = _held_by_priors(problem, null_vectors, information)
    held, named = _explained("prior", known, weak, np.zeros((len(weak), 0)), layout)
    return tuple(found + missed + held + _unnamed("prior", _without(weak, named), layout))


def camera_gauge_twists(problem: Problem) -> FloatArray:
    """(g, 6 + k): rigid motions (twist in camera axes, rad scaled) and camera coefficients whose fields cancel."""
    if not problem.layout.n_camera or not len(problem.points_in_camera_mm):
        return np.zeros((0, 6 + problem.layout.n_camera))
    lower, upper = problem.points_in_camera_mm.min(axis=0), problem.points_in_camera_mm.max(axis=0)
    points = np.random.default_rng(3).uniform(lower, upper, (200, 3))
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (200, 3, 3)), -se3.hat(points) / ANGLE_SCALE_MM], axis=-1)
    basis, axis = problem.camera_error.basis(points), problem.camera_error.axis
    camera = np.zeros((200, 3, len(axis)))
    camera[:, axis, np.arange(len(axis))] = basis
    fields = np.concatenate([rigid, camera], axis=-1).reshape(600, -1)
    singular, vectors = np.linalg.svd(fields, full_matrices=False)[1:]
    return np.asarray(vectors[singular <= 1e-9 * singular[0]])


def _gauge_motions(problem: Problem, state: State) -> list[_Motion]:
    layout, model = problem.layout, problem.model
    motions = []
    if model is not None and layout.n_links:
        pairs = [_own_axis(layout, model, state.link_twists, i) for i in range(layout.n_links)]
        motions.append(_Motion("height and heading of the base: link 1 slides along and turns about axis 1, and the spheres go along", pairs[0]))
        text = (
            f"links 2 to {layout.n_links} may each slide along and turn about their own axis where the link before takes it back: "
            "zero angle and place of an axis belong to two links together"
        )
        motions.append(_Motion(text, np.concatenate(pairs[1:], axis=1)))
        text = f"link {layout.n_links} with the hand-eye transform: one displacement, which the two may divide at will"
        motions.append(_Motion(text, _flange_and_hand(layout, state.link_twists[-1])))
    twists = camera_gauge_twists(problem)
    if len(twists):
        hand_eye = twists[:, :6] / _twist_scale() @ se3.adjoint(state.flange_from_camera).T * _twist_scale()
        vectors = _placed(layout, hand_eye=hand_eye.T, camera=twists[:, 6:].T)
        motions.append(_Motion("camera field with the hand-eye transform: a shift or turn of all that the camera sees is both", vectors))
    return motions


def _known_motions(problem: Problem, state: State) -> list[_Motion]:
    """Motions that spread shots would tell."""
    layout, model, flange_from_camera = problem.layout, problem.model, state.flange_from_camera
    if not len(problem.points_in_camera_mm):
        return []
    seen = problem.points_in_camera_mm.mean(axis=0)
    rotation, place = flange_from_camera[:3, :3], se3.apply(flange_from_camera, seen)
    turned = np.concatenate([-np.cross(rotation.T, place), rotation.T], axis=1) * _twist_scale()
    shifted = np.concatenate([rotation.T, np.zeros((3, 3))], axis=1)
    motions = [
        _Motion("orientation of the camera on the flange: turns about the place where the spheres were seen", _placed(layout, hand_eye=turned.T)),
        _Motion("place of the camera on the flange: along the view and across it", _placed(layout, hand_eye=shifted.T)),
    ]
    if layout.n_camera:
        held = np.zeros((6, layout.n_camera))
        held[:3] = -rotation[:, problem.camera_error.axis] * problem.camera_error.basis(seen[None])[0]
        motions.insert(1, _Motion("shape of the camera field", _placed(layout, hand_eye=held, camera=np.eye(layout.n_camera))))
    if model is not None and layout.n_links:
        motions.append(_Motion("length scale: all lengths of arm and hand-eye by one factor", _scale(layout, model, place)))
    return motions


def _own_axis(layout: Layout, model: RobotModel, link_twists: FloatArray, i: int) -> FloatArray:
    """(n, 2): link i slides along and turns about axis i, and the link before takes it back (exact to first order)."""
    screws = np.zeros((6, 2))
    screws[2, 0] = screws[5, 1] = 1.0
    motion = np.zeros((layout.n_links, 6, 2))
    motion[i] = np.linalg.solve(se3.left_jacobian(link_twists[i]), screws)
    if i:
        before = se3.from_rotation_translation(se3.exp_so3([model.alpha_rad[i], 0, 0]), [model.a_mm[i], 0, 0])
        motion[i - 1] = -np.linalg.solve(se3.left_jacobian(-link_twists[i - 1]), se3.adjoint(before) @ screws)
    return _placed(layout, links=motion.reshape(-1, 2) * np.tile(_twist_scale(), layout.n_links)[:, None])


def _flange_and_hand(layout: Layout, last_twist: FloatArray) -> FloatArray:
    """(n, 6): the last link's right motions, taken back by the hand-eye transform."""
    links = np.zeros((6 * layout.n_links, 6))
    links[-6:] = np.linalg.inv(se3.left_jacobian(-last_twist)) * _twist_scale()[:, None]
    return _placed(layout, links=links, hand_eye=-np.diag(_twist_scale()))


def _scale(layout: Layout, model: RobotModel, place_in_flange_mm: FloatArray) -> FloatArray:
    """(n, 1): a_i of a link belongs to the twist before it, d_i to its own."""
    twists = np.zeros((layout.n_links, 6))
    twists[:, 2] += model.d_mm
    twists[:-1, 0] += model.a_mm[1:]
    hand_eye = np.concatenate([place_in_flange_mm, np.zeros(3)])
    return _placed(layout, links=twists.reshape(-1, 1), hand_eye=hand_eye[:, None])


def _placed(layout: Layout, *, links: FloatArray | None = None, hand_eye: FloatArray | None = None, camera: FloatArray | None = None) -> FloatArray:
    """(n, k) scaled vectors from their parts."""
    parts = [(layout.links, links), (layout.hand_eye, hand_eye), (layout.camera, camera)]
    width = next(part.shape[1] for _, part in parts if part is not None)
    result = np.zeros((layout.camera.stop, width))
    for where, part in parts:
        if part is not None:
            result[where] = part
    return result


def _explained(
    kind: Kind, motions: list[_Motion], space: FloatArray, taken: FloatArray, layout: Layout
) -> tuple[list[OpenDirections], FloatArray]:
    """Groups of the motions that lie in a space (n, k), and an orthonormal basis of all that is taken of it so far."""
    found = []
    for motion in motions:
        vectors = motion.vectors / np.linalg.norm(motion.vectors, axis=0)
        inside = _inside(_without(vectors, taken), _without(space, taken))
        if inside.shape[1]:
            found.append(OpenDirections(kind, inside.shape[1], motion.text, tuple(_name(i, layout) for i in _leading(vectors, _TAKES_PART))))
            taken = np.concatenate([taken, inside], axis=1)
    return found, taken


def _inside(vectors: FloatArray, space: FloatArray) -> FloatArray:
    """(n, j) orthonormal directions of a space (n, k) that nearly are combinations of some vectors."""
    left, singular, _ = np.linalg.svd(vectors, full_matrices=False)
    own = left[:, singular > 1e-3]
    if not own.shape[1] or not space.shape[1]:
        return np.zeros((len(vectors), 0))
    cosines, right = np.linalg.svd(own.T @ space, full_matrices=False)[1:]
    return np.asarray(space @ right[cosines > _INSIDE].T)


def _without(space: FloatArray, taken: FloatArray) -> FloatArray:
    """(n, j) orthonormal basis of what is left of some directions (n, k) without others (n, i), which are orthonormal."""
    left, singular, _ = np.linalg.svd(space - taken @ (taken.T @ space), full_matrices=False)
    return np.asarray(left[:, singular > max(_NEGLIGIBLE, 1e-3 * singular.max(initial=0.0))])


def _held_by_priors(problem: Problem, null_vectors: FloatArray, information: FloatArray) -> FloatArray:
    """(n, j) orthonormal directions, null ones left out, of which the priors tell more than the shots."""
    sigma = _prior_sigma(problem)
    values, vectors = np.linalg.eigh(information * sigma[:, None] * sigma)
    weak = sigma[:, None] * vectors[:, values < 1.0]
    n_more = weak.shape[1] - null_vectors.shape[1]
    if n_more <= 0:
        return np.zeros((len(sigma), 0))
    weak = weak / np.linalg.norm(weak, axis=0)
    left = np.linalg.svd(weak - null_vectors @ (null_vectors.T @ weak), full_matrices=False)[0]
    return np.asarray(left[:, :n_more])


def _prior_sigma(problem: Problem) -> FloatArray:
    """(n,) scaled."""
    priors = problem.priors
    links = [priors.link_rho_mm] * 3 + [priors.link_phi_rad] * 3
    sigma = np.array(links * problem.layout.n_links + [priors.hand_eye_mm] * 3 + [priors.hand_eye_rad] * 3)
    return np.concatenate([sigma, problem.camera_error.prior_sigma_mm]) * parameter_scale(problem.layout)


def _unnamed(kind: Kind, space: FloatArray, layout: Layout) -> list[OpenDirections]:
    """Directions that no known motion explains, by the parameters that dominate them; those of the same ones together."""
    label = _UNNAMED[kind]
    parts = [space] if space.shape[1] > _MOST_UNNAMED else [column[:, None] for column in _varimax(space).T]
    found = []
    for part in parts:
        leading = _leading(part)
        words = [_word(i, layout) for i in leading]
        shown = ", ".join(words) if len(words) <= _MOST_WORDS else ", ".join(dict.fromkeys(_owner(i, layout) for i in leading)) + " together"
        found.append(OpenDirections(kind, part.shape[1], f"{label}: {shown}", tuple(_name(i, layout) for i in leading)))
    return found


def _varimax(space: FloatArray) -> FloatArray:
    """A rotation of orthonormal columns (n, k) that makes each lean on few rows."""
    n, k = space.shape
    rotation = np.eye(k)
    for _ in range(_ROUNDS if k > 1 else 0):
        turned = space @ rotation
        left, _, right = np.linalg.svd(space.T @ (turned**3 - turned * (turned**2).sum(axis=0) / n))
        rotation = left @ right
    return np.asarray(space @ rotation)


def _leading(vectors: FloatArray, share: float = _DOMINATES) -> list[int]:
    size = np.linalg.norm(vectors, axis=1)
    return [int(i) for i in np.flatnonzero(size > share * size.max(initial=0.0))]


def _name(i: int, layout: Layout) -> str:
    """As in `identifiability.parameter_names`."""
    if i >= layout.camera.start:
        return f"camera.{i - layout.camera.start}_mm"
    owner = "hand_eye" if i >= layout.hand_eye.start else f"link{i // 6 + 1}"
    return f"{owner}.{_COMPONENTS[i % 6]}"


def _word(i: int, layout: Layout) -> str:
    part = f"term {i - layout.camera.start + 1}" if i >= layout.camera.start else _PARTS[i % 6]
    return f"{_owner(i, layout)} {part}"


def _owner(i: int, layout: Layout) -> str:
    if i >= layout.camera.start:
        return "camera"
    return "hand-eye" if i >= layout.hand_eye.start else f"link {i // 6 + 1}"


def _twist_scale() -> FloatArray:
    return np.array([1.0] * 3 + [ANGLE_SCALE_MM] * 3)
