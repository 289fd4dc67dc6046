"""A scan before fusion: what is dropped and what is kept, normals, weights and the calibration's variance along them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from acquire.session import SessionWriter
from calibrate.normal import NoiseModel
from drivers.errors import DataError
from drivers.files.ply import PointCloud
from drivers.files.session import Session, read_session
from drivers.kinematics import se3
from measure.fuse import VoxelGrid
from measure.fuse_kernels import NORMAL_STEPS, UNIT_WEIGHT, VARIANCE_STEP_MM2
from measure.stitching import scan_kernels
from measure.stitching.scan import DEFAULT_CLEANING, NO_CLEANING, Cleaning, PreparedScan, prepare_scan, unit_variance_mm2
from tests.support.recorded import TrueSystem, write_cell
from tests.support.synthetic import paper_cell

FloatImage = NDArray[np.float32]
FloatArray = NDArray[np.float64]
NOISE = NoiseModel(point_mm=0.05, pose_mm=0.01, pose_rad=1e-4, form_mm=0.004, flat=1.6, steep=-0.9, range_power=1.5)
# the camera's own error is left out: these tests are about what comes after it
SYSTEM = TrueSystem(replace(paper_cell(), camera_error_mm=lambda points: np.zeros(len(points))), noise=NOISE, sigma_of_scale=2e-4)
JOINTS_RAD = np.array([0.2, -0.3, 0.1, 0.4, 0.9, -0.2])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("scan")
    with SessionWriter.create(folder / "session", purpose="workpiece", cell=write_cell(folder)) as writer:
        writer.append(joints_rad=JOINTS_RAD, xyz_mm=plane_grid(0.0))
    return read_session(folder / "session")


def prepare(session: Session, xyz_mm: FloatImage, cleaning: Cleaning = DEFAULT_CLEANING) -> PreparedScan:
    return prepare_scan(SYSTEM, session, session.shots[0], PointCloud(xyz_mm), cleaning)


def rays(shape: tuple[int, int] = (60, 80), step: float = 1 / 900.0) -> tuple[FloatArray, FloatArray]:
    u, v = np.meshgrid((np.arange(shape[1]) - shape[1] / 2) * step, (np.arange(shape[0]) - shape[0] / 2) * step)
    return u, v


def scan_of(z: FloatArray, step: float = 1 / 900.0) -> FloatImage:
    u, v = rays((z.shape[0], z.shape[1]), step)
    return np.stack([u * z, v * z, z], axis=-1).astype(np.float32)


def plane_grid(tilt_rad: float) -> FloatImage:
    """An organised scan (60, 80, 3) of a plane 400 mm away, turned about the camera's y axis."""
    u, _ = rays()
    return scan_of(400.0 / (1.0 - np.tan(tilt_rad) * u))


def base_from_camera() -> FloatArray:
    return np.asarray(SYSTEM.base_from_flange(JOINTS_RAD) @ SYSTEM.flange_from_camera)


@pytest.mark.parametrize("tilt_deg", [0, 45, 70])
def test_a_surface_is_kept_whole(session: Session, tilt_deg: float) -> None:
    scan = prepare(session, plane_grid(np.deg2rad(tilt_deg)))
    assert (scan.weights > 0).all()
    assert (scan.n_valid, scan.n_edge, scan.n_grazing, scan.n_speck) == (4800, 0, 0, 0)


def test_grazing_surfaces_are_dropped_and_counted(session: Session) -> None:
    tilt, limit = np.deg2rad(70), np.cos(np.deg2rad(70))
    tilted = plane_grid(tilt)
    scan = prepare(session, tilted, Cleaning(max_incidence_deg=70))
    cosine = np.abs(tilted @ np.array([np.sin(tilt), 0, -np.cos(tilt)])) / np.linalg.norm(tilted, axis=-1)
    sure = np.abs(cosine - limit) > 2e-3
    assert np.array_equal((scan.weights > 0)[sure], (cosine > limit)[sure])
    assert 1000 < scan.n_grazing == (scan.weights == 0).sum() < 3800


def test_points_between_front_and_back_are_dropped(session: Session) -> None:
    xyz = plane_grid(0.0)
    xyz[:, 40:] *= np.float32(1.25)  # a second plane 100 mm behind
    xyz[:, 40] *= np.float32(0.9)  # its first column hangs in the air
    xyz[10, 10] = np.nan
    scan = prepare(session, xyz)
    kept = scan.weights > 0
    assert not kept[:, 40].any()
    assert not kept[10, 10]
    assert kept[:, :40].sum() == 60 * 40 - 1
    assert kept[1:-1, 41:].all()
    assert (scan.n_valid, scan.n_edge) == (4799, 4799 - kept.sum())


def test_small_patches_in_the_air_are_dropped(session: Session) -> None:
    xyz = plane_grid(0.0)
    xyz[20:23, 20:23] *= np.float32(0.7)  # nine points
    xyz[40:44, 40:44] *= np.float32(0.7)  # sixteen
    kept = prepare(session, xyz).weights > 0
    assert not kept[20:23, 20:23].any()
    assert kept[40:44, 40:44].all()
    assert kept[:15].all()
    assert (prepare(session, xyz, NO_CLEANING).weights > 0).all()


