"""The colour map: the part's points drawn without a graphics card, nearest in front, coloured by their deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.kinematics.se3 import FloatArray
from measure.inspecting.result import DeviationMap
from measure.plots import Drawn, svg_of

_MOST_POINTS = 400_000
_PIXELS = 640
_COLOURS = "RdYlBu_r"
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One direction of view."""

    title: str
    across: FloatArray
    """(3,) unit, to the right."""
    up: FloatArray
    """(3,) unit."""
    towards: FloatArray
    """(3,) unit, to the eye."""


def colour_scale_mm(deviations: DeviationMap, tolerance_mm: float | None = None) -> float:
    """Deviation of the strongest colour: the tolerance, or a round number that few points exceed."""
    if tolerance_mm is not None:
        return tolerance_mm
    most = max(float(np.quantile(np.abs(deviations.signed_mm), 0.98)), 1e-3)
    power = 10.0 ** np.floor(np.log10(most))
    return float(next(step * power for step in _STEPS if step * power >= most * 0.999))


def colours_of(signed_mm: FloatArray, scale_mm: float) -> NDArray[np.uint8]:
    """(n, 3) red, green, blue."""
    from matplotlib import colormaps

    return np.asarray(colormaps[_COLOURS](np.clip(0.5 + 0.5 * signed_mm / scale_mm, 0, 1), bytes=True)[:, :3], dtype=np.uint8)


def colour_map_svg(deviations: DeviationMap, scale_mm: float, marks: Mapping[str, FloatArray]) -> Drawn:
    """Straight and oblique view of the part; `marks` are places (3,) of features by name, frame of the part."""
    looks = _looks(deviations)
    stride = max(1, len(deviations.signed_mm) // _MOST_POINTS)
    points, signed = deviations.points_in_part_mm[::stride], deviations.signed_mm[::stride]
    spans = [np.ptp(points @ np.stack([look.across, look.up], axis=1), axis=0) for look in looks]
    height = max(3.0, min(9.0, sum(10.0 * float(span[1] / max(span[0], 1e-9)) for span in spans) + 0.6))

    def draw(figure: Any) -> None:
        panels = figure.subplots(len(looks), 1)
        for panel, look in zip(panels, looks, strict=True):
            image, extent = _raster(points, signed, look)
            drawn = panel.imshow(image, extent=extent, origin="lower", cmap=_COLOURS, vmin=-scale_mm, vmax=scale_mm, interpolation="nearest")
            panel.set_title(look.title, fontsize=10, loc="left")
            panel.set_xticks([])
            panel.set_yticks([])
            panel.grid(visible=False)
            for side in panel.spines.values():
                side.set_visible(False)
            _scale_bar(panel, extent)
        for name, place in marks.items():
            _mark(panels[0], name, place, looks[0])
        figure.colorbar(drawn, ax=list(panels), label="deviation from nominal, mm (red: material too much)", shrink=0.7, extend="both")

    return svg_of(draw, salt="deviations", size=(9.6, height))


def histogram_svg(deviations: DeviationMap, scale_mm: float) -> Drawn:
    """How many points deviate by how much."""

    def draw(figure: Any) -> None:
        from matplotlib import colormaps

        axis = figure.subplots()
        reach = 1.5 * scale_mm
        count, edges = np.histogram(np.clip(deviations.signed_mm, -reach, reach), bins=90, range=(-reach, reach))
        middle = (edges[1:] + edges[:-1]) / 2
        colours = colormaps[_COLOURS](np.clip(0.5 + 0.5 * middle / scale_mm, 0, 1))
        axis.bar(middle, 100 * count / max(len(deviations.signed_mm), 1), width=edges[1] - edges[0], color=colours)
        axis.set_xlabel("deviation from nominal, mm (the outermost bars hold what lies beyond)")
        axis.set_ylabel("% of points")

    return svg_of(draw, salt="histogram", size=(6.4, 2.8))


def _looks(deviations: DeviationMap) -> tuple[Look, Look]:
    """From where the surface faces, and from there tilted over the part's long side."""
    towards = deviations.facing
    centred = deviations.points_in_part_mm[:: max(1, len(deviations.signed_mm) // 20_000)]
    flat = centred - np.outer(centred @ towards, towards)
    across = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2][0]
    across = across * np.sign(across[int(np.argmax(np.abs(across)))])
    up = np.cross(towards, across)
    oblique = towards * np.cos(0.9) - up * np.sin(0.9)
    turned = across * np.cos(0.45) + np.cross(oblique, across) * np.sin(0.45)
    turned = turned - (turned @ oblique) * oblique
    turned /= np.linalg.norm(turned)
    return Look("straight from where it was scanned", across, up, towards), Look("oblique", turned, np.cross(oblique, turned), oblique)


def _raster(points: FloatArray, signed: FloatArray, look: Look) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Picture (h, w) of the nearest points, NaN where none is, and its extent in mm."""
    u, v, depth = points @ look.across, points @ look.up, points @ look.towards
    span = max(float(np.ptp(u)), float(np.ptp(v)), 1e-6)
    # dots as large as the points lie apart, so that surfaces close
    pixel = max(span / _PIXELS, 0.7 * float(np.sqrt(max(np.ptp(u) * np.ptp(v), 1e-9) / len(u))))
    columns, rows = ((u - u.min()) / pixel).astype(np.int64) + 1, ((v - v.min()) / pixel).astype(np.int64) + 1
    image = np.full((int(rows.max()) + 2, int(columns.max()) + 2), np.nan)
    order = np.argsort(depth)
    for dv, du in ((1, 1), (-1, -1), (1, -1), (-1, 1), (0, 1), (0, -1), (1, 0), (-1, 0)):
        at = rows[order] + dv, columns[order] + du
        image[at] = np.where(np.isnan(image[at]), signed[order], image[at])
    front = np.full(image.shape, -np.inf)
    np.maximum.at(front, (rows, columns), depth)
    image[rows[order], columns[order]] = signed[order]
    left, bottom = float(u.min()) - pixel, float(v.min()) - pixel
    return image, (left, left + pixel * image.shape[1], bottom, bottom + pixel * image.shape[0])


def _scale_bar(panel: Any, extent: tuple[float, float, float, float]) -> None:
    length = float(10.0 ** np.floor(np.log10(max((extent[1] - extent[0]) / 3, 1e-6))))
    x, y = extent[0], extent[2] - 0.02 * (extent[3] - extent[2])
    panel.plot([x, x + length], [y, y], color="#374151", linewidth=2, solid_capstyle="butt", clip_on=False)
    panel.text(x + length, y, f" {length:g} mm", va="center", fontsize=8, color="#374151")


def _mark(panel: Any, name: str, place: FloatArray, look: Look) -> None:
    at = float(place @ look.across), float(place @ look.up)
    panel.annotate(
        name,
        at,
        fontsize=8,
        ha="center",
        va="center",
        color="#111827",
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "#ffffff", "edgecolor": "#9ca3af", "linewidth": 0.5, "alpha": 0.85},
    )
