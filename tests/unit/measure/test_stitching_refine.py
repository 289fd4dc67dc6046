"""Refinement by registration: it takes out what each pose was off by, never more than the calibration believes."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import Calibration
from calibrate.normal import NoiseModel
from drivers.errors import SettingsError
from drivers.files.ply import PointCloud
from drivers.files.session import read_session
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.stitch import StitchSettings, stitch
from measure.stitching.refine import Refinement, ScanSurface, _bend_variance_mm2, _likeliest, _Link, refine, surface_of
from measure.stitching.scan import DEFAULT_CLEANING, prepare_scan
from tests.support.organised import OrganisedCell, organised_cell

SIDE = 200
N_SCANS = 5
POSE_NOISE = NoiseModel(point_mm=0.03, pose_mm=0.02, pose_rad=1e-4)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> OrganisedCell:
    pytest.importorskip("small_gicp")
    made = organised_cell(tmp_path_factory.mktemp("refine"), N_SCANS, seed=3)
    return replace(made, calibration=replace(made.calibration, camera_mm=0 * made.calibration.camera_mm, noise=POSE_NOISE))


def surfaces(cell: OrganisedCell, calibration: Calibration, moved: FloatArray) -> list[ScanSurface]:
    """Of scans whose flange stood off by twists (m, 6) when they were taken."""
    session = cell.session(N_SCANS, SIDE) if not list(cell.folder.glob("organised*")) else read_session(next(cell.folder.glob("organised*")))
    found = []
    for number, shot in enumerate(session.shots):
        flange = calibration.base_from_flange(cell.joints_rad[number])
        xyz = se3.apply(
            se3.inverse(flange @ se3.exp(moved[number]) @ calibration.flange_from_camera) @ flange @ calibration.flange_from_camera,
            cell.scan(number, SIDE).reshape(-1, 3).astype(np.float64),
        )
        cloud = PointCloud(xyz.reshape(SIDE, SIDE, 3).astype(np.float32))
        found.append(surface_of(shot, cloud.points_mm, prepare_scan(calibration, session, shot, cloud, DEFAULT_CLEANING)))
    return found


def left_mm(cell: OrganisedCell, refinement: Refinement, moved: FloatArray) -> tuple[float, float]:
    """Rms distance of the scans from each other at the middle of the surface, before and after."""
    before, after = [], []
    for number in range(N_SCANS):
        flange = cell.calibration.base_from_flange(cell.joints_rad[number])
        error = flange @ se3.inverse(se3.exp(moved[number])) @ se3.inverse(flange)
        middle = np.array([900.0, 0.0, 200.0])
        before.append(se3.apply(error, middle[None])[0] - middle)
        after.append(se3.apply(refinement.motions[number] @ error, middle[None])[0] - middle)
    spread = [np.array(shifts) - np.mean(shifts, axis=0) for shifts in (before, after)]
    return float(np.sqrt((spread[0] ** 2).sum(1).mean())), float(np.sqrt((spread[1] ** 2).sum(1).mean()))


def test_pose_noise_is_taken_out_and_order_does_not_matter(cell: OrganisedCell) -> None:
    moved = np.random.default_rng(1).normal(0, [0.02] * 3 + [1e-4] * 3, (N_SCANS, 6))
    seen = surfaces(cell, cell.calibration, moved)
    found = refine(cell.calibration, seen)
    assert found.n_pairs >= N_SCANS - 1
    # noise of the points is in both
    assert found.disagreement_after_mm < 0.9 * found.disagreement_before_mm
    before, after = left_mm(cell, found, moved)
    assert after < 0.5 * before
    assert found.bounded == ()
    again = refine(cell.calibration, seen[::-1])
    for index, motion in found.motions.items():
        np.testing.assert_array_equal(again.motions[index], motion)


def test_what_the_calibration_does_not_believe_is_not_done(cell: OrganisedCell) -> None:
    """A part that moved by 0.5 mm between two scans is no error of the robot's, which is known to a hundredth."""
    sure = replace(cell.calibration, noise=replace(POSE_NOISE, pose_mm=0.002, pose_rad=1e-6), covariance=1e-6 * cell.calibration.covariance)
    moved = np.zeros((N_SCANS, 6))
    moved[2, :3] = 0.5
    found = refine(sure, surfaces(cell, sure, moved))
    assert 2 in found.bounded
    assert max(found.shift_mm.values()) < 0.02


