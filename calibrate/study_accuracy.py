"""The paper's simulation on sphere centres: Table 3, Figs 6 and 10, and what its figures depend on that they should not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from calibrate.stepwise import StepwiseSettings, StepwiseState, solve_stepwise, stepwise_data
from calibrate.study_cell import StudyCell, StudyNoise, StudyShots, draw_shots, with_guess_signs
from calibrate.study_data import Cell, Curve, Panel, StudyFigure, StudyTable, medians, spread_of
from calibrate.study_methods import LABELS, PILLOW, Fitted, centres_seen, fit_centres
from calibrate.study_paper import TABLE_3
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray

CENTRE_METHODS = ("1", "2", "3", "4", "4 free", "joint")
PLACES_MM = ((750.0, -250.0, 350.0), (1000.0, 250.0, 250.0), (850.0, 300.0, 450.0), (950.0, -200.0, 300.0), (800.0, 0.0, 400.0))
"""Where no training sphere stood; the lengths between them are 190 to 570 mm."""
_SHOTS_A_PLACE = 8
_WATCHED_SWEEPS = (1, 2, 5, 10, 20, 50, 100, 150, 200, 300, 400, 600, 800, 1000)
_RANK_TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One draw of the paper's simulation."""

    cell: StudyCell
    training: StudyShots
    noisy_tests: StudyShots
    exact_tests: StudyShots
    places: tuple[StudyShots, ...]
    """Noise-free shots at `PLACES_MM`."""


def draw_trial(cell: StudyCell, rng: np.random.Generator, *, noise: StudyNoise, n_shots: int = 100, n_points: int = 0) -> Trial:
    """100 training and 100 test shots, and some at other places."""
    training = draw_shots(cell, rng, n_shots, noise=noise, n_points=n_points)
    noisy = draw_shots(cell, rng, n_shots, noise=noise, n_points=n_points)
    exact = draw_shots(cell, rng, n_shots, n_points=n_points)
    places = tuple(draw_shots(cell.at(np.array(place)), rng, _SHOTS_A_PLACE, n_points=n_points) for place in PLACES_MM)
    return Trial(cell, training, noisy, exact, places)


def fit_all(trial: Trial, methods: Sequence[str], max_sweeps: int) -> dict[str, Fitted]:
    """Every method on the trial's training centres."""
    shots = trial.training
    return {m: fit_centres(m, trial.cell, shots.joints_rad, shots.centre_in_camera_mm, max_sweeps=max_sweeps) for m in methods}


def length_errors_mm(trial: Trial, fitted: Fitted, source: str) -> FloatArray:
    """Signed errors (10,) of the lengths between unseen places, each a mean of some noise-free shots."""
    seen = [centres_seen(fitted, trial.cell, shots, source).mean(axis=0) for shots in trial.places]
    pairs = list(combinations(range(len(seen)), 2))
    true = [np.linalg.norm(np.subtract(PLACES_MM[i], PLACES_MM[j])) for i, j in pairs]
    return np.array([np.linalg.norm(seen[i] - seen[j]) for i, j in pairs]) - np.array(true)


_SPREAD_COLUMNS = ("e_mean_mm", "e_max_mm", "std_mm", "rms_about_mean_mm", "rms_about_mean_noisy_mm")
ACCURACY_COLUMNS = (*_SPREAD_COLUMNS, "length_rms_mm", "length_max_mm", "steps", "seconds")


def accuracy_row(trial: Trial, fitted: Fitted, source: str) -> tuple[Cell, ...]:
    """`ACCURACY_COLUMNS` of one fitted chain; noise-free tests but for the fifth."""
    exact = spread_of(centres_seen(fitted, trial.cell, trial.exact_tests, source), trial.cell.centre_in_base_mm)
    noisy = spread_of(centres_seen(fitted, trial.cell, trial.noisy_tests, source), trial.cell.centre_in_base_mm)
    lengths = length_errors_mm(trial, fitted, source)
    length_rms, length_max = float(np.sqrt((lengths**2).mean())), float(np.abs(lengths).max())
    spread = (exact.e_mean_mm, exact.e_max_mm, exact.std_mm, exact.rms_about_mean_mm, noisy.rms_about_mean_mm)
    return (*spread, length_rms, length_max, fitted.steps, fitted.seconds)


