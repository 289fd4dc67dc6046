"""The base frame of a calibration: a free solve moves it by tenths of a mm, so it must be said (DESIGN.md 3, *Datum*).

The base is the rigid motion that brings the calibrated robot nearest to the nominal one over the work volume (see
`datum_poses`): points fixed to the flange where the camera looks, at every reference pose. A constant
shift of the flange is left free in that fit: link n and the hand-eye transform are one displacement that no data can
divide between them (METHOD.md 3), and without that freedom their priors would move the base by millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calibrate.robot_terms import RobotTerm, deflection_rad, load_basis
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

ARM_MM = 400.0
"""Distance from the flange at which work is measured, where no camera tells: how much orientation counts against position."""
MAX_REFERENCES = 150
CORNERS_MM = np.concatenate([np.zeros((1, 3)), ARM_MM * np.eye(3)])
"""(4, 3) the flange's origin and three points at arm's length: what is compared where no camera tells where it looks."""
_ROUNDS = 8


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """Where two robots are compared."""

    joints_rad: FloatArray
    """(k, n) in any order; evenly thinned beyond `MAX_REFERENCES`."""
    points_in_flange_mm: FloatArray = field(default_factory=lambda: CORNERS_MM)
    """(p, 3) carried by the flange."""


@dataclass(frozen=True, slots=True, eq=False)
class Datum:
    """Which base frame the results are in."""

    kind: str
    """`nominal_robot`: best fit to it; `controller`: the robot is taken as it reports; `calibration`: best fit to an earlier one's
    robot; `spheres`: best fit of sphere centres to where an earlier one had them."""
    base_from_solver: FloatArray
    """(4, 4) from the solver's own base to the stated one."""
    references: References
    """Where the fit was made; no poses for `controller`. With `spheres`: views of the work volume."""
    like: str = ""
    """Identity of the earlier calibration whose base this is."""
    spheres: tuple[str, ...] = ()
    """Names of those that hold the base."""
    motion: FloatArray | None = None
    """(6, p) with `spheres`: left twist of the solver's base per parameter of robot, hand-eye, camera and deflection."""
    noise: FloatArray | None = None
    """(6, 6) with `spheres`: covariance of that twist by what moves with no parameter, the noise of the shots."""


def nominal_robot_datum(
    model: RobotModel, link_twists: FloatArray, over: References, terms: tuple[RobotTerm, ...] = (), terms_rad: FloatArray | None = None
) -> Datum:
    """Best fit of the calibrated robot, deflected by its terms, to the nominal one."""
    return best_fit_datum(model, link_twists, over, lambda joints_rad: mdh.base_from_flange(model, joints_rad), terms, terms_rad)


def best_fit_datum(
    model: RobotModel,
    link_twists: FloatArray,
    over: References,
    wanted: Callable[[FloatArray], FloatArray],
    terms: tuple[RobotTerm, ...] = (),
    terms_rad: FloatArray | None = None,
) -> Datum:
    """Best fit of the calibrated robot, deflected by its terms, to flange poses (k, 4, 4) wanted at axis angles (k, n)."""
    ordered, points = over.joints_rad[np.lexsort(over.joints_rad.T)], over.points_in_flange_mm
    joints = ordered[np.unique(np.linspace(0, len(ordered) - 1, min(MAX_REFERENCES, len(ordered))).round().astype(int))]
    deflection = None if terms_rad is None else deflection_rad(terms, terms_rad, model, joints)
    target, solved = _carried(wanted(joints), points), mdh.base_from_flange(model, joints, link_twists, deflection)
    base_from_solver, flange_offset = np.eye(4), np.eye(4)
    for _ in range(_ROUNDS):
        moved = base_from_solver @ solved @ flange_offset
        step = _fit_step(moved, points, (target - _carried(moved, points)).reshape(-1, 1))[:, 0]
        base_from_solver = se3.exp(step[:6]) @ base_from_solver
        flange_offset = flange_offset @ se3.exp(step[6:])
    return Datum("nominal_robot", base_from_solver, References(joints, points))


def controller_datum() -> Datum:
    """The base that the controller reports its poses in."""
    return Datum("controller", np.eye(4), References(np.zeros((0, 0))))


def base_motion(
    datum: Datum, model: RobotModel | None, link_twists: FloatArray, n_between: int, terms: tuple[RobotTerm, ...], terms_rad: FloatArray
) -> FloatArray:
    """(6, p) left twist of the solver's base per parameter: link twists, `n_between` of hand-eye and camera, terms."""
    if datum.motion is not None:
        return datum.motion
    of_robot, n_links = datum_jacobian(datum, model, link_twists, terms, terms_rad), link_twists.size
    return np.concatenate([of_robot[:, :n_links], np.zeros((6, n_between)), of_robot[:, n_links:]], axis=1)


