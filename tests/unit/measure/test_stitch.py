"""Stitching: the points arrive where they belong, once, whatever the order; bad sessions leave nothing behind."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.session import SessionWriter
from drivers.errors import DataError, FileError, SettingsError
from drivers.files.ply import read_ply
from drivers.files.session import Session, read_session
from measure.fuse import VoxelGrid
from measure.stitch import StitchSettings, scans_once, stitch
from measure.stitching.scan import NO_CLEANING, prepare_scan, unit_variance_mm2
from tests.support.recorded import PLACES, TrueSystem, record_session, write_cell
from tests.support.synthetic import paper_cell

FloatImage = NDArray[np.float32]
SYSTEM = TrueSystem(paper_cell())


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("stitch")
    return record_session(folder / "session", write_cell(folder), np.random.default_rng(1), shots_per_sphere=3, purpose="workpiece")


def test_the_stitched_points_lie_on_the_spheres(session: Session, tmp_path: Path) -> None:
    progress: list[tuple[int, int]] = []
    result = stitch(SYSTEM, session, tmp_path / "cloud.ply", 0.5, on_progress=lambda done, total: progress.append((done, total)))
    cloud = read_ply(tmp_path / "cloud.ply")
    assert len(cloud.points_mm) == result.n_points
    assert result.n_points_in == 6 * 300 == cloud.properties["count"].sum()
    distances = np.stack([np.linalg.norm(cloud.points_mm - np.array(place), axis=1) for place in PLACES.values()])
    # depth noise 0.05 mm and pose noise of 0.01 mm and 0.1 mrad
    assert np.abs(distances.min(axis=0) - 19.05).max() < 0.35
    assert (cloud.properties["spread"] <= 0.5 * np.sqrt(3)).all()
    assert progress == [(i, 6) for i in range(1, 7)]
    assert {"unit mm", "frame base", f"calibration {SYSTEM.id}", f"session {session.digest}", "drivers recorded recorded"} <= set(cloud.comments)
    assert result.to_json_dict()["n_points"] == result.n_points
    json.dumps(result.to_json_dict())


def fused_by_hand(system: TrueSystem, session: Session, voxel_mm: float) -> VoxelGrid:
    grid = VoxelGrid(voxel_mm, unit_variance_mm2=unit_variance_mm2(system.noise))
    for shot in session.shots[::-1]:
        scan = prepare_scan(system, session, shot, read_ply(session.folder / str(shot.scan)), NO_CLEANING)
        grid.add(scan.points_in_base_mm, weights=scan.weights, normals=scan.normals, variances=scan.variances)
    return grid


def test_the_file_holds_the_fused_points_of_all_scans(session: Session, tmp_path: Path) -> None:
    """Against fusing by hand in another order."""
    result = stitch(SYSTEM, session, tmp_path / "cloud.ply", 2.0)
    by_hand, cloud = fused_by_hand(SYSTEM, session, 2.0).fused(), result.cloud
    assert cloud.points_mm.tobytes() == by_hand.points_mm.astype(np.float32).astype(np.float64).tobytes()
    for name in ("count", "scans", "weight", "spread_mm", "normals", "uncertainty_mm", "voxel_mm"):
        np.testing.assert_array_equal(getattr(cloud, name), getattr(by_hand, name), err_msg=name)
    assert np.isfinite(cloud.uncertainty_mm).all()
    assert cloud.scans.max() == 3


def test_threads_and_a_small_memory_change_no_byte_of_the_file(session: Session, tmp_path: Path) -> None:
    written = []
    for n_threads, memory_mb in ((1, 700.0), (2, 700.0), (4, 700.0), (2, 0.05)):
        result = stitch(SYSTEM, session, tmp_path / "cloud.ply", settings=StitchSettings(0.2, memory_mb=memory_mb, n_threads=n_threads))
        assert (result.n_tiles > 0) == (memory_mb < 1)
        written.append((tmp_path / "cloud.ply").read_bytes())
    assert len(set(written)) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]


def test_joints_and_nominal_flange_poses_are_taken_as_the_calibration_wants(session: Session, tmp_path: Path) -> None:
    pose_only = TrueSystem(paper_cell(), pose_only=True)
    with_poses = stitch(pose_only, session, tmp_path / "poses.ply", 1.0)
    by_hand = fused_by_hand(pose_only, session, 1.0).fused()
    assert with_poses.cloud.points_mm.tobytes() == by_hand.points_mm.astype(np.float32).astype(np.float64).tobytes()
    with_joints = stitch(SYSTEM, session, tmp_path / "joints.ply", 1.0).cloud
    assert len(with_joints.count) != len(by_hand.count) or not np.allclose(with_joints.points_mm, by_hand.points_mm)


def grid_scan(rng: np.random.Generator) -> FloatImage:
    u, v = np.meshgrid((np.arange(40) - 20) / 200.0, (np.arange(30) - 15) / 200.0)
    z = np.where(u > 0, 400.0, 350.0) + rng.normal(0, 0.01, u.shape)
    z[:, 21] = 370.0  # the column between front and back hangs in the air
    z[3, 3] = np.nan
    return np.stack([u * z, v * z, z], axis=-1).astype(np.float32)


def test_organised_scans_lose_their_flying_pixels_and_keep_the_rest(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    with SessionWriter.create(tmp_path / "session", purpose="workpiece", cell=cell) as writer:
        writer.append(joints_rad=np.full(6, 0.1), xyz_mm=grid_scan(np.random.default_rng(0)))
    session = read_session(tmp_path / "session")
    cleaned = stitch(SYSTEM, session, tmp_path / "cleaned.ply", 0.2)
    raw = stitch(SYSTEM, session, tmp_path / "raw.ply", 0.2, clean_edges=False)
    assert cleaned.n_points_in == raw.n_points_in == 40 * 30 - 1
    assert raw.n_edge_points == 0
    assert cleaned.n_edge_points == 30
    assert cleaned.n_points_in == cleaned.cloud.count.sum() + 30
    assert raw.n_points - cleaned.n_points == 30


def test_two_spheres_in_one_scan_count_once_and_bad_shots_not_at_all(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    rng = np.random.default_rng(0)
    with SessionWriter.create(tmp_path / "session", purpose="calibration", cell=cell) as writer:
        first = writer.append(sphere="A", joints_rad=np.zeros(6), xyz_mm=rng.normal([0, 0, 300], 5, (100, 3)).astype(np.float32))
        writer.append(sphere="B", joints_rad=np.zeros(6), same_scan_as=first.index)
        writer.append(sphere="A", joints_rad=np.zeros(6), status="failed", reason="no answer")
    session = read_session(tmp_path / "session")
    assert [shot.index for shot in scans_once(session)] == [first.index]
    assert stitch(SYSTEM, session, tmp_path / "cloud.ply").n_points_in == 100


def empty_session(folder: Path) -> Session:
    with SessionWriter.create(folder / "session", purpose="workpiece", cell=write_cell(folder)) as writer:
        writer.append(joints_rad=np.zeros(6), status="failed", reason="no answer")
    return read_session(folder / "session")


def test_a_session_without_a_good_scan_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no good scan"):
        stitch(SYSTEM, empty_session(tmp_path), tmp_path / "cloud.ply")
    assert not (tmp_path / "cloud.ply").exists()


def one_scan(folder: Path, xyz_mm: FloatImage, *, joints: bool = True) -> Session:
    with SessionWriter.create(folder / "session", purpose="workpiece", cell=write_cell(folder)) as writer:
        writer.append(joints_rad=np.zeros(6) if joints else None, base_from_flange=None if joints else np.eye(4), xyz_mm=xyz_mm)
    return read_session(folder / "session")


@pytest.mark.parametrize(
    ("xyz_mm", "joints", "message"),
    [
        (np.full((5, 3), np.nan), True, "no point is left of 0 valid"),
        (np.zeros((0, 3)), True, "no point is left of 0 valid"),
        (np.full((6, 8, 3), np.nan), True, "no point is left of 0 valid"),
        (np.array([[0.1, 0.2, 0.3]]), True, "probably in metres"),
        (np.array([[1e5, 0.0, 4e5]]), True, "probably in micrometres"),
        (np.array([[1.0, 2.0, 30.0 / 2.54]]), True, "probably in inches"),
        (np.array([[1.0, 2.0, 30.0]]), True, "probably in centimetres"),
        (np.full((40, 40, 3), [0.0, 0.0, -300.0]), True, "behind it"),
        (np.zeros((40, 40, 3)), True, "Holes are NaN"),
        (np.array([[0.0, 0.0, 300.0]]), False, "no joints"),
    ],
)
def test_scans_that_cannot_be_used_are_told_with_their_place(tmp_path: Path, xyz_mm: FloatImage, joints: bool, message: str) -> None:
    session = one_scan(tmp_path, xyz_mm.astype(np.float32), joints=joints)
    with pytest.raises(DataError, match=message) as caught:
        stitch(SYSTEM, session, tmp_path / "cloud.ply")
    assert caught.value.file is not None
    assert caught.value.remedy
    assert not (tmp_path / "cloud.ply").exists()


def test_one_good_point_is_a_cloud_and_empty_scans_and_far_points_are_told(tmp_path: Path) -> None:
    with SessionWriter.create(tmp_path / "session", purpose="workpiece", cell=write_cell(tmp_path)) as writer:
        mixed = np.array([[0.0, 0.0, 300.0], [0.0, 1e30, 300.0], [np.nan, 0.0, 300.0]])
        for xyz in (np.full((4, 5, 3), np.nan), np.array([[3.0, 2.0, 300.0]]), mixed):
            writer.append(joints_rad=np.zeros(6), xyz_mm=xyz.astype(np.float32))
    result = stitch(SYSTEM, read_session(tmp_path / "session"), tmp_path / "cloud.ply")
    told = result.to_json_dict()
    assert (told["n_points"], told["n_points_in"], told["n_outside"], told["empty_shots"]) == (2, 3, 1, [0])
    cloud = result.cloud
    assert np.isnan(cloud.normals).all()
    assert (cloud.spread_mm == 0).all()
    assert (cloud.uncertainty_mm > 0).all()


def test_a_changed_scan_leaves_no_file_behind(session: Session, tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    own = record_session(tmp_path / "session", cell, np.random.default_rng(2), shots_per_sphere=2)
    scan = own.folder / str(own.shots[-1].scan)
    data = bytearray(scan.read_bytes())
    data[-1] ^= 1
    scan.write_bytes(bytes(data))
    with pytest.raises(FileError, match="sha256"):
        stitch(SYSTEM, own, tmp_path / "cloud.ply")
    assert not list(tmp_path.glob("*.ply*"))


def test_a_senseless_voxel_or_folder_is_told(session: Session, tmp_path: Path) -> None:
    with pytest.raises(SettingsError):
        stitch(SYSTEM, session, tmp_path / "cloud.ply", 0.0)
    with pytest.raises(FileError):
        stitch(SYSTEM, session, tmp_path / "none" / "cloud.ply")
    with pytest.raises(SettingsError, match=r"not written as \.xyz"):
        stitch(SYSTEM, session, tmp_path / "cloud.xyz")
    with pytest.raises(SettingsError, match="0 threads"):
        stitch(SYSTEM, session, tmp_path / "cloud.ply", settings=StitchSettings(n_threads=0))
    assert not list(tmp_path.iterdir())
