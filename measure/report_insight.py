"""What the report says of a calibration's own doubts: what stays open, the camera's field with its U, and the error budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibrate.budget import ErrorBudget, Shares
from calibrate.camera_field import CameraField, SeenCells
from calibrate.identifiability import Identifiability
from drivers.kinematics.se3 import FloatArray
from measure.plots_maps import DepthProfile, DepthSlice, budget_map_svg, depth_profiles_svg, depth_slices_svg, grid_mm
from measure.report_page import Picture, Table

FieldAt = Callable[[FloatArray], CameraField]
_SLICES = 3
_ACROSS = 41
_PROBES = 12
_KINDS = {
    "gauge": "gauge: no shot can tell it, and no measurement depends on it",
    "open": "open: other shots would tell it",
    "prior": "weak: what was believed before counts more than the shots",
}
_BLOCKS = (
    ("robot_geometry_mm", "robot geometry"),
    ("hand_eye_mm", "hand-eye"),
    ("camera_field_mm", "camera field"),
    ("arm_physics_mm", "physics of the arm (gravity, transmissions)"),
    ("calibration_mm", "calibration: the four together"),
    ("artefact_mm", "of it from certificates (radii, optical offset, lengths)"),
    ("pose_noise_mm", "pose noise of a shot"),
    ("point_noise_mm", "noise of a point"),
    ("total_mm", "all of it"),
)


def identifiability_tables(found: Identifiability | None) -> tuple[Table, ...]:
    """What the shots determined and what stays open."""
    if found is None:
        return ()
    open_ones = sum(group.n_directions for group in found.directions if group.kind == "open")
    verdict = f"{open_ones} directions that other shots would tell are open." if open_ones else "Nothing that shots can tell is open."
    o = found.observability
    indices = "" if o is None else (
        f" Observability indices of the determined directions: O1 {o.o1:.3g} (Borm and Menq), O2 {o.o2:.3g} (Driels and Pathre), "
        f"O3 {o.o3:.3g} / mm (Nahvi), O4 {o.o4:.3g} / mm (Nahvi and Hollerbach), O5 {o.o5:.3g} / mm (Sun and Hollerbach)."
    )
    gap = "none" if not np.isfinite(found.gap) else f"{found.gap:.0f}"
    lead = (
        f"The shots determine {found.rank} of {found.n_parameters} directions of robot, hand-eye and camera; {found.expected_rank} is what "
        f"well-spread shots determine. {verdict} Condition {found.condition:.0f} (below 100 is good), gap to the undetermined {gap}.{indices}"
    )
    rows = tuple((group.text, str(group.n_directions), _KINDS[group.kind]) for group in found.directions)
    return (Table("What the shots do not tell", lead, ("what", "directions", "why"), rows, numeric=False),)


def field_tables(field_at: FieldAt | None, cells: SeenCells | None) -> tuple[Table, ...]:
    """Sizes of the camera's field over the cells that were seen, depth and lateral."""
    if field_at is None or cells is None:
        return ()
    field = field_at(cells.centres_mm)
    u = field.expanded_uncertainty_mm
    rows = tuple(
        (
            name,
            f"{float(np.sqrt((field.correction_mm[:, axis] ** 2).mean())):.3f}",
            f"{float(np.abs(field.correction_mm[:, axis]).max()):.3f}",
            f"{float(np.sqrt((u[:, axis] ** 2).mean())):.3f}",
            f"{float(u[:, axis].max()):.3f}",
        )
        for axis, name in ((2, "depth z"), (0, "across x"), (1, "across y"))
    )
    lead = (
        f"Over the {len(u)} of {cells.seen.size} cells of the seen box in which points were measured, in mm. A shift or turn of the whole field "
        "cannot be told from the hand-eye transform, so its best-fit rigid motion is taken out, of the values and of U alike."
    )
    heads = ("direction", "error, rms", "largest", "U (k = 2), rms", "largest U")
    return (Table("Camera error found", lead, heads, rows),)


def field_pictures(
    field_at: FieldAt | None, cells: SeenCells | None, working_range_mm: tuple[float, float] | None, field_of_view_deg: tuple[float, float] | None
) -> list[Picture]:
    """The depth error over the view at three depths, and along the depth."""
    if field_at is None or cells is None:
        return []
    slices = [_slice(field_at, cells, number, field_of_view_deg) for number in range(_SLICES)]
    caption = (
        "Measured minus true depth, above, and how well it is known, below; the calibration takes it out. Hatched: no shot measured there (in this "
        "third of the depth), the field is only continued. The best-fit rigid motion over the seen volume is left out, since the hand-eye transform "
        "cannot be told from it."
    )
    profiles = [_profile(field_at, cells, share, working_range_mm) for share in (0.5, 0.15, 0.85)]
    along = "The same along the depth, in the middle of the view and towards both sides; bands are U (k = 2), dotted where no shot measured."
    return [
        Picture("Depth error of the camera", caption, depth_slices_svg(slices), wide=True),
        Picture("Depth error along the depth", along, depth_profiles_svg(profiles)),
    ]


