"""The figures of the study as PNG, drawn with matplotlib's Agg; imported only when one is drawn."""

from __future__ import annotations

import io
from typing import Any

from calibrate.study_data import Curve, Panel, StudyFigure

_COLOURS = ("#1f6f8b", "#c2571a", "#6b7280", "#7a3e9d", "#b0a000", "#15803d", "#b3261e", "#0f4c81", "#d97706", "#4d7c0f", "#be185d", "#334155")
_CERTIFIED = "#111827"
_MOST_IN_LEGEND = 7
_PANELS_A_ROW = 3
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.edgecolor": "#9ca3af",
    "axes.labelcolor": "#374151",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e5e7eb",
    "legend.frameon": False,
}


def figure_png(figure: StudyFigure) -> bytes:
    """One figure with all its panels; curves that several panels share are named once, below."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    n = len(figure.panels)
    columns = min(n, _PANELS_A_ROW)
    rows = -(-n // columns)
    stream = io.BytesIO()
    with mpl.rc_context(_STYLE):
        drawn = Figure(figsize=(3.7 * columns + 0.4, 3.0 * rows + 0.5), layout="constrained", dpi=110)
        FigureCanvasAgg(drawn)
        axes = drawn.subplots(rows, columns, squeeze=False).ravel()
        labels = list(dict.fromkeys(curve.label for panel in figure.panels for curve in panel.curves))
        for axis, panel in zip(axes, figure.panels, strict=False):
            _draw(axis, panel, labels)
        for axis in axes[n:]:
            axis.set_visible(False)
        if 1 < len(labels) <= _MOST_IN_LEGEND:
            handles = {label: handle for axis in axes[:n] for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
            drawn.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(labels), 3))
        drawn.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _draw(axis: Any, panel: Panel, labels: list[str]) -> None:
    for curve in panel.curves:
        axis.plot(curve.x, curve.y, label=curve.label, color=_colour(curve, labels), **_line(curve))
    axis.set_title(panel.title)
    axis.set_xlabel(panel.x_label)
    axis.set_ylabel(panel.y_label)
    if panel.log_y:
        axis.set_yscale("log")


def _colour(curve: Curve, labels: list[str]) -> str:
    return _CERTIFIED if curve.label == "certified" else _COLOURS[labels.index(curve.label) % len(_COLOURS)]


def _line(curve: Curve) -> dict[str, Any]:
    if curve.dots:
        return {"linestyle": "none", "marker": "o", "markersize": 2.2, "alpha": 0.75}
    if curve.label == "certified":
        return {"linestyle": ":", "linewidth": 1.2}
    # few points are marked, a long descent is a line
    return {"linewidth": 1.5, "marker": "o" if len(curve.x) <= 20 else None, "markersize": 3}