def datum_jacobian(
    datum: Datum, model: RobotModel | None, link_twists: FloatArray, terms: tuple[RobotTerm, ...] = (), terms_rad: FloatArray | None = None
) -> FloatArray:
    """(6, 6 n + K) left twist of the solver's base per link twist component and term: how the fit follows the calibration.

    Terms that are only considered count too: the arm that the base is fitted by yields as much as the arm that measures.
    """
    size = link_twists.size + len(terms)
    if model is None or not len(datum.references.joints_rad):
        return np.zeros((6, size))
    deflection = None if terms_rad is None else deflection_rad(terms, terms_rad, model, datum.references.joints_rad)
    frames = mdh.chain(model, datum.references.joints_rad, link_twists, deflection)
    load = load_basis(terms, model, datum.references.joints_rad)
    points = datum.references.points_in_flange_mm
    corners = np.moveaxis(_carried(frames[:, -1], points), 1, 0)
    by_links = np.stack([link_columns(link_twists, frames, corner) for corner in corners], axis=1)
    by_terms = np.stack([term_columns(link_twists, frames, load, corner) for corner in corners], axis=1)
    return -_fit_step(frames[:, -1], points, np.concatenate([by_links, by_terms], axis=-1).reshape(-1, size))[:6]


def _fit_step(base_from_flange: FloatArray, points_in_flange_mm: FloatArray, wanted_motion: FloatArray) -> FloatArray:
    """(12, k): left twist of the base, then right twist of the flange, that best cause motions (3 p m, k) of carried points."""
    points = _carried(base_from_flange, points_in_flange_mm)
    rotation = base_from_flange[:, None, :3, :3]
    of_base = se3.point_columns(points)
    of_flange = np.concatenate([np.broadcast_to(rotation, (*points.shape, 3)), -rotation @ se3.hat(points_in_flange_mm)], axis=-1)
    design = np.concatenate([of_base, of_flange], axis=-1).reshape(-1, 12)
    scale = np.array([1.0, 1, 1, 1e-3, 1e-3, 1e-3] * 2)
    # poses of one orientation cannot tell a shift of the flange from one of the base: the shorter motion is taken
    return np.asarray(np.linalg.lstsq(design * scale, wanted_motion, rcond=1e-9)[0] * scale[:, None])


def term_columns(link_twists: FloatArray, frames: FloatArray, load: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, K): motion of points (m, 3) carried by the flange per coefficient of deflection terms with loads (m, n, K)."""
    result = np.zeros((len(frames), 3, load.shape[-1]))
    turned = _frames_of_twists(frames, link_twists)
    for i in range(load.shape[1]):
        if load[:, i].any():
            motion = np.cross(turned[:, i, :3, 2], points_in_base_mm - turned[:, i, :3, 3])
            result += motion[:, :, None] * load[:, i, None, :]
    return result


def link_columns(link_twists: FloatArray, frames: FloatArray, points_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, 6 n): motion of points (m, 3) carried by the flange per component of the link twists (n, 6).

    Frames (m, n + 1, 4, 4) are those of `mdh.chain` with the same twists.
    """
    left_jacobian = se3.left_jacobian(link_twists)
    turned = _frames_of_twists(frames, link_twists)
    return np.concatenate([twist_columns(turned[:, i], points_in_base_mm) @ left_jacobian[i] for i in range(len(link_twists))], axis=-1)


def _frames_of_twists(frames: FloatArray, link_twists: FloatArray) -> FloatArray:
    """(m, n, 4, 4): each axis turned (and yielded), its own twist not yet applied."""
    return np.asarray(frames[:, 1:] @ se3.inverse(se3.exp(link_twists)))


def twist_columns(base_from_frame: FloatArray, point_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, 6): motion in the base of points (m, 3) per left twist acting in frames (m, 4, 4)."""
    rotation = base_from_frame[:, :3, :3]
    point_in_frame = np.einsum("mji,mj->mi", rotation, point_in_base_mm - base_from_frame[:, :3, 3])
    return np.concatenate([rotation, -rotation @ se3.hat(point_in_frame)], axis=-1)


def _carried(base_from_flange: FloatArray, points_in_flange_mm: FloatArray) -> FloatArray:
    """(m, p, 3) of points fixed to the flange."""
    return se3.apply(base_from_flange[:, None], points_in_flange_mm)
