"""The control chart of a cell's quick checks: a table, and one page with the curves."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from measure.history.marks import moment
from measure.history.rows import ActivationRow, CalibrationRow, ResultRow

_COLOURS = {"conform": "#1f6f8b", "not_proven": "#9ca3af", "reject": "#b3261e"}


@dataclass(frozen=True, slots=True)
class ChartPoint:
    """One check on the chart."""

    taken_utc: str
    calibration: str
    verdict: str
    named: str
    p_value: float | None
    chi_square_ratio: float | None
    """Chi-square over its freedom: about 1 where nothing changed."""
    rms_mm: float | None
    expected_rms_mm: float | None
    amounts: Mapping[str, tuple[float, float]]
    """Estimate and standard uncertainty of each change, as if it were the only one: axes in rad, the rest in mm."""


def points_of(checks: Sequence[ResultRow]) -> list[ChartPoint]:
    """Checks as points, in the order given; what an older version did not write stays open."""
    return [_point(row) for row in checks]


def _point(row: ResultRow) -> ChartPoint:
    data = row.data
    chi, freedom = _number(data.get("chi_square")), _number(data.get("freedom"))
    return ChartPoint(
        taken_utc=row.taken_utc,
        calibration=row.calibration,
        verdict=row.verdict,
        named=row.changed,
        p_value=_number(data.get("p_value")),
        chi_square_ratio=None if chi is None or not freedom else chi / freedom,
        rms_mm=_number(data.get("rms_mm")),
        expected_rms_mm=_number(data.get("expected_rms_mm")),
        amounts=_amounts(data.get("causes")),
    )


def _amounts(causes: object) -> dict[str, tuple[float, float]]:
    found: dict[str, tuple[float, float]] = {}
    for cause in causes if isinstance(causes, list) else []:
        told = cause.get("alone", cause.get("amplitudes")) if isinstance(cause, dict) else None
        amplitudes = told if isinstance(told, dict) else {}
        pairs = {name: (_number(a.get("value")), _number(a.get("standard_uncertainty"))) for name, a in amplitudes.items() if isinstance(a, dict)}
        name = str(cause.get("cause"))
        if name == "single shot":
            continue
        lengths = [(v, u) for key, (v, u) in pairs.items() if key.endswith("_mm") and v is not None and u is not None]
        angles = [(v, u) for key, (v, u) in pairs.items() if key.endswith("_rad") and v is not None and u is not None]
        if name.startswith("axis") and angles:
            found[name] = angles[0]
        elif lengths:
            found[name] = (math.sqrt(sum(v * v for v, _ in lengths)), math.sqrt(sum(u * u for _, u in lengths) / len(lengths)))
    return found


def chart_csv(points: Sequence[ChartPoint]) -> str:
    """A row for each check; amounts in mm and mrad with standard uncertainties."""
    names = sorted({name for point in points for name in point.amounts})
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    columns = ["taken_utc", "calibration", "verdict", "named", "p_value", "chi_square_over_freedom", "rms_mm", "expected_rms_mm"]
    table.writerow(columns + [f"{name} {what}" for name in names for what in (_unit(name), f"u {_unit(name)}")])
    for p in points:
        row: list[object] = [p.taken_utc, p.calibration, p.verdict, p.named, p.p_value, p.chi_square_ratio, p.rms_mm, p.expected_rms_mm]
        for name in names:
            amount = p.amounts.get(name)
            row += [None, None] if amount is None else [_scaled(name, amount[0]), _scaled(name, amount[1])]
        table.writerow(["" if value is None else f"{value:.5g}" if isinstance(value, float) else value for value in row])
    return out.getvalue()


def chart_page(
    cell: str,
    points: Sequence[ChartPoint],
    calibrations: Sequence[CalibrationRow],
    activations: Sequence[ActivationRow],
    check_every_h: float | None,
    software: str,
) -> str:
    """The page: curves, then every check, calibration and activation."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("history.html.j2").render(
        cell=cell,
        svg=chart_svg(points, activations) if points else None,
        points=points,
        calibrations=calibrations,
        activations=activations,
        check_every_h=check_every_h,
        software=software,
        tone={"conform": "good", "reject": "bad"}.get(points[-1].verdict if points else "", "unsure"),
        headline=_headline(points),
    )


def _headline(points: Sequence[ChartPoint]) -> str:
    if not points:
        return "Never checked"
    last = points[-1]
    what = f", changed: {last.named}" if last.named else ""
    return f"Last quick check {last.taken_utc[:10]}: {last.verdict.replace('_', ' ')}{what}"


def chart_svg(points: Sequence[ChartPoint], activations: Sequence[ActivationRow] = ()) -> str:
    """Three curves over time: how large the residuals are against what is expected, offsets of axes, hand-eye and camera."""
    from measure.plots import svg_of

    times = [moment(point.taken_utc) for point in points]
    axes = sorted({name for point in points for name in point.amounts if name.startswith("axis")})
    others = [name for name in ("hand-eye", "camera", "sphere moved") if any(name in point.amounts for point in points)]

    def draw(figure: Any) -> None:
        panels = figure.subplots(3, 1, sharex=True)
        _levels(panels[0], times, points)
        for panel, names, label in ((panels[1], axes, "offset if alone, mrad"), (panels[2], others, "change if alone, mm")):
            _curves(panel, times, points, names)
            panel.set_ylabel(label)
        for activation in activations:
            for panel in panels:
                panel.axvline(moment(activation.at_utc), color="#6b7280", linewidth=0.8, linestyle=":")
        panels[2].tick_params(axis="x", rotation=20)

    return svg_of(draw, salt="history", size=(9.0, 7.6))


def _levels(panel: Any, times: Sequence[Any], points: Sequence[ChartPoint]) -> None:
    ratio = [(t, p) for t, p in zip(times, points, strict=True) if p.chi_square_ratio is not None]
    panel.plot([t for t, _ in ratio], [p.chi_square_ratio for _, p in ratio], color="#d1d5db", linewidth=1)
    for verdict, colour in _COLOURS.items():
        members = [(t, p.chi_square_ratio) for t, p in ratio if p.verdict == verdict]
        if members:
            panel.plot([t for t, _ in members], [v for _, v in members], "o", color=colour, markersize=5, label=verdict.replace("_", " "))
    panel.axhline(1.0, color="#6b7280", linewidth=0.8)
    panel.set_yscale("log")
    panel.set_ylabel("chi-square / freedom")
    panel.legend(loc="upper left", ncols=3)


def _curves(panel: Any, times: Sequence[Any], points: Sequence[ChartPoint], names: Sequence[str]) -> None:
    panel.axhline(0.0, color="#6b7280", linewidth=0.8)
    for name in names:
        own = [(t, p.amounts[name]) for t, p in zip(times, points, strict=True) if name in p.amounts]
        values, spread = [_scaled(name, v) for _, (v, _) in own], [2 * _scaled(name, u) for _, (_, u) in own]
        panel.errorbar([t for t, _ in own], values, yerr=spread, fmt="o-", markersize=3.5, linewidth=0.8, capsize=2, label=name)
    if names:
        panel.legend(loc="upper left", ncols=3)


def _unit(name: str) -> str:
    return "mrad" if name.startswith("axis") else "mm"


def _scaled(name: str, value: float) -> float:
    return 1e3 * value if name.startswith("axis") else value


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