def table_3(trials: Sequence[tuple[Trial, dict[str, Fitted]]]) -> StudyTable:
    """The paper's Table 3 beside medians over trials."""
    rows = []
    for method in CENTRE_METHODS:
        ours = medians([accuracy_row(trial, fitted[method], "given") for trial, fitted in trials])
        rows.append((LABELS[method], *TABLE_3.get(method, (None, None, None)), *ours))
    printed = ("paper_e_mean_mm", "paper_e_max_mm", "paper_std_mm")
    return StudyTable("table3", ("method", *printed, *ACCURACY_COLUMNS), tuple(rows))


def figure_6(trial: Trial, fitted: dict[str, Fitted]) -> StudyFigure:
    """Residual error of each part at every noise-free test: flange position, hand-eye position, camera point."""
    shots = trial.exact_tests
    true_flange = mdh.base_from_flange(trial.cell.true, shots.joints_rad)
    number = np.arange(1.0, len(shots.joints_rad) + 1)

    def robot(f: Fitted) -> FloatArray:
        return np.asarray(np.linalg.norm((f.base_from_flange(shots.joints_rad) - true_flange)[:, :3, 3], axis=1))

    def hand_eye(f: Fitted) -> FloatArray:
        return np.full(len(number), float(np.linalg.norm((f.flange_from_camera - trial.cell.flange_from_camera)[:3, 3])))

    def camera(f: Fitted) -> FloatArray:
        return np.asarray(np.linalg.norm(f.corrected(shots.centre_in_camera_mm) - shots.true_centre_in_camera_mm, axis=1))

    every = ("1", "2", "3", "4", "joint")
    parts = (("robot", robot, every), ("hand-eye", hand_eye, every), ("camera", camera, ("1", "3", "joint")))
    panels = [
        Panel(title, "test", "residual error, mm", tuple(Curve(LABELS[m], number, error(fitted[m]), dots=True) for m in methods), log_y=True)
        for title, error, methods in parts
    ]
    return StudyFigure("figure6", tuple(panels))


def figure_10(trial: Trial, fitted: dict[str, Fitted]) -> StudyFigure:
    """Size of each compensation at every noisy test: how far robot, hand-eye and camera are moved."""
    shots = trial.noisy_tests
    number = np.arange(1.0, len(shots.joints_rad) + 1)
    nominal = mdh.base_from_flange(trial.cell.nominal, shots.joints_rad)
    curves: dict[str, list[Curve]] = {"robot": [], "hand-eye": [], "camera": []}
    for method in ("1", "joint"):
        f = fitted[method]
        moved = {
            "robot": np.linalg.norm((f.base_from_flange(shots.joints_rad) - nominal)[:, :3, 3], axis=1),
            "hand-eye": np.full(len(number), np.linalg.norm((f.flange_from_camera - trial.cell.flange_from_camera_guess)[:3, 3])),
            "camera": np.linalg.norm(f.corrected(shots.centre_in_camera_mm) - shots.centre_in_camera_mm, axis=1),
        }
        for part, size in moved.items():
            curves[part].append(Curve(LABELS[method], number, np.asarray(size), dots=True))
    return StudyFigure("figure10", tuple(Panel(part, "test", "compensation, mm", tuple(found)) for part, found in curves.items()))


def order_table(trial: Trial, rng: np.random.Generator, max_sweeps: int, n_shuffles: int) -> StudyTable:
    """The same shots in other orders: what each method makes of them, and how far its results move (about their mean)."""
    n = len(trial.training.joints_rad)
    orders = {"as captured": np.arange(n), "in travel order": travel_order(trial.training.joints_rad)}
    orders |= {f"shuffled {i + 1}": rng.permutation(n) for i in range(n_shuffles)}
    rows: list[tuple[Cell, ...]] = []
    reference: dict[str, FloatArray] = {}
    for name, order in orders.items():
        cells: list[Cell] = [name]
        for method in ("1", "joint"):
            shots = trial.training.ordered(order)
            f = fit_centres(method, trial.cell, shots.joints_rad, shots.centre_in_camera_mm, max_sweeps=max_sweeps)
            centres = centres_seen(f, trial.cell, trial.exact_tests, "given")
            about_mean = centres - centres.mean(axis=0)
            moved = about_mean - reference.setdefault(method, about_mean)
            cells += [float(np.sqrt((about_mean**2).sum(axis=1).mean())), float(np.linalg.norm(moved, axis=1).max())]
        rows.append(tuple(cells))
    columns = ("order", "stepwise_rms_about_mean_mm", "stepwise_moved_by_mm", "joint_rms_about_mean_mm", "joint_moved_by_mm")
    return StudyTable("order", columns, tuple(rows))