def budget_tables(budget: ErrorBudget | None) -> tuple[Table, ...]:
    """Shares of a point's and a length's standard uncertainty."""
    if budget is None:
        return ()
    lead = (
        f"Standard uncertainties in mm (k = 1; of a point in all directions together), root mean square over {budget.n_places} places of the "
        f"{_region(budget)}, for views like those of the calibration. The shots know sums of robot, hand-eye and camera better than each alone: what "
        "cancels in every shot cancels in a measurement too, so the shares do not add up, and the line of the four together counts. Points are in "
        f"the base frame as defined; what moves all of them alike cancels in lengths. The largest of any place is {budget.largest_point_mm:.3f} mm."
    )
    rows = tuple((text, _mm(budget.point, name), _mm(budget.length, name)) for name, text in _BLOCKS)
    heads = ("share", "a point", f"{budget.length_mm:.0f} mm length")
    return (Table("Error budget", lead, heads, rows),)


def budget_pictures(budget: ErrorBudget | None) -> list[Picture]:
    """The total over the plan of the work volume."""
    if budget is None or not np.isfinite(budget.plan_mm).any():
        return []
    caption = f"Standard uncertainty of a measured point over the {_region(budget)} from above, rms over its height; blank where no view reaches."
    return [Picture("Error budget over the work volume", caption, budget_map_svg(budget.plan_x_mm, budget.plan_y_mm, budget.plan_mm))]


def _region(budget: ErrorBudget) -> str:
    return "work volume" if budget.region == "work volume" else "region around the spheres"


def _mm(shares: Shares, name: str) -> str:
    value = getattr(shares, name)
    return "–" if value is None or not np.isfinite(value) else f"{value:.3f}"


def _slice(field_at: FieldAt, cells: SeenCells, number: int, field_of_view_deg: tuple[float, float] | None) -> DepthSlice:
    """One of three parts of the seen depth, in its middle; seen is what any depth of the part saw."""
    low, high = cells.box_mm
    edges = low[2] + np.arange(number, number + 2) / _SLICES * (high[2] - low[2])
    depth = float(edges.mean())
    inside = cells.centres_mm[(cells.centres_mm[:, 2] >= edges[0]) & (cells.centres_mm[:, 2] <= edges[1])]
    half_cell = 0.5 * (high - low) / cells.seen.shape
    extents = [_extent(cells.box_mm[:, a], inside[:, a], half_cell[a], depth, field_of_view_deg, a) for a in (0, 1)]
    x, y = (np.linspace(first, last, _ACROSS) for first, last in extents)
    field = field_at(grid_mm(x, y, depth))
    seen = np.any([cells.holds(grid_mm(x, y, z)) for z in np.linspace(edges[0], edges[1], _PROBES)], axis=0)
    return DepthSlice.of_field(depth, x, y, replace(field, seen=seen))


def _extent(
    box_mm: FloatArray, seen_mm: FloatArray, half_cell_mm: float, depth_mm: float, field_of_view_deg: tuple[float, float] | None, axis: int
) -> tuple[float, float]:
    """The camera's view at a depth with all that was seen there; the whole seen box where the view is not known."""
    if field_of_view_deg is None:
        return float(box_mm[0]), float(box_mm[1])
    view = depth_mm * float(np.tan(np.radians(field_of_view_deg[axis]) / 2))
    return min(-view, float(seen_mm.min(initial=0.0)) - half_cell_mm), max(view, float(seen_mm.max(initial=0.0)) + half_cell_mm)


def _profile(field_at: FieldAt, cells: SeenCells, share: float, working_range_mm: tuple[float, float] | None) -> DepthProfile:
    low, high = cells.box_mm
    near, far = working_range_mm or (low[2], high[2])
    depth = np.linspace(min(near, low[2]), max(far, high[2]), 121)
    x, y = low[0] + share * (high[0] - low[0]), 0.5 * (low[1] + high[1])
    points = np.stack([np.full(121, x), np.full(121, y), depth], axis=-1)
    step = (high - low) / cells.seen.shape
    around = [points + step * [i, j, 0] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    field = replace(field_at(points), seen=np.any([cells.holds(p) for p in around], axis=0))
    return DepthProfile(f"x = {x:.0f} mm", depth, -field.correction_mm[:, 2], field.expanded_uncertainty_mm[:, 2], field.seen)
