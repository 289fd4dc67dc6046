"""What the paper prints about its figures 5 to 8, 10 and 11, beside the same of this run.

Its plots carry no numbers that can be copied, and nothing here is read off a plot. Some figures are told in a sentence, and
for two the printed matrices and k's say what single dots must have been; each row names its source.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibrate.study_cell import PAPER_K, SIGHT_CROSSING_MM
from calibrate.study_data import Cell, Panel, StudyFigure, StudyTable
from calibrate.study_methods import LABELS
from calibrate.study_paper import (
    CAMERA_ERROR_MAX_MM,
    DIAMETER_ERROR_BELOW_MM,
    HAND_EYE_BEFORE_MM,
    HAND_EYE_FOUND_MM,
    HAND_EYE_TRUE_MM,
    HARDWARE_HAND_EYE_MM,
    HARDWARE_K,
    NEGATIVE_EFFECT_MM,
    SIMULATED_K,
)
from drivers.kinematics.se3 import FloatArray

COLUMNS = ("what", "printed", "ours", "comparable", "why")
_DATUM = "a datum: e_mean is mostly a shift of the base frame, which such data do not fix"
_SPLIT = "last link and hand-eye are one displacement: how it is split is the solver's choice"
_HARDWARE = "hardware: another camera error than the simulation's"
_POSES = "other poses, which the paper does not give"
_OTHER_SIGN = "ours with the other sign of k"
_CERTIFIED = "certified"

Row = tuple[Cell, ...]


def printed_tables(figures: Sequence[StudyFigure], tables: Sequence[StudyTable], places_in_camera_mm: FloatArray) -> tuple[StudyTable, ...]:
    """A table `printed_figureN` for each of the figures; k's are taken at places (m, 3), the tests of Figs 6 and 10."""
    by_name = {figure.name: {panel.title: panel for panel in figure.panels} for figure in figures}
    sweeps = {table.name: table for table in tables}
    rows = {
        "5": _diameters(by_name["figure5"]),
        "6": _residuals(by_name["figure6"], places_in_camera_mm),
        "7": _noise(sweeps["figure7"]),
        "8": _camera(sweeps["figure8"]),
        "10": _compensations(by_name["figure10"], places_in_camera_mm),
        "11": _corrected(by_name["figure11"]),
    }
    return tuple(StudyTable(f"printed_figure{number}", COLUMNS, tuple(found)) for number, found in rows.items())


def _diameters(panels: dict[str, Panel]) -> list[Row]:
    seen, other = "as measured", "k of the other sign"
    error = {label: np.concatenate([_y(p, label) - _y(p, _CERTIFIED) for p in panels.values()]) for label in (seen, other)}
    along = {axis: _y(panels[f"along {axis}"], other) for axis in "xyz"}
    change = {axis: f"{_trend(y)}, by {np.ptp(y):.3f} mm" for axis, y in along.items()}
    sides = f"{_side(error[seen])} with the simulation's k, {_side(error[other])} with the other sign"
    largest = float(np.abs(error[other]).max())
    more = "eq. 5 gives another course: the hardware has errors beside it, as section 5 says"
    return [
        ("largest error of the diameter, mm (section 4.1)", f"below {DIAMETER_ERROR_BELOW_MM}", largest, "in size", _HARDWARE),
        (
            "sign of the error (section 2.2)",
            "larger everywhere",
            sides,
            "no",
            "the k of the hardware (Table 4) has the other sign",
        ),
        ("with growing z (section 2.2)", "decreases obviously", change["z"], "yes", _OTHER_SIGN),
        ("with growing x (section 2.2)", "decreases, then increases slightly", change["x"], "no", more),
        ("with y (section 2.2)", "not related", change["y"], "yes", _OTHER_SIGN),
    ]


def _residuals(panels: dict[str, Panel], places_mm: FloatArray) -> list[Row]:
    hand_eye, camera = panels["hand-eye"], panels["camera"]
    left = np.add(SIMULATED_K, PAPER_K)
    return [
        (
            "camera error added, largest, mm (6d; section 4.1)",
            CAMERA_ERROR_MAX_MM,
            float(_y(camera, LABELS["3"]).max()),
            "in size",
            "it grows with the fifth power of the distance from S: " + _POSES,
        ),
        (
            "camera error left by method 1, largest, mm (6d; k of Table 2 at our places)",
            float(np.abs(_dz(places_mm, left)).max()),
            float(_y(camera, LABELS["1"]).max()),
            "in size",
            "single k's mean little, their sum does; " + _POSES,
        ),
        (
            "hand-eye error before, mm (6c; printed matrices)",
            _apart(HAND_EYE_BEFORE_MM, HAND_EYE_TRUE_MM),
            float(_y(hand_eye, LABELS["3"])[0]),
            "yes",
            "the printed first guess is what ours starts from",
        ),
        (
            "hand-eye error left by method 1, mm (6c; printed matrices)",
            _apart(HAND_EYE_FOUND_MM, HAND_EYE_TRUE_MM),
            float(_y(hand_eye, LABELS["1"])[0]),
            "no",
            _SPLIT,
        ),
    ]