def test_patches_are_joined_wherever_they_touch(session: Session) -> None:
    """A comb and a spiral make many labels that union-find must find to be one."""
    z = np.full((60, 80), np.nan)
    z[::2, :] = 400.0
    z[:, 40] = 400.0
    z[0:60, ::7] = 400.0
    scan = prepare(session, scan_of(z), Cleaning(min_neighbours=1, min_patch_points=int(np.isfinite(z).sum())))
    assert scan.n_speck == 0
    assert (scan.weights > 0).sum() == np.isfinite(z).sum()
    parted = z.copy()
    parted[:, 36] = np.nan
    left_over = prepare(session, scan_of(parted), Cleaning(min_neighbours=1, min_patch_points=1400)).weights > 0
    assert np.array_equal(left_over[:, 37:], np.isfinite(parted[:, 37:]))
    assert not left_over[:, :37].any()


def test_normals_are_those_of_the_surface_and_point_at_the_camera(session: Session) -> None:
    u, v = rays()
    centre, radius = np.array([5.0, -3.0, 430.0]), 30.0
    sight = np.stack([u, v, np.ones_like(u)], axis=-1)
    a, b = (sight**2).sum(-1), sight @ centre
    root = b**2 - a * (centre @ centre - radius**2)
    with np.errstate(invalid="ignore"):
        z = (b - np.sqrt(root)) / a
    scan = prepare(session, scan_of(z))
    kept = scan.weights > 0
    true = (sight[kept] * z[kept][:, None] - centre) / radius @ base_from_camera()[:3, :3].T
    found = scan.normals[kept] / NORMAL_STEPS
    assert kept.sum() > 1500
    # differences are one-sided at the border of the image
    inside = np.zeros(z.shape, dtype=bool)
    inside[1:-1, 1:-1] = True
    inner = inside[kept] & (np.linalg.norm(sight[kept][:, :2] * z[kept][:, None] - centre[:2], axis=1) < 0.8 * radius)
    assert ((true * found).sum(axis=1) > 0).all()
    assert np.degrees(np.linalg.norm(np.cross(true, found), axis=1))[inner].max() < 0.4


def test_weights_are_inverse_predicted_variances(session: Session) -> None:
    tilt = np.deg2rad(50)
    xyz = plane_grid(tilt)
    scan = prepare(session, xyz)
    in_camera = xyz.astype(np.float64)
    range_mm = np.linalg.norm(in_camera, axis=-1)
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    cosine = np.abs(in_camera @ normal) / range_mm
    in_base = se3.apply(base_from_camera(), in_camera.reshape(-1, 3))
    arm = in_base - SYSTEM.base_from_flange(JOINTS_RAD)[:3, 3]
    lever = np.linalg.norm(np.cross(arm, base_from_camera()[:3, :3] @ normal), axis=1).reshape(60, 80)
    point = (NOISE.point_mm * (range_mm / NOISE.range_mm) ** NOISE.range_power) ** 2 * (NOISE.flat + NOISE.steep * cosine**2)
    variance = NOISE.pose_mm**2 + (NOISE.pose_rad * lever) ** 2 + NOISE.form_mm**2 + point
    expected = UNIT_WEIGHT * unit_variance_mm2(NOISE) / variance
    assert expected.max() / expected.min() > 1.1
    assert np.abs(scan.weights - expected).max() < 0.52
    loose = prepare(session, xyz.reshape(-1, 3))
    average, lever = 7 / 12, np.linalg.norm(arm, axis=1).reshape(60, 80)
    point = (NOISE.point_mm * (range_mm / NOISE.range_mm) ** NOISE.range_power) ** 2 * (NOISE.flat + NOISE.steep * average)
    expected = UNIT_WEIGHT * unit_variance_mm2(NOISE) / (NOISE.pose_mm**2 + (NOISE.pose_rad * lever) ** 2 + NOISE.form_mm**2 + point)
    assert np.abs(loose.weights.reshape(60, 80) - expected).max() < 0.52
    assert not loose.normals.any()


def test_the_variance_is_the_calibrations_along_the_normal(session: Session) -> None:
    tilt = np.deg2rad(30)
    xyz = plane_grid(tilt)
    scan = prepare(session, xyz)
    points = xyz.reshape(-1, 3).astype(np.float64)
    jacobian = SYSTEM.point_jacobian(points, joints_rad=JOINTS_RAD)
    covariance = jacobian @ SYSTEM.covariance[:2, :2] @ np.swapaxes(jacobian, 1, 2)
    normal = base_from_camera()[:3, :3] @ [np.sin(tilt), 0, -np.cos(tilt)]
    expected = np.einsum("i,nij,j->n", normal, covariance, normal)
    np.testing.assert_allclose(scan.variances.reshape(-1) * VARIANCE_STEP_MM2, expected, rtol=0.02)
    along_sight = prepare(session, xyz.reshape(-1, 3))
    sight = points / np.linalg.norm(points, axis=1, keepdims=True) @ base_from_camera()[:3, :3].T
    np.testing.assert_allclose(along_sight.variances.reshape(-1) * VARIANCE_STEP_MM2, np.einsum("ni,nij,nj->n", sight, covariance, sight), rtol=0.02)


