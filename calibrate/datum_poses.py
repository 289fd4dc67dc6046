"""Poses over which the base frame is fitted to the nominal robot: the same for every calibration of a cell.

Fitted over the poses that happened to be used, the base moved by 0.1 mm between calibrations of one robot: two sets of
random poses average the difference between true and nominal robot differently. Fitted over poses that no view of the
work takes, it moves by what the calibration does not know about those: a quarter more than need be.
"""

from __future__ import annotations

import numpy as np

from acquire.cell import Cell
from acquire.poses import PoseLaw, sphere_candidates
from acquire.visibility import CameraView, camera_view
from calibrate.datum import ARM_MM, MAX_REFERENCES, References
from calibrate.design_cell import work_box_mm
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_N_TRIED = 20_000
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29)
_N_PLACES, _VIEWS, _DRAWN = 30, 5, 15
_LEAST_VIEWS = 50
"""With fewer, the camera hardly reaches the work, and the robot alone decides."""
_SPOT_MM = 1.0
_LATTICE_MM = 50.0
"""Solved sphere places are rounded to it, so that calibrations of one cell compare the same views."""


def datum_references(
    cell: Cell, model: RobotModel, flange_from_camera: FloatArray, centres_in_base_mm: FloatArray, used_rad: FloatArray
) -> References:
    """Where the calibrated robot is compared with the nominal one: what the camera sees of the work volume from feasible views.

    The cell file decides, so that all calibrations of a cell compare the same: its first guess of the hand-eye transform,
    its work volume, or the box about its spheres. What it does not tell is taken from the solve.

    Args:
        cell: camera, guess of the hand-eye transform, work volume or sphere places.
        model: the nominal robot.
        flange_from_camera: (4, 4) as solved, for a cell without a guess.
        centres_in_base_mm: (S, 3) sphere centres as solved, for a cell without places.
        used_rad: (m, n) the poses used, for a cell that tells neither camera nor work volume.
    """
    try:
        view = camera_view(cell.camera)
        guess = flange_from_camera if cell.flange_from_camera is None else np.asarray(cell.flange_from_camera, dtype=np.float64)
        joints = _views(model, guess, view, work_box_mm(cell, _known_places(cell, centres_in_base_mm)))
    except SettingsError:  # nobody told what the camera sees, or the robot has no closed-form inverse
        return References(datum_joints(model, cell.work_volume_box_mm, used_rad))
    if len(joints) < _LEAST_VIEWS:
        return References(datum_joints(model, cell.work_volume_box_mm, used_rad))
    return References(joints, se3.apply(guess, _looked_at_mm(view)))


def _known_places(cell: Cell, solved_mm: FloatArray) -> FloatArray:
    known = [sphere.centre_in_base_mm for sphere in cell.spheres.values()]
    if any(place is None for place in known):
        return np.asarray(np.round(solved_mm / _LATTICE_MM) * _LATTICE_MM)
    return np.array(known, dtype=np.float64)


def _looked_at_mm(view: CameraView) -> FloatArray:
    """(8, 3) of the camera frame: half the view's width, near and far end of the working range."""
    across, down = (np.tan(half / 2) for half in view.half_angle_rad)
    return np.array([[x * z, y * z, z] for z in view.working_range_mm for x in (-across, across) for y in (-down, down)])


def _views(model: RobotModel, flange_from_camera: FloatArray, view: CameraView, box_mm: FloatArray) -> FloatArray:
    """(k, n) feasible views of places of a box (2, 3), any arm branch: the same for the same arguments."""
    rng = np.random.default_rng(0)
    share = np.stack([_radical_inverse(_N_PLACES, prime) for prime in _PRIMES[:3]], axis=-1)
    place = np.repeat(box_mm[0] + share * (box_mm[1] - box_mm[0]), _DRAWN, axis=0)
    law = PoseLaw(floor_mm=min(0.0, float(box_mm[0, 2])))
    pool = sphere_candidates(model, flange_from_camera, place, _SPOT_MM, view, len(place), rng, law=law)
    shuffled = rng.permutation(len(pool.view))
    views, first = np.unique(pool.view[shuffled], return_index=True)
    # the first few views of every place that are feasible
    _, begins, of_place = np.unique(views // _DRAWN, return_index=True, return_inverse=True)
    return pool.joints_rad[shuffled[first[np.arange(len(views)) - begins[of_place] < _VIEWS]]]


def datum_joints(model: RobotModel, work_volume_mm: FloatArray | None, used_rad: FloatArray) -> FloatArray:
    """(k, n) poses for the datum: over the work volume (2, 3) where the cell states one, else those used (m, n)."""
    return used_rad if work_volume_mm is None else work_volume_joints(model, work_volume_mm)


def work_volume_joints(model: RobotModel, work_volume_mm: FloatArray) -> FloatArray:
    """(k, n) axis angles at which the flange points into a box (2, 3) in the base from the distance of the work.

    A Halton sequence over the axes' limits, at most half a turn each way; the nearest to the box where too few reach it.
    Nothing but the model and the box decides.
    """
    # more than a turn only repeats poses
    lower, upper = np.clip(model.joint_limits_rad, -np.pi, np.pi).T
    tried = lower + (upper - lower) * np.stack([_radical_inverse(_N_TRIED, prime) for prime in _PRIMES[: model.n_joints]], axis=-1)
    tried = tried[mdh.within_limits(model, tried)]
    flange = mdh.base_from_flange(model, tried)
    ahead = flange[:, :3, 3] + ARM_MM * flange[:, :3, 2]
    outside = np.linalg.norm(ahead - np.clip(ahead, work_volume_mm[0], work_volume_mm[1]), axis=1)
    return np.asarray(tried[np.argsort(outside, kind="stable")[:MAX_REFERENCES]])


def _radical_inverse(count: int, base: int) -> FloatArray:
    """Van der Corput sequence 1 to `count` in [0, 1)."""
    index, result, digit = np.arange(1, count + 1), np.zeros(count), 1.0 / base
    while index.any():
        result += digit * (index % base)
        index //= base
        digit /= base
    return result
