"""What is measured: functions of all fitted features together, with gradients and so uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drivers.errors import FileError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.inspecting.alignment import datum_alignment
from measure.inspecting.fitting import Fit
from measure.inspecting.geometry import Element, angle_deg, distance_mm, element_of, nominal_element, offset_from
from measure.inspecting.shapes import Shape
from measure.inspecting.spec import Feature, InspectionSpec, PairCheck, ProfileCheck, SizeCheck, ZoneCheck
from measure.inspecting.uncertainty import JointCovariance

Elements = Mapping[str, Element]
Function = Callable[[Elements], FloatArray]

_STEP = 1e-5
"""Of every parameter, mm or rad, for central differences."""
_COVERAGE = {1: 1.0, 2: 1.249, 3: 1.426}
"""95 % of the length of a vector of so many normal components, over that of one component."""
_SIZES = {"diameter": "diameter_mm", "width": "width_mm", "length": "length_mm", "angle": "angle_deg"}
_SMALL_ANGLE_DEG = 45.0


@dataclass(frozen=True, slots=True, eq=False)
class Quantity:
    """One figure to measure."""

    name: str
    unit: str
    features: tuple[str, ...]
    function: Function
    """(1,), or the vector whose length is the figure."""
    is_length: bool = False
    scale: float = 1.0
    """The figure is the value, or the length, times this."""

    def value(self, elements: Elements) -> float:
        """The figure."""
        found = self.function(elements)
        return self.scale * (float(np.linalg.norm(found)) if self.is_length else float(found[0]))


class Change(NamedTuple):
    """A small step of one parameter."""

    column: int
    sign: int


AS_FITTED = Change(-1, 0)


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A figure with its standard uncertainty: half of an interval that holds 95 %."""

    value: float
    standard_uncertainty: float


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """All fits as one vector of parameters, and the aligned features as a function of it."""

    features: Mapping[str, Feature]
    fits: Mapping[str, Fit]
    datums: tuple[str, ...] = ()
    """Names of the three datums; none for other alignments."""
    has_pose: bool = False
    """Whether six parameters of the alignment's own follow those of the fits."""
    _start: dict[str, int] = field(default_factory=dict)
    _alignments: dict[Change, FloatArray] = field(default_factory=dict)
    _aligned: dict[tuple[str, Change], Element] = field(default_factory=dict)

    def __post_init__(self) -> None:
        at = 0
        for name, fit in self.fits.items():
            self._start[name] = at
            at += len(fit.params)

    @property
    def params(self) -> FloatArray:
        """(P,)."""
        pose = [np.zeros(6)] if self.has_pose else []
        return np.concatenate([*(fit.params for fit in self.fits.values()), *pose]) if self.fits or pose else np.zeros(0)

    def elements(self, names: Sequence[str], change: Change = AS_FITTED) -> dict[str, Element]:
        """Features in the aligned frame of the part, with one parameter changed. Each is worked out once for all figures."""
        return {name: self._aligned_element(name, change) for name in names}

    def nominal(self, names: Sequence[str]) -> dict[str, Element]:
        """Features as drawn."""
        return {name: self._nominal(name) for name in names}

    def alignment(self) -> FloatArray:
        """(4, 4) what the datums still move the part by."""
        return self._alignment(AS_FITTED) if self.datums else np.eye(4)

    def measure(self, quantity: Quantity, covariance: JointCovariance) -> Measured:
        """A figure and how well it is known."""
        known = covariance.of(self._gradient(quantity))
        value = quantity.value(self.elements(quantity.features))
        if not quantity.is_length:
            return Measured(value, quantity.scale * float(np.sqrt(max(known[0, 0], 0.0))))
        # at a length of nearly nothing no direction is told, so the worst one counts
        sizes = np.maximum(np.linalg.eigvalsh(known), 0.0)
        dimensions = min(3, max(1, int((sizes > 0.01 * sizes[-1]).sum())))
        return Measured(value, quantity.scale * _COVERAGE[dimensions] * float(np.sqrt(sizes[-1])))

    def _gradient(self, quantity: Quantity) -> FloatArray:
        """(m, P)."""
        n_params = len(self.params)
        columns = [i for name in dict.fromkeys([*quantity.features, *self.datums]) for i in self._columns(name)]
        columns += list(range(n_params - 6, n_params)) if self.has_pose else []
        rows = []
        for column in columns:
            after, before = (quantity.function(self.elements(quantity.features, Change(column, sign))) for sign in (1, -1))
            rows.append((after - before) / (2 * _STEP))
        result = np.zeros((len(rows[0]), n_params))
        result[:, columns] = np.array(rows).T
        return result

    def _nominal(self, name: str) -> Element:
        return nominal_element(self.features[name], self.fits[name].shape)

    def _columns(self, name: str) -> range:
        return range(self._start[name], self._start[name] + len(self.fits[name].params))

    def _aligned_element(self, name: str, change: Change) -> Element:
        if change.column not in self._columns(name) and not self._moves_all(change):
            change = AS_FITTED
        if (name, change) not in self._aligned:
            aligned = self._alignment(change if self._moves_all(change) else AS_FITTED)
            # an axis has its place and a cone its diameter at the nominal centre of the part as aligned, not as it lay
            self._aligned[name, change] = self._element(name, change).moved(aligned).passing(self._nominal(name))
        return self._aligned[name, change]

    def _moves_all(self, change: Change) -> bool:
        """Whether the alignment hangs on the parameter."""
        if self.has_pose and not self.datums:
            return change.column >= len(self.params) - 6
        return any(change.column in self._columns(name) for name in self.datums)

    def _alignment(self, change: Change) -> FloatArray:
        if change not in self._alignments:
            if self.datums:
                found = {name: self._element(name, change) for name in self.datums}
                self._alignments[change] = datum_alignment(self.datums, found, self.nominal(self.datums))
            else:
                self._alignments[change] = se3.exp(self._changed(change)[-6:]) if self.has_pose else np.eye(4)
        return self._alignments[change]

    def _element(self, name: str, change: Change) -> Element:
        columns = self._columns(name)
        return element_of(self.features[name], self.fits[name].shape, self._changed(change)[columns.start : columns.stop])

    def _changed(self, change: Change) -> FloatArray:
        params = self.params
        if change.sign:
            params[change.column] += change.sign * _STEP
        return params


