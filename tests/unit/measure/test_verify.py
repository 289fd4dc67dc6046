"""Verification by a system that knows the truth, on sessions of an independent simulator."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Limits
from acquire.session import SessionWriter
from drivers.errors import DataError
from drivers.files.session import Session, read_session
from drivers.kinematics import mdh
from measure.verify import verify
from tests.support.recorded import PLACES, TrainedOn, TrueSystem, record_session, write_cell
from tests.support.synthetic import draw_shot, paper_cell

SYSTEM = TrueSystem(paper_cell())
WIDE = Limits(centre_rms_mm=1.0, length_error_mm=1.0, diameter_error_mm=1.0, form_mm=1.0)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("verify")
    return record_session(folder / "session", write_cell(folder), np.random.default_rng(1), shots_per_sphere=6)


def test_the_truth_conforms_and_its_figures_are_the_noise(session: Session) -> None:
    result = verify(SYSTEM, [session], limits=WIDE)
    assert result.verdict == "conform", result.reasons
    assert (result.n_shots, result.used) == (12, 12)
    # 0.01 mm and 0.1 mrad on 450 mm of pose noise: 0.065 mm of centre rms
    assert result.figures.centre_rms_mm is not None
    assert 0.02 < result.figures.centre_rms_mm < 0.12
    assert abs(result.lengths[0].error_mm) < 0.15
    assert abs(result.lengths[0].error_mm) < result.lengths[0].expanded_uncertainty_mm
    assert all(abs(sphere.diameter_error_mm) < 0.15 for sphere in result.figures.spheres.values())


def test_the_uncalibrated_system_is_shown_beside_it_and_worse(session: Session) -> None:
    result = verify(SYSTEM, [session])
    assert result.before is not None
    assert result.before.centre_rms_mm is not None
    assert result.figures.centre_rms_mm is not None
    assert result.before.centre_rms_mm > 5 * result.figures.centre_rms_mm
    assert set(result.before_length_errors_mm) == {"A-B"}


def test_json_has_the_keys_that_stay(session: Session) -> None:
    data = json.loads(json.dumps(verify(SYSTEM, [session]).to_json_dict(), allow_nan=False))
    assert {"n_shots", "centre_rms_mm", "centre_max_mm", "radial_rms_mm", "lengths", "spheres", "verdict", "reasons"} <= set(data)
    assert {"between", "measured_mm", "reference_mm", "error_mm", "expanded_uncertainty_mm"} <= set(data["lengths"][0])
    assert set(data["spheres"]) == {"A", "B"}
    assert {"diameter_error_mm", "form_mm"} <= set(data["spheres"]["A"])
    assert data["lengths"][0]["error_mm"] == pytest.approx(data["lengths"][0]["measured_mm"] - data["lengths"][0]["reference_mm"])


def test_the_expanded_uncertainty_holds_calibration_scatter_and_reference(session: Session) -> None:
    small, large = (verify(replace(SYSTEM, sigma_of_scale=sigma), [session]).lengths[0] for sigma in (0.0, 1e-3))
    assert small.expanded_uncertainty_mm == pytest.approx(2 * small.test_standard_uncertainty_mm)
    assert small.test_standard_uncertainty_mm > 0.0025
    # a shift of the base moves both ends alike and counts for nothing; a scale counts with the whole length (and, since it
    # makes the spheres larger too, a little through the fixed radius)
    assert large.expanded_uncertainty_mm == pytest.approx(2 * np.hypot(1e-3 * large.measured_mm, small.test_standard_uncertainty_mm), rel=0.03)
    # the decision is charged with the test's uncertainty only
    assert large.test_standard_uncertainty_mm == small.test_standard_uncertainty_mm


def test_the_uncertainty_of_a_diameter_holds_calibration_scatter_and_certificate(session: Session) -> None:
    small, large = (verify(replace(SYSTEM, sigma_of_scale=sigma), [session], limits=WIDE).sphere_uncertainties["A"] for sigma in (1e-12, 1e-3))
    assert small.diameter_calibration_mm < 1e-9
    # a scale of the base is one of the diameter
    assert large.diameter_calibration_mm == pytest.approx(1e-3 * 38.1, rel=0.01)
    parts = (large.diameter_reference_mm, large.diameter_repeat_mm, large.diameter_calibration_mm)
    assert large.diameter_expanded_mm == pytest.approx(2 * np.linalg.norm(parts))
    sphere = verify(SYSTEM, [session], limits=WIDE).to_json_dict()["spheres"]
    assert isinstance(sphere, dict)
    assert {"diameter_expanded_uncertainty_mm", "form_expanded_uncertainty_mm", "uncertainty"} <= sphere["A"].keys()


def test_the_conditions_of_a_test_are_told(session: Session) -> None:
    told = dict(verify(SYSTEM, [session], limits=WIDE).conditions)
    times = sorted(str(shot.time_utc) for shot in session.shots)
    assert told["verification shots taken"] == f"{times[0]} to {times[-1]}"
    assert told["verification temperatures"] == "none was recorded"
    assert told["verification sphere A"].startswith("diameter 38.1000 mm, U 0.00")
    assert "mm, U 0.00" in told["verification length A-B"]


def test_the_limits_choose_what_the_guard_band_holds(session: Session) -> None:
    """On the system's error, repeats count; on the values of this test, the artefact alone."""
    usual, values = (verify(SYSTEM, [session], limits=WIDE.model_copy(update={"guard": guard})) for guard in ("reference_and_repeat", "reference"))
    for a, b in zip(usual.judgements, values.judgements, strict=True):
        assert (a.quantity, a.value_mm) == (b.quantity, b.value_mm)
        assert b.standard_uncertainty_mm < a.standard_uncertainty_mm
    length = values.lengths[0]
    assert values.judgements[1].standard_uncertainty_mm == length.reference_standard_uncertainty_mm
    assert usual.judgements[1].standard_uncertainty_mm == length.test_standard_uncertainty_mm
    assert "artefact alone" in str(values.to_json_dict()["decision_rule"])
    assert "artefact and repeatability" in str(usual.to_json_dict()["decision_rule"])
    # a choice that nobody made is not written, so that old files keep their digests
    assert "guard" not in WIDE.model_dump()
    assert WIDE.model_copy(update={"guard": "reference"}).model_dump()["guard"] == "reference"


