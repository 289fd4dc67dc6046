"""Models of the camera's error: a correction added to every measured point, linear in its coefficients.

    point_corrected = point_measured + sum_k coefficient_k * basis_k(point_measured) * e[axis_k]

Every basis function is scaled so that its coefficient is in mm and says what the term does at a stated place, which
keeps the solver's unknowns of like size (the paper's k are 1e-9 to 1e-18). Single coefficients are not identifiable;
the sum as a field is (METHOD.md 3), so only the field is ever reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.camera_error_field import PolynomialError, affine_error, box_of_points, default_field
from calibrate.camera_error_pillow import PILLOW_SCALE_MM, FreeCrossing, FullPillowError, PillowError
from calibrate.polynomials import Polynomials, monomials
from drivers.errors import FileError, SettingsError
from drivers.kinematics.se3 import FloatArray

__all__ = [
    "PILLOW_SCALE_MM",
    "CameraError",
    "FreeCrossing",
    "FullPillowError",
    "NoCameraError",
    "PillowError",
    "PolynomialError",
    "camera_error_from_settings",
    "camera_error_models",
    "correction_in_camera_mm",
    "correction_of_basis",
]

class CameraError(Protocol):
    """What the solver needs to know of a camera error model."""

    @property
    def name(self) -> str:
        """Short name, as on the command line."""
        ...

    @property
    def axis(self) -> NDArray[np.int64]:
        """(k,) the camera axis, 0 to 2, that each term moves a point along."""
        ...

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """(k,) standard deviation of each coefficient before any data, of physical size."""
        ...

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, k) values of the terms at points (n, 3)."""
        ...

    @property
    def polynomials(self) -> Polynomials:
        """The same terms as a table for the kernels."""
        ...

    def settings(self) -> dict[str, object]:
        """What a file must hold to make this model again with `camera_error_from_settings`."""
        ...


@dataclass(frozen=True, slots=True)
class NoCameraError:
    """The camera is taken as it measures."""

    name: str = "none"

    @property
    def axis(self) -> NDArray[np.int64]:
        """No term."""
        return np.zeros(0, dtype=np.int64)

    @property
    def prior_sigma_mm(self) -> FloatArray:
        """No term."""
        return np.zeros(0)

    def basis(self, points_in_camera_mm: ArrayLike) -> FloatArray:
        """(n, 0)."""
        return np.zeros((len(np.asarray(points_in_camera_mm)), 0))

    @property
    def polynomials(self) -> Polynomials:
        """An empty table."""
        return monomials((), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

    def settings(self) -> dict[str, object]:
        """Nothing to keep."""
        return {"model": "none"}


def correction_in_camera_mm(model: CameraError, coefficients_mm: ArrayLike, points_in_camera_mm: ArrayLike) -> FloatArray:
    """The correction (n, 3) in mm to be added to measured points (n, 3)."""
    return correction_of_basis(model, coefficients_mm, model.basis(points_in_camera_mm))


def correction_of_basis(model: CameraError, coefficients_mm: ArrayLike, basis: FloatArray) -> FloatArray:
    """The correction (n, 3) in mm where the basis (n, k) is at hand already."""
    values = basis * np.asarray(coefficients_mm, dtype=np.float64)
    result = np.zeros((len(basis), 3))
    for axis in range(3):
        chosen = model.axis == axis
        if chosen.any():
            result[:, axis] = values[:, chosen].sum(axis=1)
    return result


def camera_error_models(names: Sequence[str], *, points_in_camera_mm: FloatArray, sight_crossing_mm: tuple[float, float, float]) -> list[CameraError]:
    """Models by their command-line names, polynomial boxes laid around the points (n, 3) that were seen.

    Raises SettingsError for an unknown name.
    """
    box = box_of_points(points_in_camera_mm)
    pillow, full = PillowError(sight_crossing_mm), FullPillowError(sight_crossing_mm)
    made: dict[str, CameraError] = {
        "none": NoCameraError(),
        "affine": affine_error(box),
        "pillow": pillow,
        "pillow-free": FreeCrossing(pillow, (0.0,) * len(pillow.axis)),
        "pillow-full": full,
        "pillow-full-free": FreeCrossing(full, (0.0,) * len(full.axis)),
        "field": default_field(box),
    }
    unknown = [name for name in names if name not in made]
    if unknown:
        raise SettingsError(f"unknown camera error model {unknown[0]!r}", remedy=f"Choose one of auto, {', '.join(made)}.")
    return [made[name] for name in names]


def camera_error_from_settings(settings: Mapping[str, object], *, file: str | None = None) -> CameraError:
    """The model that `CameraError.settings` described; FileError when it describes none."""
    try:
        return _from_settings(settings)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            f"not a camera error model: {error}", file=file, where="camera_error", remedy="Calibrate again to write a whole file."
        ) from error


def _from_settings(settings: Mapping[str, object]) -> CameraError:
    match settings["model"]:
        case "none":
            return NoCameraError()
        case "pillow" | "pillow-full" as name:
            return _pillow(str(name), settings)
        case "pillow-free" | "pillow-full-free" as name:
            pillow = _pillow(str(name).removesuffix("-free"), settings)
            about = settings["about_mm"]
            if not isinstance(about, list | tuple) or len(about) != len(pillow.axis):
                raise ValueError(f"{about!r} is no list of {len(pillow.axis)} numbers")
            return FreeCrossing(pillow, tuple(float(k) for k in about), float(str(settings["crossing_sigma_mm"])))
        case "affine" | "field" as name:
            return PolynomialError(
                _triple(settings["centre_mm"]),
                _triple(settings["half_size_mm"]),
                int(str(settings["degree"])),
                int(str(settings["lateral_degree"])),
                float(str(settings["smoothness_mm"])),
                float(str(settings["lateral_smoothness_mm"])),
                str(name),
                # calibrations before there was a choice had none
                int(str(settings.get("decay", 1))),
            )
        case other:
            raise ValueError(f"unknown model {other!r}")


def _pillow(name: str, settings: Mapping[str, object]) -> PillowError | FullPillowError:
    kind = PillowError if name == "pillow" else FullPillowError
    return kind(_triple(settings["sight_crossing_mm"]), int(str(settings["n_terms"])))


def _triple(value: object) -> tuple[float, float, float]:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"{value!r} is no list of three numbers")
    return float(value[0]), float(value[1]), float(value[2])
