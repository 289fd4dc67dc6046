"""What a camera can see: working range and field of view, and sphere centres drawn inside them.

Camera frame: x right, y down, z out. An area camera sees a pyramid about z; a line profile sensor sees the plane y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acquire.cell import CameraSection
from drivers.errors import SettingsError
from drivers.kinematics.se3 import FloatArray

# A profile further beside the centre than this is short, and its points are seen at a grazing angle.
_LARGEST_SIDE_OF_PROFILE = 0.7


@dataclass(frozen=True, slots=True)
class CameraView:
    """The space in which a camera measures, in its own frame."""

    working_range_mm: tuple[float, float]
    """Nearest and farthest depth z."""
    half_angle_rad: tuple[float, float]
    """Half the field of view, across (x) and down (y); y means nothing for a line profile."""
    kind: Literal["area", "line_profile"] = "area"

    @property
    def middle_mm(self) -> float:
        """Depth of the middle of the working range."""
        return 0.5 * (self.working_range_mm[0] + self.working_range_mm[1])


def camera_view(camera: CameraSection) -> CameraView:
    """The view of a cell's camera.

    Raises:
        SettingsError: the cell file does not tell working range or field of view.
    """
    missing = [name for name in ("working_range_mm", "field_of_view_deg") if getattr(camera, name) is None]
    if camera.working_range_mm is None or camera.field_of_view_deg is None:
        raise SettingsError(
            f"poses cannot be planned without {' and '.join(missing)} of the camera",
            where="camera",
            remedy="Add, from the data sheet, e.g. `working_range_mm: [250, 750]` and `field_of_view_deg: [55, 36]` to the cell file.",
        )
    across, down = np.radians(camera.field_of_view_deg) / 2
    return CameraView(camera.working_range_mm, (float(across), float(down)), camera.kind)


def sees_sphere(view: CameraView, centres_in_camera_mm: ArrayLike, radius_mm: float) -> NDArray[np.bool_]:
    """Whether spheres (..., 3) lie wholly in working range and field of view, shape (...).

    For a line profile: whether the whole circle that its plane cuts from the sphere does.
    """
    centres = np.asarray(centres_in_camera_mm, dtype=np.float64)
    x, y, z = (np.abs(centres[..., 0]), np.abs(centres[..., 1]), centres[..., 2])
    near, far = view.working_range_mm
    across, down = view.half_angle_rad
    if view.kind == "line_profile":
        circle = np.sqrt(np.maximum(radius_mm**2 - y**2, 0.0))
        inside = y <= _LARGEST_SIDE_OF_PROFILE * radius_mm
    else:
        circle = np.full_like(x, radius_mm)
        inside = z * np.sin(down) - y * np.cos(down) >= circle
    inside = inside & (z * np.sin(across) - x * np.cos(across) >= circle)
    return np.asarray(inside & (z - circle >= near) & (z + circle <= far))


def draw_centres(
    view: CameraView, radius_mm: float, n: int, rng: np.random.Generator, depth_mm: tuple[float, float] | None = None
) -> FloatArray:
    """Sphere centres (n, 3) in the camera: depth uniform, then uniform across the field of view at that depth, spheres wholly seen.

    Args:
        view: the camera.
        radius_mm: of the sphere.
        n: how many.
        rng: seeded by the caller.
        depth_mm: range of the centre's depth, cut to what the camera can see whole; all of it if None.

    Raises:
        SettingsError: the camera never sees the whole sphere (in that range).
    """
    low, high = whole_sphere_depths_mm(view, radius_mm)
    if depth_mm is not None:
        low, high = max(low, depth_mm[0]), min(high, depth_mm[1])
    if low > high:
        raise SettingsError(
            f"the camera never sees a sphere of radius {radius_mm:g} mm whole at the depths asked for",
            where="camera",
            remedy="Check working_range_mm and field_of_view_deg, or take a smaller sphere.",
        )
    z = rng.uniform(low, high, n)
    bounds = [z * np.tan(half) - radius_mm / np.cos(half) for half in view.half_angle_rad]
    if view.kind == "line_profile":
        bounds[1] = np.full(n, _LARGEST_SIDE_OF_PROFILE * radius_mm)
    x, y = (bound * rng.uniform(-1, 1, n) for bound in bounds)
    return np.stack([x, y, z], axis=-1)


def whole_sphere_depths_mm(view: CameraView, radius_mm: float) -> tuple[float, float]:
    """Least and largest depth at which the camera sees a whole sphere on its axis; the first is larger where there is none."""
    near, far = view.working_range_mm
    half_angles = view.half_angle_rad[:1] if view.kind == "line_profile" else view.half_angle_rad
    return max(near + radius_mm, radius_mm / float(np.sin(min(half_angles)))), far - radius_mm
