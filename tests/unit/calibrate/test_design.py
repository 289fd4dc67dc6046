"""Design of poses: information against the solver's own, rank updates against dense sums, the choice against chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate import normal
from calibrate.design import best_next, choose_shots, information_before, information_of, predicted_of_shots
from calibrate.design_cell import work_box_mm
from calibrate.design_mismatch import Physics, camera_disturbance, deflection_columns, modelled_covariance_mm2
from calibrate.design_search import Information, mean_square, scores
from calibrate.design_shots import Expectation, ideal_caps, layout_of, point_weight, prior_sigma, shot_rows
from calibrate.normal import NoiseModel
from calibrate.problem import linearise_geometry
from calibrate.robot_terms import arm_terms, load_basis
from calibrate.sums import shot_moments
from drivers.errors import DataError, SettingsError
from drivers.kinematics import mdh, se3
from tests.support.designing import Case, random_rows, solved_length_errors_mm, volume_case
from tests.support.solving import one_thread
from tests.support.volume import volume_cell


@pytest.fixture(scope="module")
def case() -> Case:
    return volume_case(per_sphere=40)


def believing_its_priors(information: Information) -> Information:
    return replace(information, actual_covariance=np.diag(information.prior_sigma**2))


def test_information_is_that_of_the_solver_on_the_same_points(case: Case) -> None:
    scene, joints, sphere = case.scene, case.joints_rad[::20], case.sphere[::20]
    blank = scene.problem(joints, sphere)
    state = scene.nominal_state(blank.n_scans)
    geometry = linearise_geometry(blank, state)
    unit = ideal_caps(scene, joints, sphere).unit
    points = (geometry.centre_in_camera_mm[:, None] + scene.radius_mm[sphere][:, None, None] * unit).reshape(-1, 3)
    starts = np.arange(len(joints) + 1) * unit.shape[1]
    problem = replace(blank, points_in_camera_mm=points, starts=starts)
    moments, _ = shot_moments(problem, state, geometry, np.inf)
    linearised = normal.linearise(problem, state, geometry, moments, np.full(len(joints), point_weight(scene)))
    dense = normal.reduce(linearised, scene.expectation.noise.pose_precision).hessian
    # a turn that camera and hand-eye share is held in a solve; it moves no measured point
    camera = layout_of(scene).camera
    dense[camera, camera] -= normal.gauge_precision(scene.camera_error)
    ours = information_of(scene, joints, sphere).hessian
    # in units of the priors, where one is what a prior knows; hand-eye and centres have a wide one here and none there
    sigma = prior_sigma(scene)
    difference = np.abs(ours - dense) * sigma[:, None] * sigma
    layout = layout_of(scene)
    free = np.r_[layout.hand_eye, layout.centres]
    difference[free, free] -= np.minimum(difference[free, free], 1.0 + 1e-6)
    assert difference.max() < 0.01 * len(joints) + 1e-9 * (np.abs(dense) * sigma[:, None] * sigma).max()


def test_a_score_is_the_criterion_after_the_shot_computed_densely(case: Case) -> None:
    few = np.arange(0, len(case.sphere), 9)
    information = believing_its_priors(information_of(case.scene, case.joints_rad[few], case.sphere[few]))
    rows = shot_rows(case.scene, case.joints_rad[1::31], case.sphere[1::31])
    dense = [mean_square(information.plus(row), case.aim.lengths).total_mm2 for row in rows]
    before = mean_square(information, case.aim.lengths).total_mm2
    np.testing.assert_allclose(scores(information, case.aim.lengths, rows) - before, np.array(dense) - before, rtol=2e-3, atol=1e-6 * before)


def test_informations_add_up_and_come_off_again(case: Case) -> None:
    a, b = slice(0, 30, 3), slice(1, 30, 3)
    both = np.r_[0:30:3, 1:30:3]
    whole = information_of(case.scene, case.joints_rad[both], case.sphere[both])
    rows = shot_rows(case.scene, case.joints_rad[b], case.sphere[b])
    first = information_of(case.scene, case.joints_rad[a], case.sphere[a])
    sigma = prior_sigma(case.scene)
    for one, other in ((whole, first.plus(rows)), (first, whole.plus(rows, -1.0))):
        size = np.sqrt(np.diagonal(one.hessian))
        assert (np.abs(one.hessian - other.hessian) / size[:, None] / size).max() < 1e-6
        assert np.abs((one.push - other.push) * sigma[:, None]).max() < 1e-6 * np.abs(one.push * sigma[:, None]).max() + 0.1


def test_a_shot_never_makes_it_worse_where_the_model_is_right(case: Case) -> None:
    information = believing_its_priors(information_before(case.scene))
    left = mean_square(information, case.aim.lengths).modelled_mm2
    for row in shot_rows(case.scene, case.joints_rad[::24], case.sphere[::24]):
        information = information.plus(row)
        now = mean_square(information, case.aim.lengths).modelled_mm2
        assert now <= left * (1 + 1e-9)
        left = now


def test_the_choice_does_not_depend_on_the_order_of_candidates(case: Case) -> None:
    shuffled = np.random.default_rng(3).permutation(len(case.sphere))
    with one_thread():
        plain = choose_shots(case.scene, case.aim, case.joints_rad, case.sphere, 18, sweeps=1)
        other = choose_shots(case.scene, case.aim, case.joints_rad[shuffled], case.sphere[shuffled], 18, sweeps=1)
    assert list(shuffled[other.rows]) == list(plain.rows)
    assert other.predicted == plain.predicted


def test_thirty_chosen_are_expected_to_do_what_fifty_random_do(case: Case) -> None:
    rng = np.random.default_rng(5)
    with one_thread():
        chosen = choose_shots(case.scene, case.aim, case.joints_rad, case.sphere, 30)
        drawn = [random_rows(case, n, rng) for n in (30, 48, 48)]
        random = [predicted_of_shots(case.scene, case.aim, case.joints_rad[r], case.sphere[r]) for r in drawn]
    assert chosen.predicted.length_rms_mm < 0.75 * random[0].length_rms_mm
    assert chosen.predicted.length_rms_mm < min(p.length_rms_mm for p in random[1:])
    assert min(np.bincount(case.sphere[chosen.rows])) >= 3
    assert len(set(chosen.rows)) == 30
    again = predicted_of_shots(case.scene, case.aim, case.joints_rad[chosen.rows], case.sphere[chosen.rows])
    assert again.length_rms_mm == pytest.approx(chosen.predicted.length_rms_mm, rel=1e-6)


def test_the_next_pose_is_the_one_that_helps_most(case: Case) -> None:
    taken, offered = np.arange(0, len(case.sphere), 11), np.arange(1, len(case.sphere), 29)
    information = believing_its_priors(information_of(case.scene, case.joints_rad[taken], case.sphere[taken]))
    found = best_next(case.scene, case.aim, information, case.joints_rad[offered], case.sphere[offered], n=2)
    rows = shot_rows(case.scene, case.joints_rad[offered], case.sphere[offered])
    dense = np.array([mean_square(information.plus(row), case.aim.lengths).total_mm2 for row in rows])
    assert dense[found[0]] <= dense.min() * (1 + 1e-5)
    assert dense[found[1]] <= np.sort(dense)[1] * (1 + 1e-5)


def test_more_shots_than_candidates_are_refused(case: Case) -> None:
    with pytest.raises(SettingsError, match="9 shots are wanted and 8 are feasible"):
        choose_shots(case.scene, case.aim, case.joints_rad[:8], case.sphere[:8], 9)


@pytest.mark.parametrize("n_truths", [24, pytest.param(200, marks=pytest.mark.qualify)])
def test_prediction_is_what_solves_of_drawn_truths_show(n_truths: int) -> None:
    noise = NoiseModel(point_mm=0.06, pose_mm=0.02, pose_rad=1e-4)
    case = volume_case("bar1", per_sphere=30, camera_error="affine", expectation=Expectation(noise=noise, n_points=64))
    with one_thread():
        rows = random_rows(case, 40, np.random.default_rng(1))
        expected = predicted_of_shots(case.scene, case.aim, case.joints_rad[rows], case.sphere[rows]).length_noise_rms_mm
        errors = [solved_length_errors_mm(case, rows, np.random.default_rng([7, k])) for k in range(n_truths)]
    assert float(np.sqrt(np.mean(np.square(errors)))) == pytest.approx(expected, rel=0.15)


def test_a_missing_length_shows() -> None:
    figures = {}
    for artefact in ("six", "bar3"):
        case = volume_case(artefact, per_sphere=10)
        figures[artefact] = predicted_of_shots(case.scene, case.aim, case.joints_rad, case.sphere)
    assert figures["six"].length_rms_mm > 4 * figures["bar3"].length_rms_mm
    # repeatability does not see it
    assert figures["six"].centre_rms_mm == pytest.approx(figures["bar3"].centre_rms_mm, rel=0.02)


def test_deflection_columns_are_the_arms_own_terms(case: Case) -> None:
    model, q = case.scene.model, case.joints_rad[::40]
    point_in_flange = np.broadcast_to([30.0, -50.0, 400.0], (len(q), 3))
    priors = case.scene.expectation.priors
    terms = arm_terms(model)
    flange = mdh.base_from_flange(model, q)
    columns = deflection_columns(priors, model, q, se3.apply(flange, point_in_flange))
    step = 1e-3
    for k in range(len(terms)):
        turn = load_basis(terms, model, q)[:, :, k] * priors.term_sigma_rad(terms)[k] * step
        moved = mdh.base_from_flange(model, q + turn @ np.linalg.inv(model.coupling).T)
        difference = se3.apply(moved, point_in_flange) - se3.apply(flange, point_in_flange)
        np.testing.assert_allclose(columns[:, :, k], difference / step, atol=1e-5)


@pytest.mark.parametrize("name", ["none", "affine", "pillow", "field"])
def test_a_uniform_scale_of_the_camera_is_counted_once(name: str) -> None:
    physics = Physics(depth_mm=(0.0,) * 4, lateral_mm=(0.0,) * 3)
    scene = volume_case("bar1", per_sphere=1, camera_error=name).scene
    camera = scene.camera_error
    rng = np.random.default_rng(2)
    points = rng.uniform(scene.camera_box_mm[0], scene.camera_box_mm[1], (20, 3))
    unit = rng.normal(size=(20, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    scaled = ((points - scene.camera_box_mm.mean(axis=0)) * unit).sum(axis=1) * physics.camera_scale
    unmodelled = camera_disturbance(physics, scene.camera_box_mm, camera).shares(points, unit)
    if name in {"none", "pillow"}:
        np.testing.assert_allclose(unmodelled[:, -1], scaled)
        return
    assert not unmodelled.any()
    shares = camera.basis(points) * unit[:, camera.axis]
    variance = shares @ modelled_covariance_mm2(physics, camera) @ shares.T
    np.testing.assert_allclose(variance, np.outer(scaled, scaled), atol=1e-15)


def test_line_profiles_can_be_designed_for(case: Case) -> None:
    scene = replace(case.scene, along_sight=False)
    centre = linearise_geometry(scene.problem(case.joints_rad, case.sphere), scene.nominal_state(len(case.sphere))).centre_in_camera_mm
    cut = np.flatnonzero(np.abs(centre[:, 1]) < 0.7 * scene.radius_mm[case.sphere])
    joints, sphere = case.joints_rad[cut], case.sphere[cut]
    unit = ideal_caps(scene, joints, sphere).unit
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1.0)
    np.testing.assert_allclose(centre[cut, None, 1] + scene.radius_mm[sphere, None] * unit[..., 1], 0.0, atol=1e-9)
    assert (unit[..., 2] < 0).all()
    predicted = predicted_of_shots(scene, replace(case.aim, centres=case.aim.centres[:0], centre_noise_mm2=np.nan), joints, sphere)
    assert predicted.centre_rms_mm is None
    assert 0 < predicted.length_rms_mm < 1


def test_where_accuracy_matters() -> None:
    cell = volume_cell(0).cell
    np.testing.assert_allclose(work_box_mm(cell, np.zeros((1, 3))), [[640, -330, 130], [1120, 330, 560]])
    without = cell.model_copy(update={"work_volume_mm": None})
    box = work_box_mm(without, np.array([[900.0, 0, 300], [900.0, 600, 300]]))
    np.testing.assert_allclose(box, [[750, 0, 150], [1050, 600, 450]])


def test_an_aim_needs_two_places() -> None:
    from calibrate.design_aim import aim_at

    case = volume_case("bar1", per_sphere=1)
    with pytest.raises(DataError, match="fewer than two places"):
        aim_at(case.scene, case.places_in_base_mm, [case.views_rad[0], *[np.zeros((0, 6))] * 7])


def test_less_noise_is_expected_to_leave_less(case: Case) -> None:
    quiet = replace(case.scene, expectation=Expectation(noise=NoiseModel(point_mm=0.02, pose_mm=0.005, pose_rad=2e-5), n_points=5000))
    few = slice(None, None, 4)
    usual, better = (predicted_of_shots(s, case.aim, case.joints_rad[few], case.sphere[few]) for s in (case.scene, quiet))
    assert better.length_noise_rms_mm < 0.5 * usual.length_noise_rms_mm
