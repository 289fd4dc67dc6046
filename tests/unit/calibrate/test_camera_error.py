"""Camera error models: linear in their coefficients, the paper's pillow after scaling, tame polynomials, files."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrate.camera_error import (
    PILLOW_SCALE_MM,
    CameraError,
    FreeCrossing,
    FullPillowError,
    NoCameraError,
    PillowError,
    PolynomialError,
    camera_error_from_settings,
    camera_error_models,
    correction_in_camera_mm,
)
from calibrate.camera_error_field import field_variants, lateral_variants, richest_field
from calibrate.camera_error_stack import StackedModels
from calibrate.polynomials import Polynomials
from drivers.errors import FileError, SettingsError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray

CENTRE, HALF = (10.0, -5.0, 320.0), (120.0, 80.0, 90.0)
AFFINE = PolynomialError(CENTRE, HALF, 1, name="affine")
FIELD = PolynomialError(CENTRE, HALF, 3)
PILLOW = PillowError((60.0, 0.0, 500.0))
FULL = FullPillowError((55.0, -8.0, 480.0))
FREE = FreeCrossing(PILLOW, (0.4, -0.2, 0.1))
FREE_FULL = FreeCrossing(FULL, tuple(np.linspace(-0.3, 0.4, 9).tolist()), 30.0)
MODELS = [
    NoCameraError(),
    PILLOW,
    PillowError((-20.0, 3.0, 450.0), 2),
    FULL,
    FREE,
    FREE_FULL,
    AFFINE,
    FIELD,
    PolynomialError(CENTRE, HALF, 5, 2, 0.3, 0.05, decay=2),
]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: f"{m.name}{len(m.axis)}")


def points(seed: int, n: int = 40, spread: float = 1.0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.asarray(np.array(CENTRE) + spread * np.array(HALF) * rng.uniform(-1, 1, (n, 3)))


def by_table(table: Polynomials, p: FloatArray) -> FloatArray:
    """(n, k) terms of a kernel's table at points inside its box, by its own recurrence."""
    functions = np.ones((3, len(table.forward) + 1, len(p)))
    scaled = ((p - table.centre_mm) / table.scale_mm).T
    for n in range(len(table.forward)):
        functions[:, n + 1] = table.forward[n] * scaled * functions[:, n] - (table.backward[n] * functions[:, n - 1] if n else 0.0)
    products = np.array([functions[0, i] * functions[1, j] * functions[2, k] for i, j, k in table.degrees]).reshape(-1, len(p))
    terms = [table.factor[a:b] @ products[table.product[a:b]] for a, b in pairwise(table.starts)]
    return np.asarray(np.array(terms).reshape(len(table.axis), len(p)).T)


@every_model
def test_the_correction_is_linear_in_the_coefficients(model: CameraError) -> None:
    rng = np.random.default_rng(1)
    a, b, p = rng.normal(size=len(model.axis)), rng.normal(size=len(model.axis)), points(2)
    both = correction_in_camera_mm(model, 2 * a - 3 * b, p)
    np.testing.assert_allclose(both, 2 * correction_in_camera_mm(model, a, p) - 3 * correction_in_camera_mm(model, b, p), atol=1e-12)
    assert both.shape == p.shape
    assert model.basis(p).shape == (len(p), len(model.axis)) == (len(p), len(model.prior_sigma_mm))


@every_model
def test_a_unit_coefficient_moves_points_along_its_axis_by_its_basis(model: CameraError) -> None:
    p = points(3)
    for k, axis in enumerate(model.axis):
        moved = correction_in_camera_mm(model, np.eye(len(model.axis))[k], p)
        np.testing.assert_allclose(moved[:, axis], model.basis(p)[:, k])
        assert not np.delete(moved, axis, axis=1).any()


@every_model
def test_points_that_are_not_there_stay_so_and_spoil_no_other(model: CameraError) -> None:
    p = points(4)
    holes = p.copy()
    holes[::3] = np.nan
    coefficients = np.linspace(0.1, 1, len(model.axis))
    moved, whole = correction_in_camera_mm(model, coefficients, holes), correction_in_camera_mm(model, coefficients, p)
    np.testing.assert_array_equal(moved[1::3], whole[1::3])
    if len(model.axis):
        assert np.isnan(moved[::3, 2]).all()


@pytest.mark.parametrize(("degree", "lateral", "n_turns"), [(1, 1, 3), (3, 2, 3), (4, 0, 0)])
def test_turns_of_a_field_are_those_of_a_rigid_body_about_the_box_s_centre(degree: int, lateral: int, n_turns: int) -> None:
    field = PolynomialError(CENTRE, HALF, degree, lateral)
    assert field.turns.shape == (len(field.axis), n_turns)
    p, arms = points(13), points(13) - CENTRE
    for turn in field.turns.T:
        moved = correction_in_camera_mm(field, turn, p)
        # a unit vector w with moved = w x arm: from any three arms, then tried on all
        about = np.linalg.lstsq(np.concatenate([-se3.hat(arm) for arm in arms]), moved.ravel(), rcond=None)[0]
        np.testing.assert_allclose(moved, np.cross(about, arms), atol=1e-9)
        assert np.linalg.norm(about) == pytest.approx(1.0)


