"""A first guess that the whole-cloud solve can start from: from sphere centres (area cameras) or from arcs.

Centres: the hand-eye transform and all centres come from one linear system, robustly (METHOD.md 4, *First guess*); then
every unknown is refined on centres with a redescending weight per shot, which shows the shots that do not belong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate import normal
from calibrate.problem import Problem, State, linearise_geometry, without_terms
from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_ROUNDS = 30
_STILL_MM, _NEARLY_STILL = 1e-4, 0.02
"""Change of a shot's miss from which on the start stands, and the part of the scale from which on everything is let free."""
_SURELY_MM, _MANY_SHOTS = 0.3, 30
_SMALLEST_SCALE_MM = 0.05
_REJECT_SCALES = 8.0
_REJECT_AT_LEAST_MM = 1.0
_FITS_MM = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A state near the solution and how far each shot's centre is from it."""

    state: State
    miss_mm: FloatArray
    """(m,) distance of each shot's own centre from where the state expects it; for line profiles the rms of an arc left out, zero of others."""
    scale_mm: float
    """Robust sigma of one component of the misses."""

    @property
    def spoiled(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(m,) shots that lie further off than anything a good shot could."""
        return np.asarray(self.miss_mm > max(_REJECT_SCALES * self.scale_mm, _REJECT_AT_LEAST_MM))


def start_from_centres(problem: Problem, centres_in_camera_mm: FloatArray, guess: FloatArray | None) -> Start:
    """Start for shots with a centre (m, 3) each; `guess` is a flange_from_camera (4, 4) or None.

    The guess and the linear solution are both refined, and the one that explains the shots better is taken; the second is
    not looked at where the first leaves next to nothing of many shots.

    Raises:
        DataError: neither brings most shots within some centimetres of one place: the data do not belong together.
    """
    best = None if guess is None else _refine(problem, centres_in_camera_mm, guess)
    if best is None or not (best.scale_mm < _SURELY_MM and problem.n_shots >= _MANY_SHOTS):
        linear = _linear_hand_eye(problem, centres_in_camera_mm)
        starts = [best] if linear is None else [best, _refine(problem, centres_in_camera_mm, linear)]
        best = min((start for start in starts if start is not None), key=lambda start: start.scale_mm, default=None)
    if best is None:
        raise DataError("too few shots for a first guess of the hand-eye transform", remedy="Take at least 12 shots from different orientations.")
    if not best.scale_mm < _FITS_MM:
        raise DataError(
            f"no hand-eye transform brings the shots of a sphere to one place (they stay {best.scale_mm:.0f} mm apart)",
            remedy="Check the robot model (coupling, axis order, degrees), the units of the scans, and that the sphere stood still.",
        )
    return best


def initial_state(problem: Problem, flange_from_camera: FloatArray, centres_in_base_mm: FloatArray) -> State:
    """A state with every error at zero."""
    layout = problem.layout
    return State(
        link_twists=np.zeros((layout.n_links, 6)),
        flange_from_camera=flange_from_camera,
        camera_mm=np.zeros(layout.n_camera),
        terms_rad=np.zeros(layout.n_terms),
        radius_offset_mm=0.0,
        sphere_radius_deviation_mm=np.zeros(layout.n_spheres),
        centres_in_base_mm=centres_in_base_mm,
        pose_noise=np.zeros((problem.n_scans, 6)),
    )


def centres_by_median(problem: Problem, flange_from_camera: FloatArray, centres_in_camera_mm: FloatArray) -> FloatArray:
    """(S, 3) medians over shots of where each sphere would be in the base."""
    in_base = se3.apply(problem.base_from_flange @ flange_from_camera, centres_in_camera_mm)
    return np.array([np.median(in_base[problem.sphere == s], axis=0) for s in range(len(problem.radius_mm))])


def _linear_hand_eye(problem: Problem, centres: FloatArray) -> FloatArray | None:
    """Solve R_j R_X p_j + R_j t_X - c_s = -t_j for R_X (9), t_X, c_s by reweighted least squares, then project R_X."""
    rotation, translation = problem.base_from_flange[:, :3, :3], problem.base_from_flange[:, :3, 3]
    m, n_spheres = problem.n_shots, len(problem.radius_mm)
    if 3 * m < 12 + 3 * n_spheres + 3:
        return None
    columns = np.zeros((m, 3, 12 + 3 * n_spheres))
    columns[:, :, :9] = (rotation[:, :, :, None] * centres[:, None, None, :]).reshape(m, 3, 9)
    columns[:, :, 9:12] = rotation
    columns[np.arange(m)[:, None], np.arange(3)[None], 12 + 3 * problem.sphere[:, None] + np.arange(3)[None]] = -1.0
    weight = np.ones(m)
    scale_columns = np.concatenate([np.full(9, 300.0), np.ones(3 + 3 * n_spheres)])
    for _ in range(12):
        root = np.sqrt(weight)[:, None, None]
        solution = np.linalg.lstsq(
            (columns * root / scale_columns).reshape(-1, 12 + 3 * n_spheres), -(translation[..., None] * root).reshape(-1), rcond=1e-10
        )[0]
        unknowns = solution / scale_columns
        miss = np.linalg.norm(columns @ unknowns + translation, axis=1)
        weight = _weights(miss, max(1.4826 * float(np.median(miss)) / 1.54, 1e-3))
    matrix = unknowns[:9].reshape(3, 3)
    if not np.isfinite(matrix).all():
        return None
    return se3.from_rotation_translation(se3.nearest_rotation(matrix), unknowns[9:12])


def _refine(problem: Problem, centres: FloatArray, hand_eye: FloatArray) -> Start:
    """Gauss-Newton on centres, a weight per shot; first the hand-eye transform and centres, then everything."""
    bare = without_terms(problem)
    layout, camera_shift = bare.layout, _basis_at(bare, centres)
    nothing = np.zeros_like(initial_state(bare, hand_eye, np.zeros((layout.n_spheres, 3))).pose_noise)
    free = np.concatenate([np.arange(layout.size)[layout.hand_eye], np.arange(layout.size)[layout.centres]])
    state = initial_state(bare, hand_eye, centres_by_median(bare, hand_eye, centres))
    scale, miss, everything = np.inf, np.full(problem.n_shots, np.inf), False
    for turn in range(_ROUNDS):
        geometry = linearise_geometry(bare, state)
        difference = centres + np.einsum("mki,k->mi", camera_shift, state.camera_mm) - geometry.centre_in_camera_mm
        previous, miss = miss, np.linalg.norm(difference, axis=1)
        moved_mm = float(np.abs(miss - previous).max())
        if everything and moved_mm < _STILL_MM:
            break
        everything = everything or moved_mm < _NEARLY_STILL * scale or turn >= _ROUNDS // 3
        # the median length of a 3-vector of unit noise is 1.54
        scale = max(float(np.median(miss)) / 1.54, _SMALLEST_SCALE_MM)
        jacobian = geometry.columns[:, :3]
        jacobian[:, :, layout.camera] += np.swapaxes(camera_shift, 1, 2)
        hessian, gradient = normal.held_poses(bare, state, jacobian, difference, _weights(miss, scale) / scale**2)
        if everything:
            step = -normal.symmetric_solve(hessian, gradient)
        else:
            step = np.zeros(layout.size)
            step[free] = -normal.symmetric_solve(hessian[np.ix_(free, free)], gradient[free])
        state = state.moved(layout, step, nothing)
    return Start(replace(state, terms_rad=np.zeros(len(problem.terms))), miss, scale)


def _weights(miss_mm: FloatArray, scale_mm: float) -> FloatArray:
    return np.asarray((1.0 + (miss_mm / (4.0 * scale_mm)) ** 2) ** -2.0)


def _basis_at(problem: Problem, centres: FloatArray) -> FloatArray:
    """(m, k, 3): motion of a point at the centre per camera coefficient."""
    values = problem.camera_error.basis(centres)
    result = np.zeros((*values.shape, 3))
    result[:, np.arange(values.shape[1]), problem.camera_error.axis] = values
    return result
