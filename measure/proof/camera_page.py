"""The page of a camera check: one self-contained HTML file with the paper's Fig 5 for this camera."""

from __future__ import annotations

import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from drivers.files.disk import write_text_atomic
from drivers.registry import hardware_remark, untried_drivers
from measure.decision import RULE
from measure.plots import AFTER_COLOUR, BAD_COLOUR, legend_above, svg_of
from measure.proof.camera_check import CameraCheck

TONES = {"conform": "good", "not_proven": "unsure", "reject": "bad"}
_HEADLINES = {
    "conform": "Conform: every place kept its limits with room for the test's own uncertainty.",
    "not_proven": "Not proven: these places do not show that the limits are kept, nor that they are not.",
    "reject": "Reject: at some place a limit is exceeded by more than the test's own uncertainty.",
}
_PANEL_MM = 3.3


def write_camera_page(path: Path, check: CameraCheck, *, now: datetime.datetime | None = None) -> None:
    """Write the page; it appears whole or not at all. FileError where the place cannot be written."""
    write_text_atomic(path, render(check, now or datetime.datetime.now(datetime.UTC)))


def render(check: CameraCheck, moment: datetime.datetime) -> str:
    """The HTML text; every text on it is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(loader=PackageLoader("measure"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.get_template("camera_check.html.j2")
    return template.render(
        headline=_HEADLINES[check.verdict],
        tone=TONES[check.verdict],
        summary=summary(check),
        reasons=check.reasons,
        remarks=[hardware_remark(name) for name in untried_drivers(*check.drivers)],
        pictures=(_courses_svg(check), _map_svg(check)),
        rows=[(check.session_name(p.session), p) for p in check.places],
        rejected=[(check.session_name(r.session), r.index, r.reason) for r in check.rejected],
        rule=RULE,
        sessions=check.sessions,
        created_utc=moment.strftime("%Y-%m-%d %H:%M UTC"),
        software=f"spherecal {version('spherecal')}",
    )


def summary(check: CameraCheck) -> tuple[str, ...]:
    """What the places say, in sentences."""
    errors, forms, trend = check.diameter_errors_mm, check.forms_mm, check.trend
    low, high = check.covered_mm
    found = [
        f"{len(errors)} places, x {low[0]:.0f} to {high[0]:.0f}, y {low[1]:.0f} to {high[1]:.0f}, z {low[2]:.0f} to {high[2]:.0f} mm in the camera.",
        f"Fitted diameter minus certified: {errors.min():+.3f} to {errors.max():+.3f} mm, mean {errors.mean():+.3f} mm.",
        f"Form (shell of 95 % of the points): {np.median(forms):.3f} mm in the middle, {forms.max():.3f} mm at worst.",
    ]
    if trend.order:
        x, y, z = trend.per_100_mm
        found.append(
            f"Over 100 mm the diameter changes by {x:+.3f} (x), {y:+.3f} (y) and {z:+.3f} mm (z, depth); single places lie {trend.left_mm:.3f} mm "
            "(one sigma) off a smooth course."
        )
    return tuple(found)


def _courses_svg(check: CameraCheck) -> str:
    """Diameter error and form along x, y and z."""

    def draw(figure: Any) -> None:
        panels = figure.subplots(2, 3, sharey="row")
        rows = ((check.diameter_errors_mm, "diameter error, mm"), (check.forms_mm, "form (95 %), mm"))
        for row, (values, label) in enumerate(rows):
            for axis in range(3):
                panel = panels[row, axis]
                panel.plot(check.centres_mm[:, axis], values, "o", color=AFTER_COLOUR, markersize=4, alpha=0.8)
                if row == 0:
                    panel.axhline(0.0, color="#6b7280", linewidth=0.8)
                if check.limits is not None:
                    limit = check.limits[row]
                    for sign in (1.0, -1.0) if row == 0 else (1.0,):
                        panel.axhline(sign * limit, color=BAD_COLOUR, linestyle="--", linewidth=1, label="limit" if sign > 0 else None)
                if row == 1:
                    panel.set_ylim(bottom=0.0)
                    panel.set_xlabel(f"{'xyz'[axis]} in camera, mm")
            panels[row, 0].set_ylabel(label)
        if check.limits is not None:
            legend_above(panels[0, 0], 1)

    return svg_of(draw, salt="camera-check-courses", size=(3 * _PANEL_MM, 5.4))


def _map_svg(check: CameraCheck) -> str:
    """Where the sphere was, coloured by the error of its diameter."""

    def draw(figure: Any) -> None:
        reach = max(float(np.abs(check.diameter_errors_mm).max()), 1e-3)
        panels = figure.subplots(1, 2)
        for panel, (across, down) in zip(panels, ((0, 2), (0, 1)), strict=True):
            dots = panel.scatter(
                check.centres_mm[:, across], check.centres_mm[:, down], c=check.diameter_errors_mm, cmap="coolwarm", vmin=-reach, vmax=reach, s=42
            )
            panel.set_xlabel(f"{'xyz'[across]} in camera, mm")
            panel.set_ylabel(f"{'xyz'[down]} in camera, mm")
            panel.invert_yaxis()
        figure.colorbar(dots, ax=panels, label="diameter error, mm")

    return svg_of(draw, salt="camera-check-map", size=(3 * _PANEL_MM, 3.6))