def test_the_radius_offsets_uncertainty_moves_centres_as_a_refit_does(session: Session) -> None:
    """First order against the difference of two fits with other radii."""
    step = 1e-3
    low, high = (verify(replace(SYSTEM, radius_offset_mm=r, sigma_of_scale=0.0), [session]).lengths[0].measured_mm for r in (-step, step))
    expected = abs(high - low) / (2 * step) * 0.1
    plain, unsure = (verify(replace(SYSTEM, sigma_of_scale=0.0, sigma_of_radius_mm=s), [session]).lengths[0] for s in (0.0, 0.1))
    found = np.sqrt(unsure.expanded_uncertainty_mm**2 - plain.expanded_uncertainty_mm**2) / 2
    assert found == pytest.approx(expected, rel=0.1, abs=1e-4)


def test_without_limits_nothing_is_proven(tmp_path: Path) -> None:
    session = record_session(tmp_path / "session", write_cell(tmp_path, limits=False), np.random.default_rng(2), shots_per_sphere=3)
    result = verify(SYSTEM, [session])
    assert result.verdict == "not_proven"
    assert "no limits given" in result.reasons


def test_a_wrong_scale_is_rejected_and_the_length_named(session: Session) -> None:
    """A camera that is right but a robot whose upper arm is 0.6 mm longer than the system thinks."""
    cell = paper_cell()
    long_arm = replace(cell.true, a_mm=cell.true.a_mm + np.array([0, 0, 2.0, 0, 0, 0]))
    result = verify(TrueSystem(replace(cell, true=long_arm)), [session], limits=replace_limits(length_error_mm=0.05))
    assert result.verdict == "reject"
    assert any("length A-B" in reason or "centre rms" in reason for reason in result.reasons)


def replace_limits(**changes: float) -> Limits:
    return WIDE.model_copy(update=changes)


def test_a_sphere_that_reads_large_shows_in_its_diameter_and_not_in_the_lengths(tmp_path: Path) -> None:
    truth = replace(paper_cell(), reads_large_mm=0.1)
    session = record_session(tmp_path / "session", write_cell(tmp_path), np.random.default_rng(3), truth=truth, shots_per_sphere=8)
    told = verify(TrueSystem(truth, radius_offset_mm=0.1), [session])
    for sphere in told.figures.spheres.values():
        assert sphere.diameter_error_mm == pytest.approx(0.2, abs=0.1)
        assert sphere.diameter_error_less_offset_mm == pytest.approx(0.0, abs=0.1)
    assert abs(told.lengths[0].error_mm) < 0.15


def test_training_scans_are_refused_wherever_they_lie(session: Session) -> None:
    trained = replace(SYSTEM, shots=(TrainedOn(str(session.shots[3].sha256)),))
    with pytest.raises(DataError, match="prove nothing") as caught:
        verify(trained, [session])
    assert caught.value.where == "shot 3"
    allowed = verify(trained, [session], limits=WIDE, allow_training_data=True)
    assert allowed.verdict == "not_proven"
    assert not allowed.held_out
    assert "flatter" in allowed.reasons[0]


