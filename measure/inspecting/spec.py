"""`inspection.yaml`: nominal features, how the part is aligned, what is judged (docs/inspect.md).

Everything is in the frame of the part, the frame of the nominal mesh, in mm; angles in the file are degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from drivers.files.disk import read_text
from drivers.files.schema import NotNegative, Positive, StrictModel, Text, TextPair, Transform, Vector3, check
from drivers.files.yaml import parse_yaml

_SMALLEST_DIRECTION = 1e-6


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _direction(value: object) -> object:
    value = _as_tuple(value)
    if isinstance(value, tuple) and len(value) == 3 and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value):
        length = float(np.linalg.norm(np.asarray(value, dtype=np.float64)))
        if not length > _SMALLEST_DIRECTION:
            msg = "a direction needs a length"
            raise ValueError(msg)
        return tuple(float(x) / length for x in value)
    return value


Direction = Annotated[tuple[float, float, float], BeforeValidator(_direction)]
Size = Annotated[tuple[Positive, Positive], BeforeValidator(_as_tuple)]


class _Feature(StrictModel):
    search_mm: Positive = 2.0
    """How far from the nominal a point may lie."""
    keep_from_edges_mm: NotNegative = 1.5
    """How much of the region's rim is left out: fused points at edges lie inside the material."""


class _RoundFeature(_Feature):
    least_seen_deg: Annotated[float, Field(gt=0, le=360)] = 90.0
    """Arc of the circumference that must be seen before anything is judged by the feature."""


class SphereFeature(_RoundFeature):
    """A sphere; with `axis` and `cap_deg` only the cap within that angle of the axis is used."""

    kind: Literal["sphere"]
    centre_mm: Vector3
    diameter_mm: Positive
    hole: bool = False
    axis: Direction = (0.0, 0.0, 1.0)
    cap_deg: Annotated[float, Field(gt=0, le=180)] = 180.0


class PlaneFeature(_Feature):
    """A rectangle of a plane about its centre; `size_mm` is along `direction` and across it."""

    kind: Literal["plane"]
    centre_mm: Vector3
    normal: Direction
    size_mm: Size
    direction: Direction | None = None


class CylinderFeature(_RoundFeature):
    """A round boss or bore, `length_mm` long, half of it on each side of the centre."""

    kind: Literal["cylinder"]
    centre_mm: Vector3
    axis: Direction
    diameter_mm: Positive
    length_mm: Positive
    hole: bool = False


class ConeFeature(_RoundFeature):
    """A cone of `diameter_mm` at its centre that opens towards its axis by the full angle; `length_mm` as for a cylinder."""

    kind: Literal["cone"]
    centre_mm: Vector3
    axis: Direction
    diameter_mm: Positive
    angle_deg: Annotated[float, Field(gt=1, lt=179)]
    length_mm: Positive
    hole: bool = False


class _Outline(_RoundFeature):
    centre_mm: Vector3
    axis: Direction
    """Normal of the outline's plane, out of the material."""
    hole: bool = True
    use: Literal["wall", "edge"] = "wall"
    """Points of the wall within `depth_mm` of the plane, or the rim of the surface that the hole is cut into."""
    depth_mm: Positive = 5.0


class CircleFeature(_Outline):
    """A circle in a plane."""

    kind: Literal["circle"]
    diameter_mm: Positive


class SlotFeature(_Outline):
    """A slot with round ends; `length_mm` is its whole length, along `direction`."""

    kind: Literal["slot"]
    direction: Direction
    width_mm: Positive
    length_mm: Positive

    @model_validator(mode="after")
    def _is_longer_than_wide(self) -> Self:
        if not self.length_mm > self.width_mm:
            msg = "a slot's length_mm must be more than its width_mm"
            raise ValueError(msg)
        if abs(float(np.dot(self.direction, self.axis))) > 1e-3:
            msg = "direction must lie in the plane: at right angles to axis"
            raise ValueError(msg)
        return self


Feature = Annotated[SphereFeature | PlaneFeature | CylinderFeature | ConeFeature | CircleFeature | SlotFeature, Field(discriminator="kind")]


