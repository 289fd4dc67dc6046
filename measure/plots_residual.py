"""Pictures of what verification leaves over: form of the spheres, shifts of their centres in the base, residual over the camera's view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from measure.plots import Drawn, FloatArray, svg_of
from measure.proof.residual_maps import BinnedMap, CameraMaps, FormMap

_EMPTY_COLOUR = "#d1d5db"
_COLOURS = "RdBu_r"
_SMALLEST_MM = 1e-3
_ARROW_SHARE, _LONE_ARROW_SHARE = 0.12, 0.4
_LEAST_SPAN_MM = 100.0


def form_maps_svg(forms: Sequence[FormMap]) -> Drawn:
    """Deviation over azimuth and elevation, one panel a sphere, all on one scale."""
    columns = 2 if len(forms) == 4 else min(len(forms), 3)
    rows = -(-len(forms) // columns)

    def draw(figure: Any) -> None:
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        largest = _largest_mm([form.deviation for form in forms])
        image: Any = None
        for number, panel in enumerate(panels.flat):
            if number >= len(forms):
                panel.set_visible(False)
                continue
            one = forms[number]
            image = _mesh(panel, one.deviation, largest, factor=180.0 / np.pi)
            views = "1 view" if one.n_views == 1 else f"{one.n_views} views"
            panel.set_title(f"{one.sphere}: {views}, form {one.form_mm:.3f} mm", fontsize=9.5)
            panel.set_xticks([-180, -90, 0, 90, 180])
            panel.set_yticks([-90, -45, 0, 45, 90])
            if number + columns >= len(forms):
                panel.set_xlabel("azimuth, °")
                panel.tick_params(labelbottom=True)
        for row in panels:
            row[0].set_ylabel("elevation, °")
        figure.colorbar(image, ax=panels, label="deviation, mm", format="%.2g", extend="both")

    return svg_of(draw, salt="form maps", size=(8.6 if columns > 1 else 5.2, 0.6 + (2.3 if columns < 3 else 1.75) * rows))


def shifts_svg(place_in_base_mm: FloatArray, shift_mm: FloatArray, *, exaggeration: float) -> Drawn:
    """Arrows (n, 3) from places (n, 3) in the base, `exaggeration` times as long as they are, from above and from the side."""
    size_mm = np.linalg.norm(shift_mm, axis=1)
    order = np.argsort(size_mm)

    def draw(figure: Any) -> None:
        panels = figure.subplots(1, 2, squeeze=False)[0]
        arrows: Any = None
        for panel, (title, across, up) in zip(panels, (("from above", 0, 1), ("from the side", 0, 2)), strict=True):
            axes = [across, up]
            places, shifts = place_in_base_mm[order][:, axes], exaggeration * shift_mm[order][:, axes]
            arrows = panel.quiver(
                *places.T, *shifts.T, size_mm[order], angles="xy", scale_units="xy", scale=1.0, cmap="plasma_r", width=0.004, headwidth=3.5
            )
            arrows.set_clim(0.0, float(size_mm.max()) + _SMALLEST_MM)
            panel.plot(*places.T, ".", color="#6b7280", markersize=2)
            _hold(panel, np.concatenate([places, places + shifts]))
            panel.set_title(f"{title}, arrows × {exaggeration:g}", fontsize=10)
            panel.set_xlabel(f"{'xyz'[across]} in base, mm")
            panel.set_ylabel(f"{'xyz'[up]} in base, mm")
        figure.colorbar(arrows, ax=list(panels), label="size of the shift, mm", format="%.2g")

    return svg_of(draw, salt="shifts", size=(8.6, 3.9))


def exaggeration_of(place_in_base_mm: FloatArray, shift_mm: FloatArray) -> float:
    """A round factor (1, 2 or 5 times a power of ten) for arrows (n, 3) from places (n, 3).

    A large arrow then takes up to an eighth of the picture, and more where all start at one place.
    """
    span = float(np.ptp(place_in_base_mm, axis=0).max())
    share = _ARROW_SHARE if span > _LEAST_SPAN_MM else _LONE_ARROW_SHARE
    large = max(float(np.quantile(np.linalg.norm(shift_mm, axis=1), 0.95)), 1e-6)
    wanted = share * max(span, _LEAST_SPAN_MM) / large
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(step for step in (1, 2, 5) if step * power <= wanted) * power)


def camera_maps_svg(maps: CameraMaps) -> Drawn:
    """Mean radial residual over x and depth, and over x and y."""
    shown = [("depth z", maps.over_x_z), *([] if maps.over_x_y is None else [("y", maps.over_x_y)])]
    tallest = max(float(np.ptp(one.y_edges) / np.ptp(one.x_edges)) for _, one in shown)

    def draw(figure: Any) -> None:
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        largest = _largest_mm([one for _, one in shown])
        image: Any = None
        for panel, (label, one) in zip(panels, shown, strict=True):
            image = _mesh(panel, one, largest)
            panel.set_aspect("equal", adjustable="box")
            panel.invert_yaxis()
            panel.set_xlabel("x in camera, mm")
            panel.set_ylabel(f"{label} in camera, mm")
        figure.colorbar(image, ax=list(panels), label="radial residual, mm", format="%.2g", extend="both")

    return svg_of(draw, salt="camera maps", size=(1.2 + 3.7 * len(shown), float(np.clip(3.1 * tallest, 1.7, 3.9)) + 0.6))


def _mesh(panel: Any, one: BinnedMap, largest_mm: float, *, factor: float = 1.0) -> Any:
    x, y = factor * one.x_edges, factor * one.y_edges
    panel.set_facecolor(_EMPTY_COLOUR)
    panel.grid(visible=False)
    panel.set_xlim(x[0], x[-1])
    panel.set_ylim(y[0], y[-1])
    # a picture in the picture: thousands of rectangles would be most of a page's size
    return panel.pcolormesh(x, y, np.ma.masked_invalid(one.mean_mm), cmap=_COLOURS, vmin=-largest_mm, vmax=largest_mm, rasterized=True)


def _largest_mm(maps: Sequence[BinnedMap]) -> float:
    """End of a colour scale that a few wild bins at a rim do not stretch."""
    values = np.abs(np.concatenate([one.mean_mm[np.isfinite(one.mean_mm)] for one in maps]))
    return max(float(np.quantile(values, 0.98)) if values.size else 0.0, _SMALLEST_MM)


def _hold(panel: Any, points_mm: FloatArray) -> None:
    """Equal axes round points (n, 2)."""
    middle = 0.5 * (points_mm.min(axis=0) + points_mm.max(axis=0))
    half = 0.55 * max(float(np.ptp(points_mm, axis=0).max()), _LEAST_SPAN_MM)
    panel.set_xlim(middle[0] - half, middle[0] + half)
    panel.set_ylim(middle[1] - half, middle[1] + half)
    panel.set_aspect("equal", adjustable="box")
    panel.locator_params(nbins=6)