def test_scans_that_do_not_overlap_stay(cell: OrganisedCell) -> None:
    seen = surfaces(cell, cell.calibration, np.zeros((N_SCANS, 6)))[:2]
    apart = [seen[0], replace(seen[1], points_in_base_mm=seen[1].points_in_base_mm + 500)]
    found = refine(cell.calibration, apart)
    assert found.n_pairs == 0
    assert all(np.allclose(motion, np.eye(4)) for motion in found.motions.values())
    assert refine(cell.calibration, seen[:1]).motions == {}


def test_stitch_writes_both_clouds_and_tells_what_changed(cell: OrganisedCell, tmp_path: Path) -> None:
    folder = next(iter(cell.folder.glob("organised*")), None)
    session = read_session(folder) if folder else cell.session(N_SCANS, SIDE)
    settings = StitchSettings(1.0, refine=True)
    result = stitch(cell.calibration, session, tmp_path / "cloud.ply", settings=settings)
    told = result.to_json_dict()["refinement"]
    assert isinstance(told, dict)
    assert told["n_pairs"] > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloud.ply", "cloud.refined.ply"]
    plain = stitch(cell.calibration, session, tmp_path / "plain.ply", 1.0)
    assert (tmp_path / "plain.ply").read_bytes() == (tmp_path / "cloud.ply").read_bytes()
    assert plain.refinement is None
    assert b"comment refined by registration\n" in (tmp_path / "cloud.refined.ply").read_bytes()[:1000]


def test_a_missing_library_is_told_before_any_work(cell: OrganisedCell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = next(iter(cell.folder.glob("organised*")), None)
    session = read_session(folder) if folder else cell.session(N_SCANS, SIDE)
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(SettingsError, match=r"small_gicp.*spherecal\[registration\]"):
        stitch(cell.calibration, session, tmp_path / "cloud.ply", settings=StitchSettings(refine=True))
    assert not list(tmp_path.iterdir())


def test_pairs_that_contradict_each_other_are_believed_less() -> None:
    prior = np.kron(np.eye(3), np.diag([0.1**2] * 3 + [1e-3**2] * 3)).astype(np.float64)
    weight = np.diag([1e4] * 3 + [1e8] * 3).astype(np.float64)
    moved = np.zeros((3, 6))
    moved[1, 0], moved[2, 1] = 0.05, -0.04

    def links(error_mm: float) -> list[_Link]:
        none = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        found = [_Link(a, b, moved[b] - moved[a], weight, none) for a, b in ((0, 1), (1, 2), (0, 2))]
        return [replace(found[0], twist=found[0].twist + np.array([0, 0, error_mm, 0, 0, 0])), *found[1:]]

    agreed = _likeliest(links(0.0), prior)
    between = agreed - agreed[0]
    np.testing.assert_allclose(between[:, :2], moved[:, :2], atol=2e-3)
    torn = _likeliest(links(0.5), prior)
    # half a millimetre round the circle is fifty times what the pairs claim: less is left of what they say of x too
    assert np.abs(torn[1, 0] - torn[0, 0]) < 0.75 * np.abs(between[1, 0])


def test_what_bends_a_scan_is_not_taken_for_its_motion(cell: OrganisedCell) -> None:
    """A rigid error of the calibration is no bend, one of the camera's field is."""
    calibration = cell.calibration
    surface = surfaces(cell, calibration, np.zeros((N_SCANS, 6)))[0]
    n_rigid = calibration.link_twists.size + 6
    blocks = {"rigid": slice(0, n_rigid), "field": slice(n_rigid, n_rigid + len(calibration.camera_mm))}
    found = {}
    for name, block in blocks.items():
        covariance = np.zeros_like(calibration.covariance)
        covariance[block, block] = np.diag(np.full(len(range(*block.indices(len(covariance)))), 0.01**2))
        found[name] = _bend_variance_mm2(replace(calibration, covariance=covariance), surface)
    assert found["rigid"] < 1e-10
    assert found["field"] > 1e-5
