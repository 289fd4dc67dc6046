"""The study where clouds matter: methods on fitted centres and on points, Table 5's slide, Figs 5, 11 and 12-14."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acquire.sphere_fit import fit_fixed_radius, fit_free_radius
from calibrate.study_accuracy import ACCURACY_COLUMNS, Trial, accuracy_row
from calibrate.study_cell import StudyCell, StudyNoise, StudyShots, caps, draw_joints, draw_shots, fitted_centres, shots_at
from calibrate.study_data import Cell, Curve, Panel, StudyFigure, StudyTable, medians
from calibrate.study_methods import LABELS, Fitted, centres_seen, fit_centres, fit_clouds
from calibrate.study_paper import STITCHED_DIAMETER_ERROR_MM, TABLE_5
from drivers.kinematics.se3 import FloatArray

SLIDE_MM = 50.0
SLIDE_ERROR_MM = 0.03
N_PAIRS = 25
STITCH_PLACE_MM = (800.0, -150.0, 360.0)
N_STITCHED = 12
_SLIDE_DIRECTION = np.array([0.0, 1.0, 0.0])
_SECTION_HALF_WIDTH_MM = 1.5


@dataclass(frozen=True, slots=True)
class Variant:
    """A method and how it is given its spheres."""

    method: str
    centres: str
    """"free" or "fixed" radius fits of the measured points, "points" for spheres fitted to corrected points."""

    @property
    def label(self) -> str:
        """For tables."""
        return LABELS[self.method] if self.centres == "points" else f"{LABELS[self.method]}, {self.centres} radius"


VARIANTS = (
    Variant("1", "free"),
    Variant("1", "fixed"),
    Variant("2", "free"),
    Variant("3", "free"),
    Variant("4", "free"),
    Variant("joint", "fixed"),
    Variant("clouds", "points"),
)
"""The paper fits spheres with a free radius, as far as it tells."""
Chains = dict[Variant, Fitted]


def fit_variants(trial: Trial, max_sweeps: int) -> Chains:
    """Every variant on the trial's training clouds."""
    shots, cell = trial.training, trial.cell
    centres = {name: fitted_centres(shots, cell.radius_mm, free_radius=name == "free")[0] for name in ("free", "fixed")}
    return {
        v: fit_clouds(cell, shots)
        if v.method == "clouds"
        else fit_centres(v.method, cell, shots.joints_rad, centres[v.centres], max_sweeps=max_sweeps)
        for v in VARIANTS
    }


def clouds_table(trials: Sequence[tuple[Trial, Chains]]) -> StudyTable:
    """Table 3's figures where a sphere is seen as a cloud; medians over trials."""
    rows = [(v.label, *medians([accuracy_row(trial, chains[v], v.centres) for trial, chains in trials])) for v in VARIANTS]
    return StudyTable("table3_clouds", ("method", *ACCURACY_COLUMNS), tuple(rows))


def table_5(trials: Sequence[tuple[Trial, Chains]], rng: np.random.Generator, noise: StudyNoise, n_points: int) -> StudyTable:
    """The slide of Table 5: a sphere moved by 50 mm, 25 pairs of shots, other poses at each end; medians over trials.

    The last columns repeat the poses of the first end at the second, which hides robot and hand-eye error.
    """
    found: dict[Variant, list[tuple[Cell, ...]]] = {v: [] for v in VARIANTS}
    for trial, chains in trials:
        ends = _slide_ends(trial.cell, rng, noise, n_points)
        for v in VARIANTS:
            first, second, same = (centres_seen(chains[v], trial.cell, shots, v.centres) for shots in ends)
            found[v].append((*_distance_figures(first, second), *_distance_figures(first, same)[:2]))
    printed = {v: TABLE_5[v.method] if v.centres == "free" else (None, None, None) for v in VARIANTS}
    columns = ("method", "paper_d_mean_mm", "paper_d_max_mm", "paper_d_std_mm", "d_mean_mm", "d_max_mm", "d_std_mm", "signed_mean_mm")
    blind = ("same_poses_d_mean_mm", "same_poses_d_max_mm")
    return StudyTable("table5", (*columns, *blind), tuple((v.label, *printed[v], *medians(found[v])) for v in VARIANTS))


def _slide_ends(cell: StudyCell, rng: np.random.Generator, noise: StudyNoise, n_points: int) -> tuple[StudyShots, StudyShots, StudyShots]:
    """Shots at one end, at the other from other poses, and at the other from the first poses."""
    moved = (SLIDE_MM + rng.uniform(-SLIDE_ERROR_MM, SLIDE_ERROR_MM)) * _SLIDE_DIRECTION
    start = np.array(STITCH_PLACE_MM)
    here, there = cell.at(start), cell.at(start + moved)
    joints = draw_joints(here, rng, N_PAIRS)
    return (
        shots_at(here, rng, joints, noise=noise, n_points=n_points),
        draw_shots(there, rng, N_PAIRS, noise=noise, n_points=n_points),
        shots_at(there, rng, joints, noise=noise, n_points=n_points),
    )


def _distance_figures(first_mm: FloatArray, second_mm: FloatArray) -> tuple[float, float, float, float]:
    """Mean, maximum and standard deviation of | |P1 - P2| - 50 |, and its signed mean."""
    signed = np.linalg.norm(first_mm - second_mm, axis=1) - SLIDE_MM
    error = np.abs(signed)
    return float(error.mean()), float(error.max()), float(error.std()), float(signed.mean())