def test_a_slide_test_with_the_same_robot_poses_at_both_ends_is_not_judged(tmp_path: Path) -> None:
    """The same four robot poses see both ends: the length is that of the camera alone."""
    cell = write_cell(tmp_path, {"A": (900.0, 100.0, 300.0), "B": (950.0, 100.0, 300.0)})
    truth, rng = paper_cell(), np.random.default_rng(4)
    with SessionWriter.create(tmp_path / "session", purpose="verification", cell=cell) as writer:
        for _ in range(4):
            shot = draw_shot(truth, rng, n_points=300, depth_noise_mm=0.0, pose_noise=(0.0, 0.0))
            shifted = shot.points_in_camera_mm + shot.true_base_from_camera[:3, :3].T @ np.array([50.0, 0, 0])
            for sphere, points in (("A", shot.points_in_camera_mm), ("B", shifted)):
                writer.append(sphere=sphere, joints_rad=shot.joints_rad, xyz_mm=points.astype(np.float32))
    result = verify(SYSTEM, [read_session(tmp_path / "session")], limits=WIDE)
    assert result.verdict == "not_proven"
    assert result.lengths[0].not_judged is not None
    assert any("same robot poses" in reason for reason in result.reasons)


def test_shots_without_a_sphere_are_listed_and_not_an_error(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    rng = np.random.default_rng(5)
    own = record_session(tmp_path / "session", cell, rng, shots_per_sphere=3)
    with SessionWriter.resume(own.folder, cell=cell) as writer:
        plane = np.stack([*rng.uniform(-60, 60, (2, 500)), np.full(500, 330.0)], axis=1)
        writer.append(sphere="A", joints_rad=np.zeros(6), xyz_mm=plane.astype(np.float32))
        writer.append(sphere="A", joints_rad=np.zeros(6), status="failed", reason="robot did not settle")
    result = verify(SYSTEM, [read_session(own.folder)])
    assert (result.n_shots, result.used) == (8, 6)
    assert [shot.index for shot in result.rejected] == [6, 7]
    assert "settle" in result.rejected[1].reason
    assert result.to_json_dict()["n_shots"] == 8


def test_no_sphere_at_all_is_an_error_with_the_first_refusal(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    with SessionWriter.create(tmp_path / "session", purpose="verification", cell=cell) as writer:
        writer.append(sphere="A", joints_rad=np.zeros(6), status="failed", reason="no light")
    with pytest.raises(DataError, match="no light"):
        verify(SYSTEM, [read_session(tmp_path / "session")])


def test_poses_only_sessions_are_judged_by_pose_only_systems(tmp_path: Path) -> None:
    """The flange poses are the true robot's; a system of hand-eye and camera alone then is right."""
    cell, truth, rng = write_cell(tmp_path), paper_cell(), np.random.default_rng(6)
    with SessionWriter.create(tmp_path / "session", purpose="verification", cell=cell) as writer:
        for name, place in PLACES.items():
            for _ in range(4):
                shot = draw_shot(replace(truth, centre_in_base_mm=np.array(place)), rng, n_points=300)
                flange = mdh.base_from_flange(truth.true, shot.joints_rad)
                writer.append(sphere=name, base_from_flange=flange, xyz_mm=shot.points_in_camera_mm.astype(np.float32))
    session = read_session(tmp_path / "session")
    result = verify(TrueSystem(truth, pose_only=True), [session])
    assert result.figures.centre_rms_mm is not None
    assert result.figures.centre_rms_mm < 0.2
    with pytest.raises(DataError, match="no joints"):
        verify(SYSTEM, [session])


def test_the_order_of_the_sessions_changes_nothing(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    one, two = (record_session(tmp_path / f"s{i}", cell, np.random.default_rng(i), shots_per_sphere=3) for i in (7, 8))
    forth, back = verify(SYSTEM, [one, two]), verify(SYSTEM, [two, one])
    assert forth.figures.centre_rms_mm == back.figures.centre_rms_mm
    assert forth.lengths == back.lengths
    assert forth.reasons == back.reasons


def test_cells_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    one = record_session(tmp_path / "one", write_cell(tmp_path / "a"), np.random.default_rng(9), shots_per_sphere=2)
    other = write_cell(tmp_path / "b")
    text = other.path.read_text(encoding="utf-8").replace("38.1", "38.2")
    (one.folder.parent / "b" / "cell.yaml").write_text(text, encoding="utf-8")
    from acquire.cell import load_cell

    two = record_session(tmp_path / "two", load_cell(other.path), np.random.default_rng(10), shots_per_sphere=2)
    with pytest.raises(DataError, match="different names"):
        verify(SYSTEM, [one, two])


def test_a_sphere_moved_between_sessions_under_one_name_is_refused(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    one = record_session(tmp_path / "one", cell, np.random.default_rng(11), shots_per_sphere=2)
    moved = {"A": (900.0, 150.0, 300.0), "B": PLACES["B"]}
    two = record_session(tmp_path / "two", cell, np.random.default_rng(12), places=moved, shots_per_sphere=2)
    with pytest.raises(DataError, match="name of its own") as caught:
        verify(SYSTEM, [one, two])
    assert caught.value.file == str(two.folder)
    assert "sphere A stands 50 mm" in caught.value.message