class Alignment(StrictModel):
    """How the measured part is laid onto the nominal."""

    method: Literal["none", "datums", "best_fit"] = "none"
    base_from_part: Transform | None = None
    """Where the nominal stands in the base, for `none`; where to begin, for the others. Identity if left out."""
    primary: Text | None = None
    secondary: Text | None = None
    tertiary: Text | None = None

    @model_validator(mode="after")
    def _datums_are_named(self) -> Self:
        named = [self.primary, self.secondary, self.tertiary]
        if (self.method == "datums") != all(named) or (self.method != "datums" and any(named)):
            msg = "the method datums takes primary, secondary and tertiary; no other method does"
            raise ValueError(msg)
        if all(named) and len(set(named)) < 3:
            msg = "primary, secondary and tertiary must be three features"
            raise ValueError(msg)
        return self


class Surface(StrictModel):
    """How much farther out the camera sees this material than a probe would; unknown part as U (k = 2)."""

    offset_mm: float = 0.0
    expanded_uncertainty_mm: NotNegative = 0.0


class _Check(StrictModel):
    name: Text | None = None
    nominal: float | None = None
    """mm, or degrees of an angle; the feature's own nominal where it is left out."""
    tolerance: Positive | None = None
    """Plus or minus; for form, position and profile the whole zone."""
    lower: float | None = None
    """Least and greatest allowed deviation from the nominal, instead of `tolerance`."""
    upper: float | None = None

    @model_validator(mode="after")
    def _has_one_tolerance(self) -> Self:
        pair = self.lower is not None and self.upper is not None
        if (self.tolerance is not None) == pair or (self.lower is None) != (self.upper is None):
            msg = "give tolerance, or lower and upper"
            raise ValueError(msg)
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            msg = "lower must be less than upper"
            raise ValueError(msg)
        return self


class SizeCheck(_Check):
    """One number of one feature."""

    kind: Literal["diameter", "width", "length", "x", "y", "z", "angle"]
    """`angle`: the full angle of a cone; x, y, z: of the feature's centre."""
    feature: Text


class ZoneCheck(_Check):
    """Form (flatness of a plane, roundness of a circle, ...) or true position: zero at best, `tolerance` at most."""

    kind: Literal["flatness", "form", "position"]
    feature: Text

    @model_validator(mode="after")
    def _has_a_zone(self) -> Self:
        if self.tolerance is None or self.nominal is not None:
            msg = "takes tolerance, and neither nominal nor lower and upper"
            raise ValueError(msg)
        return self


class PairCheck(_Check):
    """Distance or angle between two features; a distance along x, y or z of the part where `along` says so."""

    kind: Literal["distance", "angle_between"]
    between: TextPair
    along: Literal["x", "y", "z"] | None = None


class ProfileCheck(_Check):
    """The share `quantile` of the surface keeps within plus or minus `tolerance` of the nominal mesh."""

    kind: Literal["profile"]
    quantile: Annotated[float, Field(gt=0, le=1)] = 0.99


Check = Annotated[SizeCheck | ZoneCheck | PairCheck | ProfileCheck, Field(discriminator="kind")]


class InspectionSpec(StrictModel):
    """The file."""

    format: Literal["spherecal-inspection/1"]
    name: Text = "inspection"
    alignment: Alignment = Alignment()
    point_expanded_uncertainty_mm: Positive | None = None
    """U (k = 2) of one coordinate of a point that averaging does not lower, where neither the cloud nor a calibration tells it."""
    surface: Surface = Surface()
    deviation_limit_mm: Positive = 5.0
    """Points farther than this from the nominal belong to something else."""
    features: Mapping[Text, Feature] = {}
    checks: Annotated[tuple[Check, ...], BeforeValidator(_as_tuple)] = ()

    @model_validator(mode="after")
    def _names_exist(self) -> Self:
        for place, name in self._named():
            if name not in self.features:
                msg = f"{place} names the feature {name!r}, which is not among: {', '.join(self.features) or 'none'}"
                raise ValueError(msg)
        return self

    def _named(self) -> list[tuple[str, str]]:
        datums = [("alignment", name) for name in (self.alignment.primary, self.alignment.secondary, self.alignment.tertiary) if name]
        found = list(datums)
        for number, one in enumerate(self.checks):
            if isinstance(one, PairCheck):
                found += [(f"checks.{number}", name) for name in one.between]
            elif not isinstance(one, ProfileCheck):
                found.append((f"checks.{number}", one.feature))
        return found


def load_spec(path: str | Path) -> InspectionSpec:
    """Read an inspection.yaml.

    Raises:
        FileError: missing, no YAML, or something in it is not allowed.
    """
    text = read_text(path)
    return check(InspectionSpec, parse_yaml(text, file=str(path)), file=str(path), text=text)
