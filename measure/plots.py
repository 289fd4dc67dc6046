"""The pictures of the report: arrays in, one self-contained SVG text out. Imports matplotlib only when one is drawn."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BEFORE_COLOUR = "#c2571a"
AFTER_COLOUR = "#1f6f8b"
BAD_COLOUR = "#b3261e"
_GREY = "#6b7280"

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.edgecolor": "#9ca3af",
    "axes.labelcolor": "#374151",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e5e7eb",
    "xtick.color": "#374151",
    "ytick.color": "#374151",
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.fonttype": "none",
}


@dataclass(frozen=True, slots=True)
class LengthBar:
    """One length with its error and expanded uncertainty."""

    label: str
    error_mm: float
    expanded_uncertainty_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class ShotSeries:
    """One value per shot, for a curve over the shots."""

    label: str
    position: FloatArray
    """(n,) number of the shot on the axis."""
    value_mm: FloatArray
    """(n,)."""
    colour: str


def centres_svg(before_mm: FloatArray | None, after_mm: FloatArray, *, axes: tuple[int, int]) -> Drawn:
    """Sphere centres about their sphere's mean, before (m, 3) and after (n, 3), looked at along the third axis."""
    names = "xyz"

    def draw(figure: Any) -> None:
        panels = figure.subplots(1, 2 if before_mm is not None else 1, squeeze=False)[0]
        if before_mm is not None:
            _scatter(panels[0], before_mm, axes, BEFORE_COLOUR, "uncalibrated")
            panels[0].plot(after_mm[:, axes[0]], after_mm[:, axes[1]], ".", color=AFTER_COLOUR, markersize=2.5)
        _scatter(panels[-1], after_mm, axes, AFTER_COLOUR, "calibrated")
        for panel in panels:
            panel.set_xlabel(f"{names[axes[0]]} in base, mm")
        panels[0].set_ylabel(f"{names[axes[1]]} in base, mm")

    return svg_of(draw, salt=f"centres{axes}", size=(6.4, 3.3))


def shots_svg(series: Sequence[ShotSeries], *, rejected: FloatArray, ylabel: str, limit_mm: float | None = None) -> Drawn:
    """One stem per shot over the shot number; rejected shots (k,) marked on the axis, an optional limit as a line."""

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        for one in series:
            axis.vlines(one.position, 0, one.value_mm, color=one.colour, linewidth=1.0, alpha=0.45)
            axis.plot(one.position, one.value_mm, "o", color=one.colour, markersize=3.2, label=one.label)
        if rejected.size:
            axis.plot(rejected, np.zeros(rejected.size), "x", color=BAD_COLOUR, markersize=6, label="rejected", clip_on=False)
        if limit_mm is not None:
            axis.axhline(limit_mm, color=BAD_COLOUR, linestyle="--", linewidth=1, label=f"limit {limit_mm:g} mm")
        axis.set_ylim(bottom=0)
        axis.set_xlabel("shot")
        axis.set_ylabel(ylabel)
        if series or rejected.size:
            legend_above(axis, len(series) + 2)

    return svg_of(draw, salt="shots" + ylabel, size=(6.4, 3.0))


def coverage_svg(
    groups: Mapping[str, tuple[FloatArray, str]], *, axis: int, working_range_mm: tuple[float, float] | None, seen_mm: FloatArray | None
) -> Drawn:
    """Sphere centres in the camera frame: one lateral axis (0 or 1) over depth, one colour per group (n, 3).

    `seen_mm` (2, 3) is the box that the camera error model has data for.
    """

    def draw(figure: Any) -> None:
        plot = figure.subplots()
        if seen_mm is not None:
            low, high = seen_mm[0], seen_mm[1]
            box = [low[axis], high[axis], high[axis], low[axis], low[axis]], [low[2], low[2], high[2], high[2], low[2]]
            plot.fill(*box, color=AFTER_COLOUR, alpha=0.08, linewidth=0, label="volume seen in calibration")
        for label, (points, colour) in groups.items():
            plot.plot(points[:, axis], points[:, 2], "o", color=colour, markersize=4, alpha=0.8, label=label)
        for depth in working_range_mm or ():
            plot.axhline(depth, color=_GREY, linestyle=":", linewidth=1)
        plot.plot([0], [0], marker="s", color="#111827", markersize=7, linestyle="none")
        plot.annotate("camera", (0, 0), textcoords="offset points", xytext=(8, 2), color="#111827")
        plot.set_xlabel(f"{'xy'[axis]} in camera, mm")
        plot.set_ylabel("depth z in camera, mm")
        plot.invert_yaxis()
        plot.set_aspect("equal", adjustable="datalim")
        legend_above(plot, 2)

    return svg_of(draw, salt=f"coverage{axis}", size=(4.6, 4.6))


