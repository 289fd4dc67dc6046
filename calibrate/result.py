"""The result of a calibration: whole in itself, immutable, and what it is used for.

calibration = Calibration.load("calibration.yaml")
calibration.points_in_base_mm(points_in_camera_mm, joints_rad=q)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.cell import Limits
from acquire.plan import PlannedPose
from calibrate.budget import ErrorBudget
from calibrate.camera_error import CameraError
from calibrate.camera_field import SHAPE as SEEN_SHAPE
from calibrate.camera_field import CameraField, SeenCells, camera_field, correction_mm
from calibrate.datum import Datum, base_motion, link_columns, term_columns, twist_columns
from calibrate.external_result import ExternalResult
from calibrate.identifiability import Identifiability
from calibrate.normal import NoiseModel
from calibrate.observations import RejectedShot
from calibrate.result_parts import ShotResult, Statistics
from calibrate.robot_terms import RobotTerm, deflection_rad, load_basis
from drivers.errors import SettingsError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

_CHUNK = 50_000
_COMPILED_FROM = 20_000
"""Points from which the compiled kernel is worth loading."""
_MEAN_SQUARE_COSINE = 7.0 / 12.0
"""Of the incidence over a cap of 60 degrees: turns noise along the normal into noise along the sight."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Robot, hand-eye and camera, calibrated together."""

    id: str
    method: str
    model: RobotModel | None
    """Nominal robot, or None for a pose-only calibration."""
    link_twists: FloatArray
    """(n, 6)."""
    terms: tuple[RobotTerm, ...]
    """Deflection terms of the arm, K of them."""
    terms_rad: FloatArray
    """(K,) their coefficients; zero where they are only considered in the covariance."""
    flange_from_camera: FloatArray
    camera_error: CameraError
    camera_mm: FloatArray
    """(k,) coefficients of the camera error model."""
    camera_seen_volume_mm: FloatArray
    """(2, 3) lower and upper corner of the part of the camera frame in which points were seen."""
    radius_offset_mm: float
    sphere_centres_in_base_mm: Mapping[str, FloatArray]
    sphere_radius_offsets_mm: Mapping[str, float]
    """Shared offset plus the sphere's own deviation within its certificate."""
    datum: Datum
    seen_joints_rad: FloatArray | None
    """(2, n) least and greatest axis angles used."""
    noise: NoiseModel
    parameter_names: tuple[str, ...]
    covariance: FloatArray
    """(P, P) of `parameter_names`, solver base, already scaled on held-out shots."""
    statistics: Statistics
    limits: Limits | None
    verdict: str
    reasons: tuple[str, ...]
    shots: tuple[ShotResult, ...]
    rejected: tuple[RejectedShot, ...]
    cell_name: str
    inputs: Mapping[str, object]
    identity: Mapping[str, object]
    created_utc: str
    software: str
    hand_eye: str = "calibrated"
    """Where `flange_from_camera` comes from: `calibrated`; where only external points were seen, `cell` or `none` (identity)."""
    external: ExternalResult | None = None
    """Frames and targets of external reference points; None where none was seen."""
    identifiability: Identifiability | None = None
    """What the shots determined and what not; None in files of older versions."""
    temperatures_c: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Least and greatest reading of every sensor while the shots were taken."""
    next_best_poses: tuple[PlannedPose, ...] = ()
    """Poses that would tell most next, best first, where the verdict asks for more."""
    seen_cells: SeenCells | None = None
    """Where in `camera_seen_volume_mm` points were seen; None in files of older versions."""
    error_budget: ErrorBudget | None = None
    """What a measured point is uncertain by, and why; None where no sphere was seen, and in files of older versions."""
    _worked_out: dict[str, FloatArray] = field(default_factory=dict, init=False, repr=False)
    """What hangs on nothing but the above, worked out once: scans of a part ask for it again and again."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read calibration.yaml; FileError when it is broken or was changed by hand."""
        from calibrate.result_file import load_calibration

        return load_calibration(path, cls)

    def save(self, path: str | Path) -> None:
        """Write calibration.yaml, atomically."""
        from calibrate.result_file import save_calibration

        save_calibration(self, path)

    def base_from_flange(self, joints_rad: ArrayLike) -> FloatArray:
        """Corrected robot (..., 4, 4) for axis angles (..., n); SettingsError for a pose-only calibration."""
        if self.model is None:
            raise SettingsError(
                "this calibration holds no robot model: it was made from flange poses", remedy="Pass base_from_flange= instead of joints_rad=."
            )
        q = np.asarray(joints_rad, dtype=np.float64)
        if q.shape[-1:] != (self.model.n_joints,) or not np.isfinite(q).all():
            raise SettingsError(f"joints_rad must be finite, of shape (..., {self.model.n_joints}), not {q.shape}", remedy="Pass axis angles in rad.")
        return self.datum.base_from_solver @ self._chain(self.model, q)[..., -1, :, :]

    def base_from_links(self, joints_rad: ArrayLike) -> FloatArray:
        """Corrected frames of the base and every link (..., n + 1, 4, 4), the flange last; raises as `base_from_flange`."""
        if self.model is None:
            raise SettingsError("this calibration holds no robot model: it was made from flange poses", remedy="Use the reported flange pose.")
        return self.datum.base_from_solver @ self._chain(self.model, np.asarray(joints_rad, dtype=np.float64))

    def corrected_points_in_camera_mm(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """Points (n, 3) with the camera's error taken out, still in the camera frame; NaN rows stay NaN."""
        points = _points(points_in_camera_mm)
        return points + self.camera_correction_mm(points)

    def points_in_base_mm(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """Measured points (n, 3) in the base; whole scans at one pose go through a compiled kernel, equal to 1e-9 mm.

        Args:
            points_in_camera_mm: (n, 3) as the camera gave them; NaN rows stay NaN.
            joints_rad: (n_axes,), or (n, n_axes) with one row a point; for calibrations of the whole robot.
            base_from_flange: (4, 4); for pose-only calibrations.

        Raises:
            SettingsError: not exactly the one of the two that fits this calibration, or a wrong shape.
        """
        given = np.asarray(points_in_camera_mm)
        # a whole scan of float32 is not copied
        measured = given if given.dtype == np.float32 and given.shape[1:] == (3,) else _points(points_in_camera_mm)
        base_from_camera = self._flange(joints_rad, base_from_flange, len(measured)) @ self.flange_from_camera
        if base_from_camera.ndim == 2 and len(measured) >= _COMPILED_FROM:
            return self._placed(measured, base_from_camera)
        measured = _points(measured)
        corrected = measured + self.camera_correction_mm(measured)
        if base_from_camera.ndim == 2:
            return np.asarray(corrected @ base_from_camera[:3, :3].T + base_from_camera[:3, 3])
        return se3.apply(base_from_camera, corrected)

    def _placed(self, points_in_camera_mm: NDArray[np.floating], base_from_camera: FloatArray) -> FloatArray:
        from calibrate.placing_kernels import place_points

        result = np.empty(points_in_camera_mm.shape)
        place_points(points_in_camera_mm, self.camera_error.polynomials, self.camera_mm, base_from_camera, result)
        return result

    def point_covariance_in_base_mm2(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """Covariance (n, 3, 3) of `points_in_base_mm`: calibration, pose noise of the shot, and noise of the point.

        First order; points of one shot share its pose noise and all points share the calibration, so differences are
        better known than two covariances taken as independent would say. Raises as `points_in_base_mm`.
        """
        points = _points(points_in_camera_mm)
        result = np.full((len(points), 3, 3), np.nan)
        for start in range(0, len(points), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            q = _chunk_of(joints_rad, chunk, len(points))
            jacobian = self.point_jacobian(points[chunk], joints_rad=q, base_from_flange=base_from_flange)
            used = self.covariance[: jacobian.shape[-1], : jacobian.shape[-1]]
            result[chunk] = jacobian @ used @ np.swapaxes(jacobian, -1, -2) + self._shot_covariance(points[chunk], q, base_from_flange)
        return result

    def point_jacobian(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """(n, 3, p) motion of points in the stated base per parameter of robot, hand-eye, camera and deflection (the first p)."""
        points = _points(points_in_camera_mm)
        flange = np.broadcast_to(self._solver_flange(joints_rad, base_from_flange, len(points)), (len(points), 4, 4))
        base_from_camera = flange @ self.flange_from_camera
        in_solver_base = se3.apply(base_from_camera, self.corrected_points_in_camera_mm(points))
        blocks = []
        if self.model is not None:
            q = np.broadcast_to(np.asarray(joints_rad, dtype=np.float64), (len(points), self.model.n_joints))
            frames = self._chain(self.model, q)
            blocks.append(link_columns(self.link_twists, frames, in_solver_base))
        blocks.append(twist_columns(flange, in_solver_base))
        basis = self.camera_error.basis(points)
        blocks.append(base_from_camera[:, :3, :3][:, :, self.camera_error.axis] * basis[:, None, :])
        if self.model is not None and self.terms:
            blocks.append(term_columns(self.link_twists, frames, load_basis(self.terms, self.model, q), in_solver_base))
        moved = np.concatenate(blocks, axis=-1)
        if self.model is not None:
            moved += se3.point_columns(in_solver_base) @ self._base_motion()
        return np.asarray(self.datum.base_from_solver[:3, :3] @ moved)

    def _base_motion(self) -> FloatArray:
        """(6, p) how the stated base follows the parameters; two threads may work it out at once, to the same end."""
        if "base_motion" not in self._worked_out:
            between = 6 + len(self.camera_mm)
            self._worked_out["base_motion"] = base_motion(self.datum, self.model, self.link_twists, between, self.terms, self.terms_rad)
        return self._worked_out["base_motion"]

    def to_json_dict(self) -> dict[str, object]:
        """What `spherecal calibrate --json` prints."""
        s = self.statistics
        return {
            "id": self.id,
            "method": self.method,
            "camera_error": self.camera_error.name,
            "n_shots": s.n_shots,
            "used": s.used,
            "rejected": [{"session": r.session, "index": r.index, "reason": r.reason} for r in self.rejected],
            "rank": s.rank,
            "n_parameters": s.n_parameters,
            "train_rms_mm": s.train_rms_mm,
            "cross_validated_rms_mm": s.cross_validated_rms_mm,
            "predicted_centre_rms_mm": s.predicted_centre_rms_mm,
            "radius_offset_mm": self.radius_offset_mm,
            "noise": {"point_mm": self.noise.point_mm, "form_mm": self.noise.form_mm, "pose_mm": self.noise.pose_mm, "pose_rad": self.noise.pose_rad},
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "seconds": s.seconds,
            **({} if self.external is None else {"external": self.external.to_json_dict(), "hand_eye": self.hand_eye}),
            "identifiability": None if self.identifiability is None else self.identifiability.to_json_dict(),
            "next_best_poses": [{"id": pose.id, "sphere": pose.sphere, "joints_rad": pose.joints_rad.tolist()} for pose in self.next_best_poses],
            "error_budget": None if self.error_budget is None else self.error_budget.to_json_dict(),
        }

    def camera_correction_mm(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, 3) what is added to points (n, 3) of the camera, rigid part and all; `camera_field` tells how well it is known."""
        return correction_mm(self.camera_error, self.camera_mm, _points(points_in_camera_mm))

    def camera_field(self, points_in_camera_mm: ArrayLike) -> CameraField:
        """The correction at points (n, 3) with covariance, its rigid part taken out: what the hand-eye transform cannot take over."""
        first = 6 * len(self.link_twists) + 6
        part = slice(first, first + len(self.camera_mm))
        return camera_field(self.camera_error, self.camera_mm, self.covariance[part, part], self.cells, _points(points_in_camera_mm))

    @property
    def cells(self) -> SeenCells:
        """`seen_cells`, or the whole seen box where an older file does not tell."""
        return self.seen_cells or SeenCells(self.camera_seen_volume_mm, np.ones(SEEN_SHAPE, dtype=np.bool_))

    def noise_covariances_mm2(self, points_in_camera_mm: FloatArray, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 3, 3) twice: what pose noise and what noise of the point add in one shot, for points (n, 3) at poses (n, 4, 4)."""
        base_from_camera = base_from_flange @ self.flange_from_camera
        lever = se3.hat(se3.apply(base_from_camera, points_in_camera_mm) - base_from_flange[:, :3, 3])
        pose = self.noise.pose_mm**2 * np.eye(3) + self.noise.pose_rad**2 * lever @ np.swapaxes(lever, -1, -2)
        unit = points_in_camera_mm / np.linalg.norm(points_in_camera_mm, axis=1, keepdims=True)
        sight = np.einsum("nij,nj->ni", base_from_camera[:, :3, :3], unit)
        along = (self.noise.point_mm**2 + self.noise.form_mm**2) / _MEAN_SQUARE_COSINE
        return np.asarray(pose), np.asarray(along * sight[:, :, None] * sight[:, None, :])

    def _shot_covariance(self, points: FloatArray, joints_rad: ArrayLike | None, base_from_flange: ArrayLike | None) -> FloatArray:
        flange = np.broadcast_to(self._flange(joints_rad, base_from_flange, len(points)), (len(points), 4, 4))
        pose, point = self.noise_covariances_mm2(points, flange)
        if self.datum.noise is None:
            return pose + point
        solver_from_camera = se3.inverse(self.datum.base_from_solver) @ flange @ self.flange_from_camera
        in_solver_base = se3.apply(solver_from_camera, self.corrected_points_in_camera_mm(points))
        turned = self.datum.base_from_solver[:3, :3] @ se3.point_columns(in_solver_base)
        return pose + point + turned @ self.datum.noise @ np.swapaxes(turned, -1, -2)

    def _flange(self, joints_rad: ArrayLike | None, base_from_flange: ArrayLike | None, n_points: int) -> FloatArray:
        return self.datum.base_from_solver @ self._solver_flange(joints_rad, base_from_flange, n_points)

    def _solver_flange(self, joints_rad: ArrayLike | None, base_from_flange: ArrayLike | None, n_points: int) -> FloatArray:
        if (joints_rad is None) == (base_from_flange is None):
            raise SettingsError("give exactly one of joints_rad and base_from_flange", remedy=self._wanted())
        if self.hand_eye == "none":
            raise SettingsError(
                "this calibration is of the robot alone: nothing is known of where its camera sits",
                remedy="Calibrate on shots of spheres too, or give flange_from_camera in the cell file before calibrating.",
            )
        if base_from_flange is not None:
            return self._given_pose(base_from_flange)
        q = np.asarray(joints_rad, dtype=np.float64)
        if self.model is None:
            raise SettingsError("joints_rad does not fit a pose-only calibration", remedy=self._wanted())
        if q.shape not in {(self.model.n_joints,), (n_points, self.model.n_joints)} or not np.isfinite(q).all():
            raise SettingsError(
                f"joints_rad of shape {q.shape} does not fit {n_points} points of this robot, or is not finite", remedy=self._wanted()
            )
        return self._chain(self.model, q)[..., -1, :, :]

    def _chain(self, model: RobotModel, q: FloatArray) -> FloatArray:
        return mdh.chain(model, q, self.link_twists, deflection_rad(self.terms, self.terms_rad, model, q))

    def _given_pose(self, base_from_flange: ArrayLike) -> FloatArray:
        pose = np.asarray(base_from_flange, dtype=np.float64)
        if self.model is not None:
            raise SettingsError("base_from_flange does not fit a calibration of the whole robot", remedy=self._wanted())
        if not se3.is_rigid(pose, 1e-4):
            raise SettingsError("base_from_flange is no rigid transform of shape (4, 4)", remedy="Pass a rotation and a translation in mm.")
        return pose

    def _wanted(self) -> str:
        if self.model is None:
            return "This calibration takes base_from_flange of shape (4, 4)."
        return f"This calibration takes joints_rad of shape ({self.model.n_joints},) or (n, {self.model.n_joints}), in rad."


def _points(points_in_camera_mm: ArrayLike) -> FloatArray:
    points = np.asarray(points_in_camera_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SettingsError(f"points must be of shape (n, 3), not {points.shape}", remedy="Reshape organised clouds: cloud.reshape(-1, 3).")
    return points


def _chunk_of(joints_rad: ArrayLike | None, chunk: slice, n_points: int) -> FloatArray | None:
    if joints_rad is None:
        return None
    q = np.asarray(joints_rad, dtype=np.float64)
    return q[chunk] if q.ndim == 2 and len(q) == n_points else q