@pytest.mark.parametrize("shape", [(0, 0, 3), (1, 1, 3), (3, 4, 3), (0, 3), (1, 3)])
def test_scans_without_a_point_come_back_empty(session: Session, shape: tuple[int, ...]) -> None:
    scan = prepare(session, np.full(shape, np.nan, dtype=np.float32))
    assert scan.n_valid == 0
    assert not scan.weights.any()


def test_one_point_is_kept(session: Session) -> None:
    scan = prepare(session, np.array([[1.0, 2.0, 400.0]], dtype=np.float32))
    assert (scan.n_valid, (scan.weights > 0).sum()) == (1, 1)
    np.testing.assert_allclose(scan.points_in_base_mm[0, 0], se3.apply(base_from_camera(), np.array([[1.0, 2.0, 400.0]]))[0], atol=1e-9)


def test_holes_and_huge_numbers_among_the_points_leave_the_others_alone(session: Session) -> None:
    xyz = plane_grid(0.3)
    spoiled = xyz.copy()
    spoiled[10, 10], spoiled[20, 20], spoiled[30, 30], spoiled[40, 40] = np.nan, 1e30, -3e38, np.inf
    spoiled[50, 50, 1] = np.nan
    bad = np.zeros((60, 80), dtype=bool)
    bad[[10, 20, 30, 40, 50], [10, 20, 30, 40, 50]] = True
    found, clean = prepare(session, spoiled), prepare(session, xyz)
    assert not found.weights[bad].any()
    assert (found.weights[~bad] > 0).all()
    assert np.array_equal(found.points_in_base_mm[~bad], clean.points_in_base_mm[~bad])
    assert found.n_valid == 4800 - 3


@dataclass(frozen=True)
class WrongUnit:
    factor: float
    said: str


@pytest.mark.parametrize("unit", [WrongUnit(1e-3, "in metres"), WrongUnit(1e3, "in micrometres")], ids=lambda unit: unit.said)
def test_scans_in_another_unit_are_told(session: Session, unit: WrongUnit) -> None:
    with pytest.raises(DataError, match=unit.said):
        prepare(session, (plane_grid(0.0) * unit.factor).astype(np.float32))


def test_the_stated_uncertainty_covers_what_pose_and_point_noise_do() -> None:
    """Errors along the normal of fused points of a tilted plane, over many drawn sessions, in units of what is stated."""
    tilt, n_scans, side = np.deg2rad(25), 5, 60
    noise = NoiseModel(point_mm=0.03, pose_mm=0.02, pose_rad=2e-4)
    view, point_noise = _view(noise)
    ratios = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        grid = VoxelGrid(2.0, unit_variance_mm2=unit_variance_mm2(noise))
        for _ in range(n_scans):
            xyz = plane_grid(tilt)[:side, :side].astype(np.float64)
            xyz += rng.normal(0, noise.point_mm, (side, side, 1)) * [np.sin(tilt), 0, -np.cos(tilt)]
            moved = se3.exp(np.concatenate([rng.normal(0, noise.pose_mm, 3), rng.normal(0, noise.pose_rad, 3)]))
            xyz = se3.apply(moved, xyz.reshape(-1, 3)).reshape(side, side, 3)
            weights, normals = np.empty((side, side), dtype=np.uint8), np.empty((side, side, 3), dtype=np.int16)
            links, fates = np.empty((side, side), dtype=np.uint8), np.zeros(4, dtype=np.int64)
            scan_kernels.examine_grid(xyz, view, point_noise, 6 / 900, 3, 0.2, weights, normals, links, fates)
            grid.add(xyz, weights=weights, normals=normals)
        fused = grid.fused()
        inside = (fused.scans == n_scans) & (fused.count > 40)
        error = fused.points_mm[inside] @ [np.sin(tilt), 0, -np.cos(tilt)] + 400.0 * np.cos(tilt)
        ratios.append(error / fused.uncertainty_mm[inside])
    rms = float(np.sqrt(np.mean(np.concatenate(ratios) ** 2)))
    # never too small; noise of single points is stated as if it did not average within a scan
    assert 0.4 < rms < 1.1
    assert np.mean(np.abs(np.concatenate(ratios)) < 2) > 0.95


def _view(noise: NoiseModel) -> tuple[scan_kernels.View, scan_kernels.PointNoise]:
    """Camera and flange at the origin of the base."""
    squares = (noise.pose_mm**2, noise.pose_rad**2, noise.form_mm**2, noise.point_mm**2)
    view = scan_kernels.View(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3))
    return view, scan_kernels.PointNoise(*squares, noise.flat, noise.steep, noise.range_power, noise.range_mm, unit_variance_mm2(noise))