def lengths_svg(after: Sequence[LengthBar], before: Mapping[str, float], *, limit_mm: float | None) -> Drawn:
    """Length errors with U (k = 2) as bars, the uncalibrated error beside each, the limit as a band."""

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        rows = np.arange(len(after))
        if limit_mm is not None:
            axis.axvspan(-limit_mm, limit_mm, color="#16a34a", alpha=0.10, linewidth=0, label=f"limit ±{limit_mm:g} mm")
        axis.axvline(0, color=_GREY, linewidth=0.8)
        known = [(row, before[bar.label]) for row, bar in enumerate(after) if bar.label in before]
        if known:
            axis.plot([v for _, v in known], [r for r, _ in known], "D", color=BEFORE_COLOUR, markersize=5, label="uncalibrated")
        errors, bars = [bar.error_mm for bar in after], [bar.expanded_uncertainty_mm for bar in after]
        axis.errorbar(errors, rows, xerr=bars, fmt="o", color=AFTER_COLOUR, capsize=3, markersize=5, label="calibrated, with U (k = 2)")
        axis.set_yticks(rows, [bar.label for bar in after])
        axis.set_ylim(len(after) - 0.5, -0.5)
        axis.set_xlabel("measured - reference, mm")
        legend_above(axis, 3)

    return svg_of(draw, salt="lengths", size=(6.4, 1.5 + 0.34 * len(after)))


def _scatter(panel: Any, points_mm: FloatArray, axes: tuple[int, int], colour: str, label: str) -> None:
    x, y = points_mm[:, axes[0]], points_mm[:, axes[1]]
    panel.plot(x, y, "o", color=colour, markersize=3.5, alpha=0.7)
    reach = max(1.15 * float(np.abs(points_mm).max(initial=0.0)), 0.01)
    rms = float(np.sqrt((points_mm**2).sum(axis=1).mean())) if len(points_mm) else 0.0
    angle = np.linspace(0, 2 * np.pi, 90)
    panel.plot(rms * np.cos(angle), rms * np.sin(angle), color=colour, linewidth=1)
    panel.set_xlim(-reach, reach)
    panel.set_ylim(-reach, reach)
    panel.set_aspect("equal")
    panel.locator_params(nbins=5)
    panel.set_title(f"{label}: {rms:.3f} mm rms", fontsize=10, color=colour)


def legend_above(axis: Any, columns: int) -> None:
    """A legend over the plot of a matplotlib axis, where it hides nothing."""
    axis.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=columns, borderaxespad=0.2, handletextpad=0.4, columnspacing=1.0)


def _shortened(svg: str) -> str:
    """The same paths with two decimals of a point instead of six: half the size of a page, and finer than any screen shows."""
    return _BETWEEN.sub(">\n<", _PATH.sub(lambda path: _DECIMALS.sub(r"\1", path[0]), svg))


_PATH, _DECIMALS, _BETWEEN = re.compile(r'\bd="[^"]*"'), re.compile(r"(\d\.\d\d)\d+"), re.compile(r">\s+<")
_RASTER_DPI = 150
"""Of pictures within a picture."""


class Drawn(str):
    """An SVG text that knows how it was drawn, for files that hold pictures in another form."""

    draw: Callable[[Any], None]
    size_inch: tuple[float, float]


def svg_of(draw: Callable[[Any], None], *, salt: str, size: tuple[float, float]) -> Drawn:
    """The SVG of what `draw` puts on a figure of its own; ids carry the salt, since several pictures share one page."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    stream = io.StringIO()
    _save(draw, size, FigureCanvasSVG, stream, {"svg.hashsalt": salt}, format="svg", metadata={"Date": None}, dpi=_RASTER_DPI)
    text = stream.getvalue()
    drawn = Drawn(_shortened(text[text.index("<svg") :]))
    drawn.draw, drawn.size_inch = draw, size
    return drawn


def png_of(drawn: Drawn, *, dots_per_inch: int = 170) -> bytes:
    """The same picture as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    _save(drawn.draw, drawn.size_inch, FigureCanvasAgg, stream, {}, format="png", metadata={"Software": None}, dpi=dots_per_inch)
    return stream.getvalue()


def _save(draw: Callable[[Any], None], size: tuple[float, float], canvas: Any, stream: Any, style: dict[Any, Any], **options: Any) -> None:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**_STYLE, **style}):
        figure = Figure(figsize=size, layout="constrained")
        # the page shows through the figure, not through its panels, which may say something by their colour
        figure.patch.set_alpha(0.0)
        canvas(figure)
        draw(figure)
        figure.savefig(stream, **options)
