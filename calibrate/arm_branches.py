"""In which of its branches an arm stands: shoulder, elbow and wrist, by the signs of the factors of its Jacobian's determinant.

Between two branches lies a singular pose, where one factor vanishes: the wrist centre above the first axis (shoulder),
upper arm and forearm in one line (elbow), axes 4 and 6 parallel (wrist). Both families of `drivers.kinematics.closed_form`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibrate.clouds import Solution
from calibrate.datum import link_columns, term_columns, twist_columns
from calibrate.problem import Problem
from calibrate.robot_terms import load_basis
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.closed_form import arm_geometry
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_MARGIN_RAD = float(np.radians(2))
_FEWEST_POSES = 3
_VISITED = 0.1
"""Share of the shots from which a branch counts as seen."""
_PARTS = ("shoulder", "elbow", "wrist")


class UnseenBranch(NamedTuple):
    """A branch that no shot was taken in, though the robot can."""

    parts: tuple[str, ...]
    """What must be turned over to get there, of shoulder, elbow and wrist."""
    expanded_uncertainty_mm: float
    """k = 2, of a length from a place measured in the branch of the shots to one measured in this, as the calibration causes it."""

    @property
    def text(self) -> str:
        """E.g. `wrist turned over`."""
        return " and ".join(self.parts) + " turned over"


def arm_branch(model: RobotModel, joints_rad: FloatArray) -> NDArray[np.bool_]:
    """(m, 3) side of the shoulder, elbow and wrist singularity on which axis angles (m, 6) stand.

    Raises:
        SettingsError: the arm is of no family with a closed-form inverse.
    """
    arm = arm_geometry(model)
    at_zero = mdh.chain(model, mdh.joints_from_link_angles_rad(model, np.zeros(model.n_joints)))
    wrist_in_link5 = se3.apply(se3.inverse(at_zero[5]), arm.wrist_mm)
    frames = mdh.chain(model, joints_rad)
    axis, place = frames[:, 1:, :3, 2], frames[:, 1:, :3, 3]
    wrist = se3.apply(frames[:, 5], wrist_in_link5)
    forearm_end = place[:, 3] if arm.family == "three parallel axes" else wrist
    shoulder = ((wrist - place[:, 0]) * np.cross(axis[:, 1], axis[:, 0])).sum(axis=-1)
    elbow = (axis[:, 1] * np.cross(place[:, 2] - place[:, 1], forearm_end - place[:, 2])).sum(axis=-1)
    bend = (axis[:, 4] * np.cross(axis[:, 3], axis[:, 5])).sum(axis=-1)
    return np.stack([shoulder, elbow, bend], axis=-1) > 0


def unseen_branch(problem: Problem, solution: Solution, covariance: FloatArray) -> UnseenBranch | None:
    """The best known of the other branches where (nearly) every shot was taken in one; None where there were more, or no other is feasible.

    Args:
        problem: with axis angles.
        solution: of it.
        covariance: (P, P) of the unknowns.
    """
    model, joints = problem.model, problem.joints_rad
    if model is None or joints is None or not len(joints):
        return None
    try:
        branches, counts = np.unique(arm_branch(model, joints), axis=0, return_counts=True)
        if (counts >= _VISITED * counts.sum()).sum() != 1:
            return None
        others = branches_of_many(model, problem.base_from_flange, margin_rad=_MARGIN_RAD)
    except SettingsError:
        return None
    turned = arm_branch(model, others.joints_rad) != branches[np.argmax(counts)]
    found = []
    for kind in np.unique(turned[turned.any(axis=1)], axis=0):
        rows = np.flatnonzero((turned == kind).all(axis=1))
        if len(np.unique(others.target[rows])) >= min(_FEWEST_POSES, problem.n_shots):
            parts = tuple(part for part, over in zip(_PARTS, kind, strict=True) if over)
            found.append(UnseenBranch(parts, _between(problem, solution, covariance, others.target[rows], others.joints_rad[rows])))
    return min(found, key=lambda branch: branch.expanded_uncertainty_mm, default=None)


def _between(problem: Problem, solution: Solution, covariance: FloatArray, shot: NDArray[np.intp], joints_rad: FloatArray) -> float:
    """Median over shots of U along the worst direction from the sphere as the shot sees it to the same from other axis angles."""
    own_joints = joints_rad if problem.joints_rad is None else problem.joints_rad[shot]
    centres = solution.state.centres_in_base_mm[problem.sphere[shot]]
    rows = _motion(problem, solution, own_joints, centres) - _motion(problem, solution, joints_rad, centres)
    used = covariance[: rows.shape[-1], : rows.shape[-1]]
    spread = np.linalg.eigvalsh(rows @ used @ np.swapaxes(rows, -1, -2))[:, -1]
    return float(2.0 * np.sqrt(np.median(np.maximum(spread, 0.0))))


def _motion(problem: Problem, solution: Solution, joints_rad: FloatArray, centres_in_base_mm: FloatArray) -> FloatArray:
    """(m, 3, p) of points (m, 3) per unknown of links, hand-eye and arm; the camera, which sees the same in both branches, left at zero."""
    model, state, layout = problem.model, solution.state, problem.layout
    if model is None:
        raise SettingsError("branches need a robot model", remedy="Calibrate with axis angles.")
    frames = mdh.chain(model, joints_rad, state.link_twists)
    rows = np.zeros((len(joints_rad), 3, layout.n_geometric))
    rows[..., layout.links] = link_columns(state.link_twists, frames, centres_in_base_mm)
    rows[..., layout.hand_eye] = twist_columns(frames[:, -1], centres_in_base_mm)
    if problem.terms:
        rows[..., layout.terms] = term_columns(state.link_twists, frames, load_basis(problem.terms, model, joints_rad), centres_in_base_mm)
    return rows
