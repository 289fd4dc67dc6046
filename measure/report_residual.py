"""What the report shows of a verification's residuals: where on a sphere, where in the base, where in the camera's view."""

from __future__ import annotations

import numpy as np

from drivers.kinematics.se3 import FloatArray
from measure.plots_residual import camera_maps_svg, exaggeration_of, form_maps_svg, shifts_svg
from measure.proof.residual_maps import LEAST_IN_BIN, MOST_SPHERES, ResidualMaps
from measure.report_page import Picture
from measure.sphere_figures import Figures


def centre_shifts_mm(figures: Figures) -> tuple[FloatArray, FloatArray]:
    """Of spheres seen twice or more: (n, 3) mean centre of a view's sphere in the base, and (n, 3) the view's own centre less that."""
    places, shifts = [np.empty((0, 3))], [np.empty((0, 3))]
    for name in figures.spheres:
        centres = [v.centre_in_base_mm for v in figures.views if v.sphere == name and v.centre_in_base_mm is not None]
        if len(centres) > 1:
            mean = np.mean(centres, axis=0)
            places.append(np.tile(mean, (len(centres), 1)))
            shifts.append(np.stack(centres) - mean)
    return np.concatenate(places), np.concatenate(shifts)


def residual_pictures(figures: Figures, maps: ResidualMaps | None) -> list[Picture]:
    """Shifts over the volume, residual over the camera's view, form maps."""
    return [*_shift_picture(figures), *([] if maps is None else [_camera_picture(maps), _form_picture(maps, len(figures.spheres))])]


def _shift_picture(figures: Figures) -> list[Picture]:
    places, shifts = centre_shifts_mm(figures)
    if not len(shifts):
        return []
    factor = exaggeration_of(places, shifts)
    caption = (
        f"An arrow for every view, from the mean centre of its sphere to where this view puts it, {factor:g} times as long as it is. Good: short "
        "tufts that point everywhere, alike at all places. Look for a place with longer arrows than the others (the robot is worse there), and for "
        "tufts that are long in one direction (one axis, or the depth of a camera that always looked from the same side)."
    )
    return [Picture("Residual of each view at its place in the base", caption, shifts_svg(places, shifts, exaggeration=factor), wide=True)]


def _camera_picture(maps: ResidualMaps) -> Picture:
    caption = (
        "Mean distance of the points from their sphere's surface (centre of all views, calibrated radius offset taken out) by where in the camera's "
        "view they were measured: red is outside the sphere, for most points too near to the camera. Good: pale and patchy; a patch is the pose "
        "error of one view. A gradient or a bow over the whole view is what the calibration left of the camera's field; strong colour at the border "
        f"alone says that it was calibrated with too few shots there. Grey: fewer than {LEAST_IN_BIN} points."
    )
    return Picture("Residual over the camera's view", caption, camera_maps_svg(maps.camera), wide=True)


def _form_picture(maps: ResidualMaps, n_spheres: int) -> Picture:
    which = f"The {MOST_SPHERES} of {n_spheres} spheres with the largest form error. " if n_spheres > MOST_SPHERES else ""
    caption = (
        f"{which}Stitched points of all views less their own best-fit sphere, mean over 15°, azimuth from the base's x about "
        "its z. Red stands out. Good: pale and patchy. An edge between two colours is a step between views that do not agree; red and blue in halves "
        "or quarters that return on every sphere are an error of robot or hand-eye; a spot on one sphere alone is dirt or damage. "
        f"Grey: fewer than {LEAST_IN_BIN} points."
    )
    return Picture("Form of the spheres", caption, form_maps_svg(maps.forms), wide=len(maps.forms) > 1)