def diameter_figure(name: str, cell: StudyCell, chains: Chains | None, n_points: int) -> StudyFigure:
    """Figs 5 and 11: free-radius diameter along each camera axis, as measured and, with chains, after each correction.

    Noise-free spheres, the other two coordinates at (0, 0, 330) mm.
    """
    panels = []
    for axis, span in enumerate(((-120.0, 120.0), (-70.0, 70.0), (250.0, 400.0))):
        places = np.tile([0.0, 0.0, 330.0], (13, 1))
        places[:, axis] = np.linspace(*span, 13)
        # the same points on every sphere, so that the curves show the error and not the sample
        true = np.stack([caps(p[None], cell.radius_mm, n_points, np.random.default_rng(0))[0] for p in places])
        measured = cell.measured(true)
        curves = [Curve("as measured", places[:, axis], _diameters(measured, places, cell.radius_mm))]
        if chains is None:
            # the sign that the paper found on its hardware (Table 4)
            other = cell.with_camera_error(-1.0).measured(true)
            curves.append(Curve("k of the other sign", places[:, axis], _diameters(other, places, cell.radius_mm)))
        for variant in (Variant("1", "free"), Variant("clouds", "points")) if chains else ():
            corrected = (chains or {})[variant].corrected(measured)
            curves.append(Curve(f"corrected, {LABELS[variant.method]}", places[:, axis], _diameters(corrected, places, cell.radius_mm)))
        curves.append(Curve("certified", places[:, axis], np.full(13, 2 * cell.radius_mm)))
        panels.append(Panel(f"along {'xyz'[axis]}", f"{'xyz'[axis]} in camera, mm", "fitted diameter, mm", tuple(curves)))
    return StudyFigure(name, tuple(panels))


def _diameters(clouds_mm: FloatArray, places_mm: FloatArray, radius_mm: float) -> FloatArray:
    return np.array([2 * fit_free_radius(cloud, radius_mm, place)[1] for cloud, place in zip(clouds_mm, places_mm, strict=True)])


def stitching(
    trials: Sequence[tuple[Trial, Chains]], rng: np.random.Generator, noise: StudyNoise, n_points: int
) -> tuple[StudyTable, tuple[StudyFigure, ...]]:
    """Figs 12-14: clouds of a sphere at another place stitched in the base; three of them, then all; pictures of the first trial."""
    found: dict[Variant, list[tuple[Cell, ...]]] = {v: [] for v in VARIANTS}
    figures: tuple[StudyFigure, ...] = ()
    for trial, chains in trials:
        shots = draw_shots(trial.cell.at(np.array(STITCH_PLACE_MM)), rng, N_STITCHED, noise=noise, n_points=n_points)
        stitched = {v: chains[v].in_base_mm(shots.joints_rad, shots.clouds_in_camera_mm) for v in VARIANTS}
        for v, clouds in stitched.items():
            found[v].append((*_stitched_figures(clouds[:3], trial.cell.radius_mm), *_stitched_figures(clouds, trial.cell.radius_mm)))
        figures = figures or (_section("figure13", stitched, trial.cell, 3), _section("figure14", stitched, trial.cell, N_STITCHED))
    rows = []
    for v in VARIANTS:
        printed = STITCHED_DIAMETER_ERROR_MM.get(v.method) if v.centres == "free" else None
        rows.append((v.label, printed, *medians(found[v])))
    columns = ("method", "paper_diameter_error_mm", "diameter_error_3_mm", "radial_rms_3_mm", "diameter_error_12_mm", "radial_rms_12_mm")
    return StudyTable("stitching", columns, tuple(rows)), figures


def _stitched_figures(clouds_mm: FloatArray, radius_mm: float) -> tuple[float, float]:
    """Size of the error of the free diameter of stitched clouds (m, n, 3), and rms distance from the best certified sphere."""
    points = clouds_mm.reshape(-1, 3)
    centre, _ = fit_fixed_radius(points, radius_mm, _start(points, radius_mm))
    _, radius, _ = fit_free_radius(points, radius_mm, centre)
    return 2 * abs(radius - radius_mm), float(np.sqrt(((np.linalg.norm(points - centre, axis=1) - radius_mm) ** 2).mean()))


def _section(name: str, stitched: dict[Variant, FloatArray], cell: StudyCell, n_clouds: int) -> StudyFigure:
    """Deviation from the best certified sphere over the angle from the vertical, in a slice through its middle."""
    panels = []
    for v in (Variant("1", "free"), Variant("2", "free"), Variant("3", "free"), Variant("4", "free"), Variant("clouds", "points")):
        clouds = stitched[v][:n_clouds]
        centre, _ = fit_fixed_radius(clouds.reshape(-1, 3), cell.radius_mm, _start(clouds.reshape(-1, 3), cell.radius_mm))
        curves = []
        for j, cloud in enumerate(clouds):
            away = (cloud - centre)[np.abs(cloud[:, 1] - centre[1]) < _SECTION_HALF_WIDTH_MM]
            deviation = np.linalg.norm(away, axis=1) - cell.radius_mm
            curves.append(Curve(f"shot {j + 1}", np.degrees(np.arctan2(away[:, 0], away[:, 2])), deviation, dots=True))
        panels.append(Panel(LABELS[v.method], "angle from the vertical, degrees", "deviation, mm", tuple(curves)))
    return StudyFigure(name, tuple(panels))


def _start(points_mm: FloatArray, radius_mm: float) -> FloatArray:
    """Below the middle of what was seen: the camera looks down."""
    return np.asarray(points_mm.mean(axis=0) - [0.0, 0.0, 0.75 * radius_mm])
