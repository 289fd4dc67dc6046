"""Certified sizes at the temperature they were seen at, and how well that is known.

A certificate holds at its reference temperature, 20 degrees C unless it says otherwise (ISO 1). At T a size L of expansion
coefficient alpha is L (1 + alpha (T - T_ref)). Its standard uncertainty joins the certificate's with the two thermal parts of
the end gauge in the GUM (JCGM 100, example H.1): alpha L u(T) and L |T - T_ref| u(alpha). A size without alpha stays as it is.

The temperature is that of the sensor `artefact`, else that of the air. Other sensors, a camera's housing or an arm's axes,
are warmer than anything that stands beside them and tell nothing of the artefact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from acquire.cell import Cell, CertifiedLength, Sphere
from drivers.errors import DataError
from drivers.files.session import Session, Shot

ARTEFACT_SENSOR = "artefact"
AIR_SENSORS = ("air", "ambient", "room")
_SENSOR_K, _AIR_K, _UNKNOWN_K = 0.5, 1.0, 2.0
"""Standard uncertainties: sensor on the artefact; air, which a heavy artefact lags behind; no sensor, about the reference."""
_RELATIVE_CTE = 0.1
_REFERENCE_C = 20.0
_OTHER_K = 5.0
_COLDEST_C, _WARMEST_C = -50.0, 100.0
_Certified = TypeVar("_Certified", Sphere, CertifiedLength)


@dataclass(frozen=True, slots=True)
class Temperature:
    """Of an artefact, while some shots were taken."""

    celsius: float
    standard_uncertainty_k: float
    sensor: str
    """`artefact` or `air`."""


@dataclass(frozen=True, slots=True)
class Growth:
    """What temperature does to one certified size."""

    size_mm: float
    """As certified."""
    change_mm: float
    standard_uncertainty_mm: float
    """The thermal part alone."""
    temperature: Temperature | None
    """None where no shot tells it: the size is then left as certified."""
    reference_c: float


@dataclass(frozen=True, slots=True)
class Artefact:
    """Spheres and lengths as they were when they were seen, and what is worth telling of it."""

    spheres: dict[str, Sphere]
    lengths: tuple[CertifiedLength, ...]
    notes: tuple[str, ...]


def artefact_temperature(shots: Iterable[Shot]) -> Temperature | None:
    """Median over the shots that tell it, the sensor `artefact` before the air; None where none does.

    What the readings scatter by joins the uncertainty: one size stands for all shots.

    Raises:
        DataError: a reading that no workshop has, such as one in kelvin.
    """
    seen = list(shots)
    for sensor, names, sigma_k in (("artefact", (ARTEFACT_SENSOR,), _SENSOR_K), ("air", AIR_SENSORS, _AIR_K)):
        told = [float(np.mean(found)) for shot in seen if (found := [_workshop_c(shot, name) for name in names if name in shot.temperatures_c])]
        if told:
            return Temperature(float(np.median(told)), float(np.hypot(sigma_k, np.std(told))), sensor)
    return None


def growth(size_mm: float, cte_per_k: float, reference_c: float, temperature: Temperature | None) -> Growth:
    """Change of a size and the standard uncertainty of that change; where the temperature is unknown, about the reference."""
    off_k = 0.0 if temperature is None else temperature.celsius - reference_c
    sigma_k = _UNKNOWN_K if temperature is None else temperature.standard_uncertainty_k
    sigma_mm = abs(size_mm * cte_per_k) * float(np.hypot(sigma_k, _RELATIVE_CTE * off_k))
    return Growth(size_mm, size_mm * cte_per_k * off_k, sigma_mm, temperature, reference_c)


def artefact_when_seen(
    spheres: Mapping[str, Sphere], lengths: Sequence[CertifiedLength], sessions: Sequence[Session], *, used_together: bool = False
) -> Artefact:
    """Spheres and lengths with their sizes and uncertainties at the temperature of the shots that show them.

    What is corrected has no `cte_per_k` any more, so a second correction changes nothing.

    Args:
        spheres: by name.
        lengths: between them.
        sessions: whose shots tell the temperature.
        used_together: the lengths enter one solve as if their errors were independent, which thermal errors are not: these
            are then stated wider by the root of the number of lengths, with which no combination of lengths is stated too well.

    Raises:
        DataError: as `artefact_temperature`.
    """
    shots = {name: [shot for session in sessions for shot in session.shots if shot.status == "ok" and shot.sphere == name] for name in spheres}
    n_together = sum(length.cte_per_k is not None for length in lengths) if used_together else 1
    of_spheres = {name: _when_seen(sphere, "diameter_mm", shots[name]) for name, sphere in spheres.items()}
    of_lengths = [_when_seen(x, "length_mm", _of_both(shots[x.between[0]], shots[x.between[1]]), n_together) for x in lengths]
    notes = _notes("lengths", [grown for _, grown in of_lengths]) or _notes("diameters", [grown for _, grown in of_spheres.values()])
    return Artefact({name: sphere for name, (sphere, _) in of_spheres.items()}, tuple(length for length, _ in of_lengths), notes)


def cell_when_seen(cell: Cell, sessions: Sequence[Session], *, uses_lengths: bool = True) -> tuple[Cell, tuple[str, ...]]:
    """The cell with sizes for one solve of these sessions (see `artefact_when_seen`), and notes of those that the solve uses."""
    artefact = artefact_when_seen(cell.spheres, cell.lengths, sessions, used_together=True)
    notes = artefact.notes if uses_lengths else artefact_when_seen(cell.spheres, (), sessions).notes
    return cell.model_copy(update={"spheres": artefact.spheres, "lengths": artefact.lengths}), notes


def temperature_ranges_c(sessions: Sequence[Session]) -> dict[str, tuple[float, float]]:
    """Least and greatest reading of every sensor."""
    return {name: (min(readings), max(readings)) for name, readings in sorted(_readings(sessions).items())}


def temperature_changes(ranges_c: Mapping[str, tuple[float, float]], sessions: Sequence[Session]) -> tuple[str, ...]:
    """A note for every sensor whose median lies more than 5 K outside the range that a calibration saw."""
    notes = []
    for name, readings in sorted(_readings(sessions).items()):
        low, high = ranges_c.get(name, (-np.inf, np.inf))
        now = float(np.median(readings))
        if max(low - now, now - high) > _OTHER_K:
            notes.append(f"temperature {name}: {now:.1f} C, and the calibration saw {low:.1f} to {high:.1f} C; arm and camera may have changed")
    return tuple(notes)


def _workshop_c(shot: Shot, sensor: str) -> float:
    celsius = shot.temperatures_c[sensor]
    if not _COLDEST_C < celsius < _WARMEST_C:
        raise DataError(
            f"the sensor {sensor} reads {celsius:g} degrees C",
            file="shots.jsonl",
            where=f"shot {shot.index}",
            remedy="Give temperatures_c in degrees Celsius, or take the reading out of the line.",
        )
    return celsius


def _of_both(first: list[Shot], second: list[Shot]) -> list[Shot]:
    """Shots of a length: those of its ends, none where an end was not seen."""
    return first + second if first and second else []


def _when_seen(certified: _Certified, size: str, shots: Sequence[Shot], n_together: int = 1) -> tuple[_Certified, Growth | None]:
    if certified.cte_per_k is None or not shots:
        return certified, None
    reference_c = _REFERENCE_C if certified.reference_temperature_c is None else certified.reference_temperature_c
    grown = growth(getattr(certified, size), certified.cte_per_k, reference_c, artefact_temperature(shots))
    restated = {
        size: grown.size_mm + grown.change_mm,
        "expanded_uncertainty_mm": 2.0 * float(np.hypot(certified.expanded_uncertainty_mm / 2.0, grown.standard_uncertainty_mm * n_together**0.5)),
        "cte_per_k": None,
        "reference_temperature_c": reference_c if grown.temperature is None else grown.temperature.celsius,
    }
    return certified.model_copy(update=restated), grown


def _notes(what: str, grown: Sequence[Growth | None]) -> tuple[str, ...]:
    known = [(g, g.temperature) for g in grown if g is not None and g.temperature is not None]
    unknown = [g for g in grown if g is not None and g.temperature is None]
    notes = []
    if known:
        longest = max((g for g, _ in known), key=lambda g: g.size_mm)
        celsius = sorted(temperature.celsius for _, temperature in known)
        span = " to ".join(dict.fromkeys(f"{c:.1f}" for c in (celsius[0], celsius[-1])))
        sensors = " and ".join(sorted({temperature.sensor for _, temperature in known}))
        notes.append(f"{what} corrected to {span} C of the {sensors} ({1e3 * longest.change_mm:+.1f} um on {longest.size_mm:.0f} mm)")
    if unknown:
        longest = max(unknown, key=lambda g: g.size_mm)
        wide = f"1 sigma {1e3 * longest.standard_uncertainty_mm:.1f} um on {longest.size_mm:.0f} mm"
        notes.append(f"{what} taken as at {longest.reference_c:g} C, {_UNKNOWN_K:g} K uncertain ({wide}): no shot tells the artefact's temperature")
    return tuple(notes)


def _readings(sessions: Sequence[Session]) -> dict[str, list[float]]:
    readings: dict[str, list[float]] = {}
    for shot in (shot for session in sessions for shot in session.shots if shot.status == "ok"):
        for name, celsius in shot.temperatures_c.items():
            readings.setdefault(name, []).append(celsius)
    return readings
