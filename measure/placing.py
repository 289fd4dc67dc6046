"""What stitching and verification need of a calibration, and how a shot finds its way into the base with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from acquire.cell import Cell, Limits, cell_of_session, robot_model_of
from acquire.check import check_session
from acquire.identity import identity_marks
from calibrate.normal import NoiseModel
from calibrate.observations import SphereShot
from calibrate.plausibility import check_reported_poses
from drivers.errors import DataError
from drivers.files.session import Session, Shot
from drivers.kinematics import mdh
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from measure.proof.reach import KnowsItsReach


class MeasuringSystem(Protocol):
    """A calibrated robot with a camera; `calibrate.Calibration` is one."""

    @property
    def id(self) -> str:
        """Digest that results carry."""
        ...

    @property
    def identity(self) -> Mapping[str, object]:
        """Serial numbers and the like of what was calibrated."""
        ...

    @property
    def model(self) -> RobotModel | None:
        """Nominal robot; None for a pose-only calibration."""
        ...

    def points_in_base_mm(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """Calibrated points (n, 3)."""
        ...


class TrainingShot(Protocol):
    """One shot that a calibration was made from."""

    @property
    def scan_sha256(self) -> str:
        """Digest of its scan."""
        ...

    @property
    def joints_rad(self) -> FloatArray | None:
        """(n,) where the robot stood; None where it is not known."""
        ...

    @property
    def base_from_flange(self) -> FloatArray | None:
        """(4, 4) where the flange was reported; None where it is not known."""
        ...


class JudgedSystem(MeasuringSystem, KnowsItsReach, Protocol):
    """What verification needs besides."""

    @property
    def radius_offset_mm(self) -> float:
        """By how much spheres read larger in radius."""
        ...

    @property
    def limits(self) -> Limits | None:
        """Limits of the cell it was made in."""
        ...

    @property
    def temperatures_c(self) -> Mapping[str, tuple[float, float]]:
        """Least and greatest reading of every sensor while it was made."""
        ...

    @property
    def shots(self) -> Sequence[TrainingShot]:
        """The shots it was made from."""
        ...

    @property
    def noise(self) -> NoiseModel:
        """What it found of noise, of the poses above all."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(P, P): the p parameters of `point_jacobian` first, then the radius offset, then others."""
        ...

    def point_jacobian(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        """(n, 3, p) motion of calibrated points per parameter."""
        ...


def check_fits(calibration: MeasuringSystem, session: Session, cell: Cell | None = None) -> tuple[str, ...]:
    """Refuse sessions that this calibration cannot measure.

    Returns:
        How the robot and the camera differ from those that were calibrated, where the cell file lets that pass.

    Raises:
        FileError: the session does not fit its own cell: axes, units, names of spheres.
        DataError: it was recorded with another robot or camera, with other settings or another payload, or its poses
            contradict its axis angles.
    """
    cell = cell or cell_of_session(session)
    model = robot_model_of(cell, session)
    check_session(session, cell, model)
    marks = identity_marks(calibration.identity, session, cell)
    if calibration.model is None or model is None:
        return marks
    check_reported_poses([session], model)
    if not _same_geometry(calibration.model, model):
        raise DataError(
            f"the session was recorded with robot model {model.name}, the calibration is of {calibration.model.name} or another version of it",
            file=session.folder,
            remedy="Use the calibration of this robot.",
        )
    return marks


def _same_geometry(first: RobotModel, second: RobotModel) -> bool:
    names = ("a_mm", "alpha_rad", "d_mm", "theta_offset_rad", "coupling")
    pairs = [(np.asarray(getattr(first, name)), np.asarray(getattr(second, name))) for name in names]
    return all(a.shape == b.shape and np.allclose(a, b, rtol=0, atol=1e-9) for a, b in pairs)


def points_of_shot_in_base_mm(calibration: MeasuringSystem, session: Session, shot: Shot, points_in_camera_mm: ArrayLike) -> FloatArray:
    """Calibrated points (n, 3) of a shot in the base.

    Raises:
        DataError: the shot lacks the joints, or the flange pose, that this calibration needs.
    """
    if calibration.model is not None:
        if shot.joints_rad is None:
            raise _lacking(session, shot, "no joints, which this calibration of the whole robot needs", "Capture with joints")
        return calibration.points_in_base_mm(points_in_camera_mm, joints_rad=shot.joints_rad)
    if shot.base_from_flange is None:
        raise _lacking(session, shot, "no flange pose, which this pose-only calibration needs", "Record base_from_flange")
    return calibration.points_in_base_mm(points_in_camera_mm, base_from_flange=shot.base_from_flange)


def pose_of(model: RobotModel | None, shot: SphereShot) -> dict[str, FloatArray]:
    """The keyword that a calibration with this nominal robot (None: pose-only) wants for a shot's pose.

    Raises:
        DataError: the shot lacks the joints that it needs.
    """
    if model is None:
        return {"base_from_flange": shot.base_from_flange}
    if shot.joints_rad is None:
        raise DataError(
            f"shot {shot.index} has no joints, which this calibration of the whole robot needs",
            remedy="Record joints, or use a calibration made from flange poses.",
        )
    return {"joints_rad": shot.joints_rad}


def nominal_base_from_camera(
    model: RobotModel | None, first_guess: ArrayLike | None, joints_rad: FloatArray | None, base_from_flange: FloatArray | None
) -> FloatArray | None:
    """Where the uncalibrated cell puts the camera (4, 4): nominal robot and first guess; None where there is no guess."""
    if first_guess is None:
        return None
    if model is not None and joints_rad is not None:
        return np.asarray(mdh.base_from_flange(model, joints_rad) @ np.asarray(first_guess))
    return None if base_from_flange is None else np.asarray(base_from_flange @ np.asarray(first_guess))


def _lacking(session: Session, shot: Shot, what: str, remedy: str) -> DataError:
    return DataError(
        f"the shot has {what}",
        file=session.folder / "shots.jsonl",
        where=f"shot {shot.index}",
        remedy=f"{remedy}, or use a calibration made from sessions like this one.",
    )
