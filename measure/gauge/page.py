"""The page of a study: one self-contained HTML file with its table, its picture and what the figures mean."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from drivers.files.disk import write_text_atomic
from measure.gauge.approach import Drift
from measure.gauge.table import Measured, by_feature
from measure.plots import AFTER_COLOUR, BAD_COLOUR, legend_above, svg_of

_PANEL_INCH = (4.6, 2.5)
_MOST_PANELS = 12


@dataclass(frozen=True, slots=True)
class StudyPage:
    """What a page tells."""

    title: str
    headline: str
    tone: str
    """good, unsure or bad; empty for a study that judges nothing."""
    columns: tuple[str, ...]
    rows: tuple[tuple[object, ...], ...]
    notes: tuple[str, ...]
    """How the figures are made, and what they cannot say."""
    picture: str
    """SVG."""
    caption: str


def write_page(page: StudyPage, path: str | Path, *, source: str, now: datetime.datetime | None = None) -> None:
    """Write the page; it appears whole or not at all.

    Args:
        page: what it tells.
        path: of the HTML file.
        source: name and digest of the table.
        now: of the remark when it was written.

    Raises:
        FileError: the place cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    moment = (now or datetime.datetime.now(datetime.UTC)).strftime("%Y-%m-%d %H:%M UTC")
    rows = [[text_of(cell) for cell in row] for row in page.rows]
    numbers = [any(isinstance(row[i], float) for row in page.rows) for i in range(len(page.columns))]
    text = environment.get_template("gauge.html.j2").render(
        page=page, rows=rows, numbers=numbers, source=source, created_utc=moment, software=f"spherecal {version('spherecal')}"
    )
    write_text_atomic(Path(path), text)


def text_of(cell: object) -> str:
    """A figure with as many digits as it deserves."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if not isinstance(cell, float):
        return str(cell)
    if not math.isfinite(cell):
        return "unlimited" if cell > 0 else ""
    return f"{cell:.4f}" if abs(cell) < 10 else f"{cell:.2f}"


def _panels(figure: Any, names: Sequence[str]) -> dict[str, Any]:
    """A panel each for as many features as a page can hold."""
    shown = list(names)[:_MOST_PANELS]
    columns = min(2, len(shown))
    panels = np.atleast_1d(figure.subplots(math.ceil(len(shown) / columns), columns, squeeze=False)).ravel()
    for panel in panels[len(shown) :]:
        panel.set_visible(False)
    for panel, name in zip(panels, shown, strict=False):
        panel.set_title(name, fontsize=9, loc="left")
        panel.set_ylabel("mm")
    return dict(zip(shown, panels, strict=False))


def _size(n: int) -> tuple[float, float]:
    n = min(n, _MOST_PANELS)
    return min(2, n) * _PANEL_INCH[0], math.ceil(n / 2) * _PANEL_INCH[1]


def run_svg(rows: Sequence[Measured]) -> str:
    """Values of every feature in their order, with tolerance and reference."""
    features = by_feature(rows)

    def draw(figure: Any) -> None:
        for name, panel in _panels(figure, list(features)).items():
            members = features[name]
            panel.plot(range(1, len(members) + 1), [row.value_mm for row in members], "o-", color=AFTER_COLOUR, markersize=3, linewidth=0.8)
            lines: dict[str, float | None] = {"lower": members[0].lower_mm, "upper": members[0].upper_mm}
            spread = max(np.ptp([row.value_mm for row in members]), 1e-6)
            for value in lines.values():
                if value is not None and abs(value - members[0].value_mm) < 20 * spread:
                    panel.axhline(value, color=BAD_COLOUR, linestyle="--", linewidth=1)
            panel.set_xlabel("run")

    return svg_of(draw, salt="gauge-run", size=_size(len(features)))


def groups_svg(rows: Sequence[Measured], key: str) -> str:
    """Values of every feature by part, one colour for each value of `key` (operator, direction)."""
    features = by_feature(rows)
    groups = sorted({str(getattr(row, key)) for row in rows})

    def draw(figure: Any) -> None:
        for number, (name, panel) in enumerate(_panels(figure, list(features)).items()):
            parts = sorted({row.part for row in features[name]})
            for i, group in enumerate(groups):
                members = [row for row in features[name] if getattr(row, key) == group]
                x = [parts.index(row.part) + 0.16 * (i - (len(groups) - 1) / 2) for row in members]
                panel.plot(x, [row.value_mm for row in members], "o", markersize=3, color=f"C{i % 10}", label=group)
            panel.set_xticks(range(len(parts)), parts, fontsize=7)
            if number == 0 and groups != [""]:
                legend_above(panel, len(groups))
                panel.set_title(name, fontsize=9, loc="right")
                panel.set_title("", loc="left")

    return svg_of(draw, salt=f"gauge-{key}", size=_size(len(features)))


def drift_svg(drifts: Sequence[Drift]) -> str:
    """Courses over time."""
    named: Mapping[str, Drift] = {drift.feature: drift for drift in drifts}

    def draw(figure: Any) -> None:
        for name, panel in _panels(figure, list(named)).items():
            drift = named[name]
            panel.plot(drift.minutes, drift.value_mm, "o", color=AFTER_COLOUR, markersize=3)
            if drift.warm_mm is not None:
                panel.axhline(drift.warm_mm, color="#6b7280", linestyle=":", linewidth=1)
            panel.set_xlabel("minutes")

    return svg_of(draw, salt="gauge-drift", size=_size(len(named)))


def correlation_svg(rows: Sequence[Measured]) -> str:
    """Reference minus value by part."""
    features = by_feature([row for row in rows if row.reference_mm is not None])

    def draw(figure: Any) -> None:
        for name, panel in _panels(figure, list(features)).items():
            parts = sorted({row.part for row in features[name]})
            x = [parts.index(row.part) for row in features[name]]
            panel.plot(x, [(row.reference_mm or 0.0) - row.value_mm for row in features[name]], "o", color=AFTER_COLOUR, markersize=4)
            panel.axhline(0.0, color="#6b7280", linewidth=0.8)
            panel.set_xticks(range(len(parts)), parts, fontsize=7)

    return svg_of(draw, salt="gauge-correlation", size=_size(len(features)))