def travel_order(joints_rad: FloatArray) -> NDArray[np.intp]:
    """(m,) shots so that each follows its nearest neighbour in joint space, as a capture plan does to save time."""
    left, order = set(range(1, len(joints_rad))), [0]
    while left:
        here = joints_rad[order[-1]]
        order.append(min(left, key=lambda j: float(np.abs(joints_rad[j] - here).max())))
        left.remove(order[-1])
    return np.array(order)


def gauge_table(trial: Trial, max_sweeps: int) -> StudyTable:
    """Method 1 and 4 with different rank tolerances: e_mean follows the tolerance, the spread does not."""
    rows: list[tuple[Cell, ...]] = []
    shots = trial.training
    for tolerance in _RANK_TOLERANCES:
        cells: list[Cell] = [tolerance]
        for method in ("1", "4"):
            f = fit_centres(method, trial.cell, shots.joints_rad, shots.centre_in_camera_mm, max_sweeps=max_sweeps, relative_zero=tolerance)
            spread = spread_of(centres_seen(f, trial.cell, trial.exact_tests, "given"), trial.cell.centre_in_base_mm)
            cells += [spread.e_mean_mm, spread.rms_about_mean_mm]
        rows.append(tuple(cells))
    columns = ("rank_tolerance", "method1_e_mean_mm", "method1_rms_about_mean_mm", "method4_e_mean_mm", "method4_rms_about_mean_mm")
    return StudyTable("gauge", columns, tuple(rows))


def sign_table(trial: Trial) -> StudyTable:
    """Method 3, uncalibrated, for each way to put back the minus signs that the printed first guess lost."""
    rows: list[tuple[Cell, ...]] = []
    for signs in product((1, -1), repeat=3):
        guess = with_guess_signs(trial.cell, signs).flange_from_camera_guess
        flange = mdh.base_from_flange(trial.cell.nominal, trial.exact_tests.joints_rad)
        spread = spread_of(se3.apply(flange @ guess, trial.exact_tests.centre_in_camera_mm), trial.cell.centre_in_base_mm)
        text = " ".join("+" if sign > 0 else "-" for sign in signs)
        rows.append((text, spread.e_mean_mm, spread.e_max_mm, spread.std_mm, spread.rms_about_mean_mm))
    return StudyTable("guess_signs", ("signs_of_rotation", "e_mean_mm", "e_max_mm", "std_mm", "rms_about_mean_mm"), tuple(rows))


def descent_figure(trial: Trial, joint: Fitted, max_sweeps: int) -> StudyFigure:
    """The fall of f, and the error on noise-free tests, over the sweeps of method 1."""
    shots, cell = trial.training, trial.cell
    data = stepwise_data(cell.nominal, shots.joints_rad, shots.centre_in_camera_mm)
    settings = StepwiseSettings(camera_error=PILLOW, max_sweeps=max_sweeps, least_fall=0.0)
    solved = solve_stepwise(data, cell.flange_from_camera_guess, settings, keep_sweeps=_WATCHED_SWEEPS)
    kept = [sweep for sweep in _WATCHED_SWEEPS if sweep <= solved.sweeps]
    error = [_test_rms_mm(trial, state) for state in solved.history]
    sweeps = np.array(kept, dtype=np.float64)
    best = spread_of(centres_seen(joint, cell, trial.exact_tests, "given"), cell.centre_in_base_mm).rms_about_mean_mm
    falling = Curve("f", np.arange(len(solved.objective_mm2), dtype=np.float64), solved.objective_mm2)
    return StudyFigure(
        "descent",
        (
            Panel("objective", "sweep", "f, mm²", (falling,), log_y=True),
            Panel(
                "noise-free tests",
                "sweep",
                "centre rms about the mean, mm",
                (Curve(LABELS["1"], sweeps, np.array(error)), Curve(LABELS["joint"], sweeps, np.full(len(kept), best))),
                log_y=True,
            ),
        ),
    )


def _test_rms_mm(trial: Trial, state: StepwiseState) -> float:
    fitted = Fitted("1", trial.cell.nominal, state.link_twists, state.flange_from_camera, PILLOW, state.camera_mm)
    return spread_of(centres_seen(fitted, trial.cell, trial.exact_tests, "given"), trial.cell.centre_in_base_mm).rms_about_mean_mm