def own_quantities(name: str, element: Element) -> list[Quantity]:
    """What is told of every feature: its place and its sizes; of a plane how far and how much it is off its nominal."""
    if element.kind == "plane":
        offset = Quantity("offset", "mm", (name,), lambda e: np.array([float(element.axis @ (e[name].point_mm - element.point_mm))]))
        return [offset, Quantity("tilt", "deg", (name,), lambda e: _turn_deg(element, e[name]), is_length=True)]
    found = [_coordinate(name, axis) for axis in "xyz"]
    return found + [_size(name, what, attribute) for what, attribute in _SIZES.items() if getattr(element, attribute) is not None]


def quantity_of_check(check: SizeCheck | ZoneCheck | PairCheck, nominal: Elements) -> Quantity:
    """What a check measures; not for form, which is no function of the parameters."""
    if isinstance(check, SizeCheck):
        return _coordinate(check.feature, check.kind) if check.kind in "xyz" else _size(check.feature, check.kind, _SIZES[check.kind])
    if isinstance(check, ZoneCheck):
        drawn = nominal[check.feature]
        name = check.feature
        # true position: the diameter of the zone that just holds the feature
        return Quantity("position", "mm", (name,), lambda e: offset_from(e[name], drawn), is_length=True, scale=2.0)
    return _between(check, nominal)


def _between(check: PairCheck, nominal: Elements) -> Quantity:
    a, b = check.between
    if check.kind == "distance":
        return Quantity("distance", "mm", (a, b), lambda e: np.array([distance_mm(e[a], e[b], check.along)]))
    if angle_deg(nominal[a], nominal[b]) < _SMALL_ANGLE_DEG:
        return Quantity("angle", "deg", (a, b), lambda e: _turn_deg(e[a], e[b]), is_length=True)
    return Quantity("angle", "deg", (a, b), lambda e: np.array([angle_deg(e[a], e[b])]))


def _turn_deg(first: Element, second: Element) -> FloatArray:
    """The rotation vector (3,) from one axis to the other, degrees."""
    across = np.cross(first.axis, second.axis)
    sine = float(np.linalg.norm(across))
    return np.asarray(np.degrees(across * (np.arcsin(min(sine, 1.0)) / sine if sine > 1e-12 else 1.0)))


def _coordinate(name: str, axis: str) -> Quantity:
    index = "xyz".index(axis)
    return Quantity(axis, "mm", (name,), lambda e: e[name].point_mm[index : index + 1])


def _size(name: str, what: str, attribute: str) -> Quantity:
    unit = "deg" if attribute.endswith("_deg") else "mm"
    return Quantity(what, unit, (name,), lambda e: np.array([float(getattr(e[name], attribute))]))


def require_checks_fit(spec: InspectionSpec, shapes: Mapping[str, Shape]) -> None:
    """Refuse checks of what a feature does not have.

    Raises:
        FileError: names the check.
    """
    elements = {name: nominal_element(feature, shapes[name]) for name, feature in spec.features.items()}
    for number, check in enumerate(spec.checks):
        where = f"checks.{number}"
        if isinstance(check, SizeCheck) and check.kind in _SIZES and getattr(elements[check.feature], _SIZES[check.kind]) is None:
            what = elements[check.feature].kind
            raise FileError(f"a {what} has no {check.kind}", where=where, remedy=f"{check.feature} is a {what}.")
        if isinstance(check, ZoneCheck) and check.kind == "flatness" and elements[check.feature].kind != "plane":
            raise FileError("flatness is of planes", where=where, remedy="Use `form`.")
        if isinstance(check, ProfileCheck) and (check.nominal is not None or check.tolerance is None):
            raise FileError("a profile takes tolerance alone", where=where, remedy="Leave nominal, lower and upper out.")
        if isinstance(check, PairCheck):
            _require_pair_fits(check, elements, where)


def _require_pair_fits(check: PairCheck, elements: Elements, where: str) -> None:
    kinds = {elements[name].kind for name in check.between}
    if check.between[0] == check.between[1]:
        raise FileError("names one feature twice", where=where, remedy="Name two.")
    if check.kind == "angle_between" and "sphere" in kinds:
        raise FileError("a sphere has no direction", where=where, remedy="Name a plane, an axis or an outline.")
    if check.kind == "angle_between" and check.along is not None:
        raise FileError("`along` belongs to distances", where=where, remedy="Leave it out.")
