"""Maps of the report: the camera's depth error over its view with what is known of it, and the error budget over the work volume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_field import CameraField
from measure.plots import AFTER_COLOUR, Drawn, FloatArray, legend_above, svg_of

_UNSEEN_COLOUR = "#9ca3af"
_LEVELS = 12
_SMALLEST_MM = 1e-3
_COLOURS = (AFTER_COLOUR, "#7a3e9d", "#c2571a")


@dataclass(frozen=True, slots=True, eq=False)
class DepthSlice:
    """The camera's depth error at one depth."""

    depth_mm: float
    x_mm: FloatArray
    """(nx,)."""
    y_mm: FloatArray
    """(ny,)."""
    error_mm: FloatArray
    """(ny, nx) of z, rigid part taken out."""
    expanded_uncertainty_mm: FloatArray
    """(ny, nx), k = 2."""
    seen: NDArray[np.bool_]
    """(ny, nx)."""

    @classmethod
    def of_field(cls, depth_mm: float, x_mm: FloatArray, y_mm: FloatArray, field: CameraField) -> DepthSlice:
        """From a field at `grid_mm` of the same axes."""
        shape = (len(y_mm), len(x_mm))
        u = field.expanded_uncertainty_mm[:, 2].reshape(shape)
        return cls(depth_mm, x_mm, y_mm, -field.correction_mm[:, 2].reshape(shape), u, field.seen.reshape(shape))


@dataclass(frozen=True, slots=True, eq=False)
class DepthProfile:
    """The depth error along z at one place of the view."""

    label: str
    depth_mm: FloatArray
    """(n,)."""
    error_mm: FloatArray
    """(n,)."""
    expanded_uncertainty_mm: FloatArray
    """(n,)."""
    seen: NDArray[np.bool_]
    """(n,)."""


def grid_mm(x_mm: FloatArray, y_mm: FloatArray, depth_mm: float) -> FloatArray:
    """(ny * nx, 3) points of a slice, row by row."""
    x, y = np.meshgrid(x_mm, y_mm)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth_mm)], axis=-1)


def depth_slices_svg(slices: Sequence[DepthSlice]) -> Drawn:
    """Depth error above, its U (k = 2) below, one column a depth; hatched where no shot measured."""

    def draw(figure: Any) -> None:
        panels = figure.subplots(2, len(slices), sharex=True, sharey=True, squeeze=False)
        size = max((float(np.abs(s.error_mm[s.seen]).max(initial=0.0)) for s in slices), default=0.0) + _SMALLEST_MM
        largest = max((float(s.expanded_uncertainty_mm[s.seen].max(initial=0.0)) for s in slices), default=0.0) + _SMALLEST_MM
        error_levels, u_levels = _nice(-size, size), _nice(0.0, largest)
        images: list[Any] = [None, None]
        for column, one in enumerate(slices):
            error = (one.error_mm, error_levels, "RdBu_r")
            uncertainty = (one.expanded_uncertainty_mm, u_levels, "YlOrBr")
            for row, (values, levels, colours) in enumerate((error, uncertainty)):
                panel = panels[row, column]
                images[row] = panel.contourf(one.x_mm, one.y_mm, values, levels=levels, cmap=colours, extend="both" if row == 0 else "max")
                images[row].set_rasterized(True)
                _hatch_unseen(panel, one)
                panel.set_aspect("equal")
                panel.grid(visible=False)
            panels[0, column].set_title(f"z = {one.depth_mm:.0f} mm", fontsize=10)
            panels[1, column].set_xlabel("x in camera, mm")
        panels[0, 0].invert_yaxis()
        for row, label in enumerate(("depth error, mm", "its U (k = 2), mm")):
            panels[row, 0].set_ylabel("y in camera, mm")
            figure.colorbar(images[row], ax=list(panels[row]), label=label, format="%.2g", shrink=0.85)

    return svg_of(draw, salt="depth slices", size=(8.6, 4.1))


def depth_profiles_svg(profiles: Sequence[DepthProfile]) -> Drawn:
    """Depth error along z with U (k = 2) as bands; dotted where no shot measured."""

    def draw(figure: Any) -> None:
        axis = figure.subplots()
        axis.axhline(0, color="#6b7280", linewidth=0.8)
        for one, colour in zip(profiles, _COLOURS, strict=False):
            low, high = one.error_mm - one.expanded_uncertainty_mm, one.error_mm + one.expanded_uncertainty_mm
            axis.fill_between(one.depth_mm, low, high, color=colour, alpha=0.15, linewidth=0)
            axis.plot(one.depth_mm, one.error_mm, color=colour, linewidth=1, linestyle=":")
            axis.plot(one.depth_mm, np.where(one.seen, one.error_mm, np.nan), color=colour, linewidth=1.8, label=one.label)
        axis.set_xlabel("depth z in camera, mm")
        axis.set_ylabel("depth error, mm")
        legend_above(axis, 3)

    return svg_of(draw, salt="depth profiles", size=(6.4, 3.2))


def budget_map_svg(x_mm: FloatArray, y_mm: FloatArray, total_mm: FloatArray) -> Drawn:
    """Standard uncertainty of a point (ny, nx) over the plan of the work volume; blank out of reach."""

    def draw(figure: Any) -> None:
        panel = figure.subplots()
        half = [0.5 * float(axis[1] - axis[0]) if len(axis) > 1 else 0.5 for axis in (x_mm, y_mm)]
        low, high = float(np.nanmin(total_mm)), float(np.nanmax(total_mm)) + _SMALLEST_MM
        low = max(0.0, 2 * low - high)
        panel.set_facecolor("#f3f4f6")
        image = panel.pcolormesh(x_mm, y_mm, np.ma.masked_invalid(total_mm), cmap="YlOrBr", vmin=low, vmax=high, shading="nearest")
        for i, y in enumerate(y_mm):
            for j, x in enumerate(x_mm):
                if np.isfinite(total_mm[i, j]):
                    dark = total_mm[i, j] > low + 0.65 * (high - low)
                    panel.text(x, y, f"{total_mm[i, j]:.2f}", ha="center", va="center", fontsize=8, color="#ffffff" if dark else "#374151")
        panel.set_xlim(x_mm[0] - half[0], x_mm[-1] + half[0])
        panel.set_ylim(y_mm[0] - half[1], y_mm[-1] + half[1])
        panel.set_aspect("equal")
        panel.set_xlabel("x in base, mm")
        panel.set_ylabel("y in base, mm")
        panel.grid(visible=False)
        figure.colorbar(image, ax=panel, label="standard uncertainty of a point, mm", format="%.2g")

    return svg_of(draw, salt="budget", size=(5.2, 4.4))


def _nice(low: float, high: float) -> FloatArray:
    """Round levels for a range."""
    from matplotlib.ticker import MaxNLocator

    return np.asarray(MaxNLocator(nbins=_LEVELS, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high), dtype=np.float64)


def _hatch_unseen(panel: Any, one: DepthSlice) -> None:
    if one.seen.all():
        return
    unseen = np.where(one.seen, 0.0, 1.0)
    panel.contourf(one.x_mm, one.y_mm, unseen, levels=[0.5, 1.5], colors=["#ffffff"], alpha=0.55).set_rasterized(True)
    hatched = panel.contourf(one.x_mm, one.y_mm, unseen, levels=[0.5, 1.5], colors="none", hatches=["////"])
    hatched.set_edgecolor(_UNSEEN_COLOUR)
    hatched.set_linewidth(0.0)
    hatched.set_rasterized(True)
