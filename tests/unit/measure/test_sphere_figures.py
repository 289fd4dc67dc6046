"""Figures of sphere views: exact cases, invariances, and an uncertainty that Monte-Carlo agrees with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.proof.probing import shell_width_mm
from measure.sphere_figures import SphereSize, SphereView, figures_of, separation
from tests.support.sphere_views import view

CENTRE_A = np.array([900.0, 100.0, 300.0])
CENTRE_B = np.array([500.0, -300.0, 350.0])
SIZES = {"A": SphereSize(19.05), "B": SphereSize(19.05)}


def test_perfect_views_give_zero_everywhere() -> None:
    rng = np.random.default_rng(1)
    views = [view(rng, "A", i, CENTRE_A) for i in range(4)] + [view(rng, "B", i, CENTRE_B) for i in range(4, 7)]
    figures = figures_of(views, SIZES, line_profile=False)
    assert figures.centre_rms_mm == pytest.approx(0, abs=1e-8)
    assert figures.centre_max_mm == pytest.approx(0, abs=1e-8)
    assert figures.radial_rms_mm == pytest.approx(0, abs=1e-8)
    for sphere in figures.spheres.values():
        assert sphere.diameter_error_mm == pytest.approx(0, abs=1e-8)
        assert sphere.form_mm == pytest.approx(0, abs=1e-8)
    distance, _ = separation(figures.spheres["A"], figures.spheres["B"])
    assert distance == pytest.approx(np.linalg.norm(CENTRE_A - CENTRE_B), abs=1e-8)


def test_centre_rms_is_the_pooled_rms_about_each_spheres_own_mean() -> None:
    rng = np.random.default_rng(2)
    shifts = {"A": rng.normal(0, 0.3, (5, 3)), "B": rng.normal(2.0, 0.1, (3, 3))}
    centres = {"A": CENTRE_A, "B": CENTRE_B}
    views = [view(rng, name, i, centres[name], shift_mm=shift) for name, rows in shifts.items() for i, shift in enumerate(rows)]
    deviations = np.concatenate([np.linalg.norm(rows - rows.mean(axis=0), axis=1) for rows in shifts.values()])
    figures = figures_of(views, SIZES, line_profile=False)
    assert figures.centre_rms_mm == pytest.approx(np.sqrt(np.mean(deviations**2)), abs=1e-7)
    assert figures.centre_max_mm == pytest.approx(deviations.max(), abs=1e-7)


def test_a_sphere_that_reads_large_shows_it_and_the_offset_explains_it() -> None:
    rng = np.random.default_rng(3)
    views = [view(rng, "A", i, CENTRE_A, radius_mm=19.08) for i in range(5)]
    figures = figures_of(views, {"A": SphereSize(19.05, offset_mm=0.03)}, line_profile=False)
    assert figures.spheres["A"].diameter_error_mm == pytest.approx(0.06, abs=1e-8)
    assert figures.spheres["A"].diameter_error_less_offset_mm == pytest.approx(0.0, abs=1e-8)
    assert figures.radial_rms_mm == pytest.approx(0.0, abs=1e-8)


def moved(one: SphereView, base_from_old: FloatArray) -> SphereView:
    return replace(
        one, points_in_base_mm=se3.apply(base_from_old, one.points_in_base_mm), start_in_base_mm=se3.apply(base_from_old, one.start_in_base_mm)
    )


def test_a_moved_base_and_another_order_change_no_figure() -> None:
    rng = np.random.default_rng(4)
    views = [view(rng, "A", i, CENTRE_A, shift_mm=rng.normal(0, 0.2, 3), noise_mm=0.05) for i in range(6)]
    plain = figures_of(views, SIZES, line_profile=False)
    shifted = figures_of([moved(v, se3.exp([100.0, -50, 20, 0.3, -0.2, 0.9])) for v in views[::-1]], SIZES, line_profile=False)
    assert shifted.centre_rms_mm == pytest.approx(plain.centre_rms_mm, abs=1e-8)
    assert shifted.radial_rms_mm == pytest.approx(plain.radial_rms_mm, abs=1e-8)
    assert shifted.spheres["A"].diameter_error_mm == pytest.approx(plain.spheres["A"].diameter_error_mm, abs=1e-8)
    assert shifted.spheres["A"].form_mm == pytest.approx(plain.spheres["A"].form_mm, abs=1e-8)
    assert [row.index for row in shifted.views] == [row.index for row in plain.views]


def test_radial_rms_counts_each_point_once() -> None:
    rng = np.random.default_rng(5)
    views = [view(rng, "A", i, CENTRE_A, noise_mm=0.1, n=n) for i, n in enumerate((100, 3000))]
    figures = figures_of(views, SIZES, line_profile=False)
    points = np.concatenate([v.points_in_base_mm for v in views])
    residual = np.linalg.norm(points - figures.spheres["A"].centre_in_base_mm, axis=1) - 19.05
    assert figures.radial_rms_mm == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-12)


def test_line_profiles_have_no_centre_figures() -> None:
    rng = np.random.default_rng(6)
    figures = figures_of([view(rng, "A", i, CENTRE_A) for i in range(3)], SIZES, line_profile=True)
    assert figures.centre_rms_mm is None
    assert figures.centre_max_mm is None
    assert all(row.deviation_mm is None and row.centre_in_base_mm is None for row in figures.views)
    assert figures.radial_rms_mm == pytest.approx(0, abs=1e-8)


def test_one_view_of_a_sphere_has_no_scatter() -> None:
    figures = figures_of([view(np.random.default_rng(7), "A", 0, CENTRE_A, noise_mm=0.02)], SIZES, line_profile=False)
    assert figures.centre_rms_mm is None
    assert 0 < np.trace(figures.spheres["A"].centre_covariance_mm2) < 1e-3


def test_the_uncertainty_of_a_length_covers_its_scatter_between_repeats() -> None:
    """Views shifted as a whole by 0.1 mm: 60 repeats of the test must scatter as each of them says."""
    rng = np.random.default_rng(8)
    truth = np.linalg.norm(CENTRE_A - CENTRE_B)
    errors, claims = [], []
    for _ in range(60):
        views = [view(rng, "A", i, CENTRE_A, shift_mm=rng.normal(0, 0.1, 3), n=60) for i in range(8)]
        views += [view(rng, "B", i, CENTRE_B, shift_mm=rng.normal(0, 0.1, 3), n=60) for i in range(8)]
        spheres = figures_of(views, SIZES, line_profile=False).spheres
        distance, u = separation(spheres["A"], spheres["B"])
        errors.append(distance - truth)
        claims.append(u)
    assert float(np.sqrt(np.mean(np.square(errors)))) == pytest.approx(float(np.sqrt(np.mean(np.square(claims)))), rel=0.35)


def test_a_system_that_is_centimetres_off_still_finds_each_views_centre() -> None:
    rng = np.random.default_rng(9)
    shifts = rng.normal(0, 25.0, (6, 3))
    views = [view(rng, "A", i, CENTRE_A, shift_mm=shift) for i, shift in enumerate(shifts)]
    figures = figures_of(views, SIZES, line_profile=False)
    expected = np.sqrt(np.mean(((shifts - shifts.mean(axis=0)) ** 2).sum(axis=1)))
    assert figures.centre_rms_mm == pytest.approx(expected, abs=1e-6)


@settings(deadline=None)
@given(hnp.arrays(np.float64, st.integers(1, 40), elements=st.floats(-5, 5)), st.floats(0.01, 1.0))
def test_no_interval_with_enough_points_is_narrower_than_the_shell(radii: FloatArray, fraction: float) -> None:
    width = shell_width_mm(radii, fraction)
    need = int(np.ceil(fraction * len(radii)))
    holding = [b - a for a in radii for b in radii if b >= a and ((radii >= a) & (radii <= b)).sum() >= need]
    assert width == pytest.approx(min(holding), abs=1e-12)


def test_nothing_to_judge_is_an_error_that_says_so() -> None:
    with pytest.raises(DataError, match="no shot shows a sphere"):
        figures_of([], SIZES, line_profile=False)
    few = view(np.random.default_rng(1), "A", 0, CENTRE_A, n=6)
    with pytest.raises(DataError, match="6 points on sphere A"):
        figures_of([few], SIZES, line_profile=False)
