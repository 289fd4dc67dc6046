"""Tracker points in a verification: errors as large as the calibration says, a moved reference found, unknown names refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.external_points import ExternalShot
from calibrate.solve import calibrate
from drivers.files.session import read_session
from drivers.kinematics import se3
from measure.proof.external import external_figures, judgeable
from measure.proof.external_lengths import external_gaps, external_lengths
from tests.support.recorded import TrueSystem
from tests.support.synthetic import paper_cell
from tests.support.tracker import TrackedRobot, tracked_robot, tracker_cell_data, write_tracker_session

ROBOT = tracked_robot(31)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    folder = tmp_path_factory.mktemp("tracked")
    shots = ROBOT.shots(np.random.default_rng(32), 40)
    return calibrate([read_session(write_tracker_session(folder / "t", shots, tracker_cell_data("abb_irb1410")))])


def unseen(n: int, robot: TrackedRobot = ROBOT) -> list[ExternalShot]:
    return robot.shots(np.random.default_rng(33), n)


def test_errors_at_unseen_poses_are_as_large_as_their_covariance_says(calibration: Calibration) -> None:
    """A twentieth of the components may lie outside U; without the correlations of the solve the expected rms is far too large."""
    found = external_figures(calibration, unseen(80))
    assert found is not None
    error = np.array([point.error_mm for point in found.points])
    inside = np.abs(error) < [point.expanded_uncertainty_mm for point in found.points]
    assert 0.9 < inside.mean() < 1.0
    assert 0.8 < found.expected_rms_mm / found.rms_mm < 1.5
    assert found.rms_mm == pytest.approx(np.sqrt((error**2).sum(axis=1).mean()))
    assert found.warnings() == ()


def test_a_moved_tracker_is_told_with_its_direction(calibration: Calibration) -> None:
    moved = replace(ROBOT, base_from_tracker=se3.from_rotation_translation(np.eye(3), [1.0, 0, 0]) @ ROBOT.base_from_tracker)
    before, after = (external_figures(calibration, unseen(40, robot)) for robot in (ROBOT, moved))
    assert before is not None
    assert after is not None
    shift = np.mean([b.error_mm - a.error_mm for a, b in zip(before.points, after.points, strict=True)], axis=0)
    # to the calibration, which holds the tracker to stand still, every target seems 1 mm back; the true base is the nominal one but for robot errors
    np.testing.assert_allclose(shift, [1.0, 0, 0], atol=0.02)
    assert "was moved" in after.warnings()[0]


def test_the_covariance_follows_every_unknown_of_the_solve(calibration: Calibration) -> None:
    """A variance on one unknown alone is the square of what moving that unknown does."""
    shot, names = unseen(1)[0], calibration.parameter_names
    quiet = replace(calibration, noise=replace(calibration.noise, pose_mm=1e-9, pose_rad=1e-12, external_mm=1e-9))
    assert quiet.external is not None
    for name in ("link2.phi_z_rad", "reference.tracker.phi_y_rad", "target.reflector.z_mm"):
        one, step = names.index(name), 1e-4
        only = replace(quiet, covariance=np.diag(np.eye(len(names))[one]) * step**2)
        stepped = _stepped(quiet, name, step)
        here, there = (external_figures(system, [shot]) for system in (only, stepped))
        assert here is not None
        assert there is not None
        motion = there.points[0].error_mm - here.points[0].error_mm
        assert np.linalg.norm(motion) > 1e-6
        np.testing.assert_allclose(here.points[0].covariance_mm2, np.outer(motion, motion), rtol=2e-3, atol=1e-3 * float(motion @ motion))


def _stepped(calibration: Calibration, name: str, step: float) -> Calibration:
    """One unknown moved, the stated base held: the link's twist, the frame's left twist in the solver's base, the target."""
    external = calibration.external
    assert external is not None
    if name.startswith("link"):
        twists = calibration.link_twists.copy()
        twists[1, 5] += step
        return replace(calibration, link_twists=twists)
    if name.startswith("target"):
        target = external.targets["reflector"]
        moved = replace(target, point_in_flange_mm=target.point_in_flange_mm + np.array([0, 0, step]))
        return replace(calibration, external=replace(external, targets={"reflector": moved}))
    frame, datum = external.references["tracker"], calibration.datum.base_from_solver
    twist = se3.exp(np.array([0, 0, 0, 0, step, 0.0]))
    pose = datum @ twist @ se3.inverse(datum) @ frame.base_from_reference
    return replace(calibration, external=replace(external, references={"tracker": replace(frame, base_from_reference=pose)}))