@pytest.mark.parametrize("sight_crossing_mm", [(60.0, 0.0, 500.0), (-35.0, 12.0, 700.0)])
@pytest.mark.parametrize("n_terms", [1, 3])
def test_the_scaled_pillow_is_the_papers_formula(sight_crossing_mm: tuple[float, float, float], n_terms: int) -> None:
    model = PillowError(sight_crossing_mm, n_terms)
    coefficients, p = np.random.default_rng(5).normal(size=n_terms), points(6)
    x, z = p[:, 0] - sight_crossing_mm[0], p[:, 2] - sight_crossing_mm[2]
    k = model.coefficients_k(coefficients)
    paper = sum(k[i] * z * (x**2 + z**2) ** (i + 1) for i in range(n_terms))
    np.testing.assert_allclose(correction_in_camera_mm(model, coefficients, p)[:, 2], paper, rtol=1e-12)


def test_a_pillow_coefficient_is_its_correction_in_mm_at_250_mm_from_the_crossing() -> None:
    at = np.array([[60.0, 40.0, 750.0]])
    np.testing.assert_allclose(PILLOW.basis(at), 1.0)


@every_model
def test_the_table_for_the_kernels_says_the_same_as_the_basis(model: CameraError) -> None:
    p = points(20)
    np.testing.assert_allclose(by_table(model.polynomials, p), model.basis(p), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(model.polynomials.axis, model.axis)


@pytest.mark.parametrize("crossing_mm", [(60.0, 0.0, 500.0), (-35.0, 12.0, 700.0)])
def test_the_full_pillow_is_the_papers_equation_4(crossing_mm: tuple[float, float, float]) -> None:
    model, p = FullPillowError(crossing_mm, 2), points(21)
    k = np.random.default_rng(22).normal(size=6) * 1e-9
    x, y, z = (p - crossing_mm).T
    r2, scale = x * x + z * z, PILLOW_SCALE_MM ** np.array([3, 5, 3, 5, 3, 5])
    paper = [
        x * (k[2] * r2 + k[3] * r2**2),
        y * (k[4] * (r2 + y * y) + k[5] * (r2 + y * y) ** 2),
        z * (k[0] * r2 + k[1] * r2**2),
    ]
    np.testing.assert_allclose(correction_in_camera_mm(model, k * scale, p), np.transpose(paper), rtol=1e-12)


@pytest.mark.parametrize("model", [FREE, FREE_FULL], ids=lambda m: m.name)
@pytest.mark.parametrize("coordinate", [0, 1, 2])
def test_terms_of_a_free_crossing_are_derivatives_by_it(model: FreeCrossing, coordinate: int) -> None:
    p, step = points(23), 1e-3

    def corrected(shift_mm: float) -> FloatArray:
        crossing = np.array(model.pillow.sight_crossing_mm)
        crossing[coordinate] += shift_mm
        return correction_in_camera_mm(type(model.pillow)(tuple(crossing)), np.array(model.about_mm), p)

    chosen = (model.coordinate == coordinate).astype(np.float64)
    change = correction_in_camera_mm(model, chosen, p)
    np.testing.assert_allclose(change, (corrected(step) - corrected(-step)) / (2 * step), atol=1e-9)
    # eq. 5 holds no y of the crossing
    assert change.any() == (coordinate != 1 or isinstance(model.pillow, FullPillowError))


def test_the_prior_of_a_field_falls_with_the_degree_as_told() -> None:
    field = PolynomialError(CENTRE, HALF, 4, 2, 0.6, 0.1, decay=2)
    for (axis, degrees), sigma_mm in zip(field.terms, field.prior_sigma_mm, strict=True):
        assert sigma_mm == pytest.approx((0.6 if axis == 2 else 0.1) / sum(degrees) ** 2)


def test_the_stiffest_field_comes_first_and_the_richest_holds_all() -> None:
    box = (CENTRE, HALF)
    variants = field_variants(box)
    held = set(richest_field(box).terms)
    assert all(set(one.terms) <= held for variant in variants for one in (variant, *lateral_variants(variant)))
    assert variants[0].degree == min(v.degree for v in variants)
    assert variants[0].prior_sigma_mm.max() == min(v.prior_sigma_mm.max() for v in variants)
    assert len({str(v.settings()) for v in variants}) == len(variants)
    assert lateral_variants(variants[0])[0].lateral_degree == 0


@pytest.mark.parametrize("pillow", [PILLOW, FULL], ids=lambda m: m.name)
def test_stacked_models_hold_each_model_in_its_columns(pillow: PillowError | FullPillowError) -> None:
    stacked, p = StackedModels(richest_field((CENTRE, HALF)), (pillow,)), points(24)
    rng = np.random.default_rng(25)
    for model in (NoCameraError(), PolynomialError(CENTRE, HALF, 1, 1, name="affine"), pillow, PolynomialError(CENTRE, HALF, 4, 2, 0.3)):
        part, coefficients = stacked.columns_of(model), rng.normal(size=len(model.axis))
        np.testing.assert_array_equal(part.prior_sigma_mm, model.prior_sigma_mm)
        there = stacked.coefficients_mm(model, coefficients)
        np.testing.assert_allclose(
            correction_in_camera_mm(stacked, there, p), correction_in_camera_mm(model, coefficients, p), rtol=1e-9, atol=1e-12
        )
    table = stacked.polynomials
    np.testing.assert_array_equal(table.axis, stacked.axis)
    np.testing.assert_allclose(by_table(table, p), stacked.basis(p), rtol=1e-8, atol=1e-9)


def test_legendre_terms_inside_the_box_are_numpys() -> None:
    p = points(7)
    scaled = (p - CENTRE) / HALF
    for column, (i, j, k) in zip(FIELD.basis(p).T, FIELD.exponents, strict=True):
        factors = [np.polynomial.Legendre.basis(d)(scaled[:, a]) for a, d in enumerate((i, j, k))]
        np.testing.assert_allclose(column, np.prod(factors, axis=0), atol=1e-12)


@pytest.mark.parametrize(("model", "n"), [(AFFINE, 3), (FIELD, 19)])
def test_a_polynomial_has_every_term_of_its_degree_but_the_constant(model: PolynomialError, n: int) -> None:
    assert len(model.axis) == n == len(set(model.exponents))
    assert (0, 0, 0) not in model.exponents
    # independent of each other and of a constant: no combination is a shift along the optical axis
    design = np.column_stack([np.ones(400), model.basis(points(8, 400))])
    assert np.linalg.cond(design) < 100


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_polynomial_is_continuous_at_its_box_and_straight_beyond(axis: int, side: float) -> None:
    p = points(9, 5)

    def at(fraction: float) -> FloatArray:
        moved = p.copy()
        moved[:, axis] = CENTRE[axis] + side * fraction * HALF[axis]
        return FIELD.basis(moved)

    step = 1e-6
    np.testing.assert_allclose(at(1 - step), at(1 + step), atol=2e-4)
    slope_in, slope_out = (at(1) - at(1 - step)) / step, (at(1 + step) - at(1)) / step
    np.testing.assert_allclose(slope_in, slope_out, atol=1e-3)
    np.testing.assert_allclose(at(3.0) - 2 * at(2.5) + at(2.0), 0.0, atol=1e-9)


@every_model
def test_settings_bring_the_same_model_back(model: CameraError) -> None:
    again = camera_error_from_settings(model.settings())
    assert again == model
    np.testing.assert_array_equal(again.basis(points(10, spread=2.0)), model.basis(points(10, spread=2.0)))


@every_model
@given(data=st.data())
def test_broken_settings_are_a_file_error(model: CameraError, data: st.DataObject) -> None:
    settings = model.settings()
    key = data.draw(st.sampled_from(sorted(settings)))
    if data.draw(st.booleans()):
        broken: Mapping[str, object] = {k: v for k, v in settings.items() if k != key}
    else:
        broken = settings | {key: data.draw(st.sampled_from([None, "pillo", [], [1.0, "x", 2.0], {}, [1, 2], True, float("nan")]))}
    try:
        made = camera_error_from_settings(broken, file="c.yaml")
    except FileError as error:
        assert (error.file, error.where) == ("c.yaml", "camera_error")  # noqa: PT017 - either way out is right
    else:
        # whatever is still let in must be a model that gives finite corrections
        assert np.isfinite(made.basis(points(11))).all()


def test_models_are_made_by_name_around_the_points_seen() -> None:
    p = points(12, 200)
    made = camera_error_models(["field", "none", "pillow", "affine"], points_in_camera_mm=p, sight_crossing_mm=(1.0, 2.0, 3.0))
    assert [m.name for m in made] == ["field", "none", "pillow", "affine"]
    assert isinstance(made[2], PillowError)
    assert made[2].sight_crossing_mm == (1.0, 2.0, 3.0)
    field = made[0]
    assert isinstance(field, PolynomialError)
    assert (np.abs((p - field.centre_mm) / field.half_size_mm) <= 1 + 1e-12).all()


def test_an_unknown_model_is_a_settings_error_with_the_choices() -> None:
    with pytest.raises(SettingsError, match="pilow") as told:
        camera_error_models(["pilow"], points_in_camera_mm=points(13), sight_crossing_mm=(0.0, 0.0, 0.0))
    assert "pillow" in str(told.value)
    assert "auto" in str(told.value)
