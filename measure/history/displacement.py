"""How far two calibrations of one robot put the same measured point from each other, over the work volume."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import numpy as np

from calibrate import Calibration
from calibrate.budget import views_at
from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

_GRID = (6, 6, 4)
_VIEWS = 2
_MARGIN_MM = 150.0


@dataclass(frozen=True, slots=True, eq=False)
class DisplacementField:
    """Motion of v measured points from the first calibration to the second, in the base."""

    first: str
    second: str
    region: str
    box_in_base_mm: FloatArray
    """(2, 3)."""
    points_in_base_mm: FloatArray
    """(v, 3) by the first."""
    displacement_mm: FloatArray
    """(v, 3)."""
    expanded_uncertainty_mm: FloatArray
    """(v,) of the displacement in its least certain direction, k = 2, as if the two calibrations had nothing in common."""
    shift_mm: FloatArray
    """(3,) and `turn_rad` (3,) of the rigid motion nearest to the field, about the middle of the points."""
    turn_rad: FloatArray
    rest_mm: FloatArray
    """(v, 3) what the rigid motion leaves: the change of shape and size."""
    hand_eye_mm: float
    hand_eye_rad: float

    @property
    def size_mm(self) -> FloatArray:
        """(v,)."""
        return np.asarray(np.linalg.norm(self.displacement_mm, axis=1))

    def to_json_dict(self) -> dict[str, object]:
        """The object that `--json` prints."""
        rest = np.linalg.norm(self.rest_mm, axis=1)
        return {
            "first": self.first,
            "second": self.second,
            "region": self.region,
            "box_in_base_mm": self.box_in_base_mm.tolist(),
            "n_points": len(self.size_mm),
            "rms_mm": float(np.sqrt((self.size_mm**2).mean())),
            "max_mm": float(self.size_mm.max()),
            "within_u": float((self.size_mm <= self.expanded_uncertainty_mm).mean()),
            "expanded_uncertainty_mm": float(np.median(self.expanded_uncertainty_mm)),
            "rigid": {"shift_mm": self.shift_mm.tolist(), "turn_rad": self.turn_rad.tolist()},
            "rest_rms_mm": float(np.sqrt((rest**2).mean())),
            "rest_max_mm": float(rest.max()),
            "hand_eye": {"shift_mm": self.hand_eye_mm, "turn_rad": self.hand_eye_rad},
            "points": [
                {"point_in_base_mm": p, "displacement_mm": d, "expanded_uncertainty_mm": u}
                for p, d, u in zip(
                    self.points_in_base_mm.round(3).tolist(),
                    self.displacement_mm.round(5).tolist(),
                    self.expanded_uncertainty_mm.round(5).tolist(),
                    strict=True,
                )
            ],
        }

    def to_csv(self) -> str:
        """A row for each point."""
        out = io.StringIO()
        table = csv.writer(out, lineterminator="\n")
        table.writerow([*(f"{a}_mm" for a in "xyz"), *(f"d{a}_mm" for a in "xyz"), "size_mm", "expanded_uncertainty_mm"])
        rows = np.column_stack([self.points_in_base_mm, self.displacement_mm, self.size_mm, self.expanded_uncertainty_mm])
        table.writerows([[f"{value:.5f}" for value in row] for row in rows])
        return out.getvalue()


def displacement_field(first: Calibration, second: Calibration) -> DisplacementField:
    """Look at places of the work volume as the first calibration's shots did, and move the same points by both.

    Raises:
        SettingsError: other robots, or calibrations without a robot or a camera.
    """
    _require_alike(first, second)
    region, box = _region(first)
    axes = [low + (np.arange(n) + 0.5) / n * (high - low) for low, high, n in zip(*box, _GRID, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    views = views_at(first, grid, np.random.default_rng(29), np.full(len(grid), _VIEWS))
    if views.joints_rad is None or not len(views.place):
        raise SettingsError(f"no view like those of the first calibration reaches its {region}", remedy="Compare calibrations of the same place.")
    points, joints = views.points_in_camera_mm, views.joints_rad
    at = first.points_in_base_mm(points, joints_rad=joints)
    moved = second.points_in_base_mm(points, joints_rad=joints) - at
    covariance = np.zeros((len(points), 3, 3))
    for calibration in (first, second):
        jacobian = calibration.point_jacobian(points, joints_rad=joints)
        part = calibration.covariance[: jacobian.shape[-1], : jacobian.shape[-1]]
        covariance += jacobian @ part @ np.swapaxes(jacobian, -1, -2)
    rigid, rest = _rigid_part(at, moved)
    bump = se3.log(second.flange_from_camera @ se3.inverse(first.flange_from_camera))
    return DisplacementField(
        first=first.id,
        second=second.id,
        region=region,
        box_in_base_mm=box,
        points_in_base_mm=at,
        displacement_mm=moved,
        expanded_uncertainty_mm=2 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0)),
        shift_mm=rigid[:3],
        turn_rad=rigid[3:],
        rest_mm=rest,
        hand_eye_mm=float(np.linalg.norm(second.flange_from_camera[:3, 3] - first.flange_from_camera[:3, 3])),
        hand_eye_rad=float(np.linalg.norm(bump[3:])),
    )


def _require_alike(first: Calibration, second: Calibration) -> None:
    if first.model is None or second.model is None:
        raise SettingsError("a calibration without a robot model has no field over the work volume", remedy="Compare calibrations with axis angles.")
    if "none" in (first.hand_eye, second.hand_eye):
        raise SettingsError("a calibration of the robot alone says nothing of where the camera sits", remedy="Compare calibrations that saw spheres.")
    if first.model.name != second.model.name or first.model.n_joints != second.model.n_joints:
        message = f"the calibrations are of different robots: {first.model.name} and {second.model.name}"
        raise SettingsError(message, remedy="Compare calibrations of one robot.")


def _region(calibration: Calibration) -> tuple[str, FloatArray]:
    if calibration.error_budget is not None:
        return calibration.error_budget.region, calibration.error_budget.box_in_base_mm
    centres = np.array(list(calibration.sphere_centres_in_base_mm.values()))
    return "surroundings of the spheres", np.array([centres.min(axis=0) - _MARGIN_MM, centres.max(axis=0) + _MARGIN_MM])


def _rigid_part(points: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    about = points - points.mean(axis=0)
    design = se3.point_columns(about).reshape(-1, 6)
    scale = np.array([1.0, 1, 1, 1e-3, 1e-3, 1e-3])
    rigid = np.linalg.lstsq(design * scale, moved.reshape(-1), rcond=None)[0] * scale
    return rigid, (moved.reshape(-1) - design @ rigid).reshape(-1, 3)