def _noise(table: StudyTable) -> list[Row]:
    return [
        ("method 1 below method 3 (section 3.2)", "at every level", _below(table, "1"), "no", _DATUM),
        ("method 2 below method 3 (section 3.2)", "similar", _below(table, "2"), "no", _DATUM),
        ("method 4 below method 3 (section 3.2)", "only when the noise is small", _below(table, "4"), "no", _DATUM),
        _by_spread(table),
    ]


def _camera(table: StudyTable) -> list[Row]:
    sizes = np.array(table.column(table.columns[0]), dtype=np.float64)
    worse = sizes[_series(table, "2", "e_mean") > _series(table, "3", "e_mean")]
    return [
        ("method 1 below method 3 (section 3.3)", "at every size", _below(table, "1"), "no", _DATUM),
        (
            "mean camera error from which method 2 is worse than none, mm (section 3.3)",
            f"above {NEGATIVE_EFFECT_MM}",
            f"first seen at {worse.min():.3f}" if len(worse) else f"not up to {sizes.max():.3f}",
            "no",
            _DATUM,
        ),
        ("method 4 below method 3 (section 3.3)", "only when the error is small", _below(table, "4"), "no", _DATUM),
        _by_spread(table),
    ]


def _compensations(panels: dict[str, Panel], places_mm: FloatArray) -> list[Row]:
    typical = {part: float(np.median(_y(panel, LABELS["1"]))) for part, panel in panels.items()}
    order = " > ".join(sorted(typical, key=lambda part: -typical[part]))
    return [
        ("order of size (section 4.1)", "robot > hand-eye > camera", order, "no", f"{_HARDWARE}; {_SPLIT}"),
        ("hand-eye, mm (printed matrices)", _apart(*HARDWARE_HAND_EYE_MM), typical["hand-eye"], "no", f"{_HARDWARE}; {_SPLIT}"),
        (
            "camera, median, mm (k of Table 4 at our places)",
            float(np.median(np.abs(_dz(places_mm, np.array(HARDWARE_K))))),
            typical["camera"],
            "in size",
            _HARDWARE,
        ),
        ("robot, median, mm", None, typical["robot"], "no", "no figure is printed"),
    ]


def _corrected(panels: dict[str, Panel]) -> list[Row]:
    labels = {"as measured": "as measured", "1": f"corrected, {LABELS['1']}", "clouds": f"corrected, {LABELS['clouds']}"}
    largest = {k: max(float(np.abs(_y(p, label) - _y(p, _CERTIFIED)).max()) for p in panels.values()) for k, label in labels.items()}
    said = f"{largest['as measured']:.3f} before, {largest['1']:.3f} after"
    return [
        ("largest deviation of the diameter, method 1, mm (section 4.1)", "closer to 38.1, not completely eliminated", said, "in size", _HARDWARE),
        ("the same, whole clouds, mm", None, largest["clouds"], "no", "not in the paper"),
    ]


def _y(panel: Panel, label: str) -> FloatArray:
    return next(curve.y for curve in panel.curves if curve.label == label)


def _dz(places_mm: FloatArray, k: FloatArray) -> FloatArray:
    """(m,) eq. 5."""
    x, z = places_mm[:, 0] - SIGHT_CROSSING_MM[0], places_mm[:, 2] - SIGHT_CROSSING_MM[2]
    r2 = x * x + z * z
    return np.asarray(z * sum(coefficient * r2 ** (i + 1) for i, coefficient in enumerate(k)))


def _apart(first: Sequence[float], second: Sequence[float]) -> float:
    return float(np.linalg.norm(np.subtract(first, second)))


def _side(error_mm: FloatArray) -> str:
    if (error_mm > 0).all():
        return "larger everywhere"
    return "smaller everywhere" if (error_mm < 0).all() else f"{error_mm.min():+.3f} to {error_mm.max():+.3f} mm"


def _trend(values: FloatArray) -> str:
    """A curve in words: where it falls and rises."""
    least, most = int(values.argmin()), int(values.argmax())
    if least == len(values) - 1 and most == 0:
        return "decreases"
    if least == 0 and most == len(values) - 1:
        return "increases"
    if 0 < least < len(values) - 1:
        return "decreases, then increases" + (" slightly" if values[-1] - values[least] < 0.25 * (values[0] - values[least]) else "")
    return "increases, then decreases"


def _series(table: StudyTable, method: str, figure: str) -> FloatArray:
    return np.array(table.column(f"{figure}_{method}_mm"), dtype=np.float64)


def _by_spread(table: StudyTable) -> Row:
    ours = ", ".join(_below(table, method, "rms_about_mean") for method in "124")
    return ("the same by rms about the mean, methods 1, 2, 4", None, ours, "no", "not in the paper")


def _below(table: StudyTable, method: str, figure: str = "e_mean") -> str:
    below = _series(table, method, figure) < _series(table, "3", figure)
    return f"{int(below.sum())} of {len(below)}"