def test_lengths_are_as_wrong_as_they_say_and_blind_to_where_the_tracker_stands(calibration: Calibration) -> None:
    shots = unseen(80)
    lengths = external_lengths(calibration, shots)
    assert len(lengths) == 40
    assert len({name for length in lengths for name in length.between}) == 80  # every point once
    error, u = (np.array([getattr(x, key) for x in lengths]) for key in ("error_mm", "expanded_uncertainty_mm"))
    assert 0.85 < np.mean(np.abs(error) < u) <= 1.0
    assert 0.5 < np.sqrt(np.mean((2 * error / u) ** 2)) < 1.4
    new_from_old = se3.from_rotation_translation(se3.exp_so3([0.3, -1.0, 0.4]), [500.0, 70, -80])
    moved = [replace(shot, reference="new", point_in_reference_mm=se3.apply(new_from_old, shot.point_in_reference_mm)) for shot in shots]
    again = external_lengths(calibration, moved[::-1])
    np.testing.assert_allclose([x.error_mm for x in again], error, atol=1e-6)
    # a scale error of the robot, as a wrong link length makes it, shows at its size on the longest
    longer = [replace(shot, point_in_reference_mm=1.001 * shot.point_in_reference_mm) for shot in shots]
    shift = error - [x.error_mm for x in external_lengths(calibration, longer)]
    np.testing.assert_allclose(shift, [0.001 * x.reference_mm for x in lengths], rtol=1e-6)


def test_the_uncertainty_of_a_length_follows_every_unknown_of_the_solve(calibration: Calibration) -> None:
    names, shots = calibration.parameter_names, unseen(2)
    quiet = replace(calibration, noise=replace(calibration.noise, pose_mm=1e-9, pose_rad=1e-12, external_mm=1e-9))
    for name in ("link2.phi_z_rad", "target.reflector.z_mm"):
        step = 1e-4
        only = replace(quiet, covariance=np.diag(np.eye(len(names))[names.index(name)]) * step**2)
        here, there = (external_lengths(system, shots)[0] for system in (only, _stepped(quiet, name, step)))
        assert here.expanded_uncertainty_mm / 2 == pytest.approx(abs(there.measured_mm - here.measured_mm), rel=2e-3)


def test_points_alone_do_not_judge_a_camera_and_few_judge_nothing(calibration: Calibration) -> None:
    assert external_gaps(calibration, unseen(12)) == []
    assert len(external_gaps(calibration, unseen(9))) == 1
    assert external_lengths(TrueSystem(paper_cell()), unseen(12)) == ()


def test_points_that_cannot_be_judged_have_a_reason(calibration: Calibration) -> None:
    good, *rest = unseen(3)
    elsewhere = replace(rest[0], reference="other")
    shots = [good, elsewhere, replace(rest[1], target="elbow")]
    kept, rejected = judgeable(calibration, shots)
    assert kept == (good, elsewhere)  # a tracker that was set up anew still measures lengths
    assert [shot.reason for shot in rejected] == ["external reference point: the calibration does not know target elbow (it knows reflector)"]
    found = external_figures(calibration, kept)
    assert found is not None
    assert [point.reference for point in found.points] == ["tracker"]
    assert external_figures(calibration, ()) is None
    system = TrueSystem(paper_cell())
    assert [("made without any" in shot.reason) for shot in judgeable(system, shots)[1]] == [True] * 3
