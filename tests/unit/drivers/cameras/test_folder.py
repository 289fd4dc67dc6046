"""The folder camera: the contract, with a vendor's software that writes slowly, and what may go wrong in a folder."""

from __future__ import annotations

import io
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.folder import FolderCamera, make_camera
from drivers.contract.camera import CameraContract, CameraRig
from drivers.contract.camera_rig import opened_camera, require_sphere
from drivers.errors import (
    CameraError,
    CameraLost,
    CameraMisconfigured,
    CameraNotReached,
    CameraTimeout,
    IncompleteFrame,
    InvalidFrame,
    SettingsError,
    StaleFrame,
)
from drivers.registry import DriverContext
from tests.support.pcd_bytes import encode_pcd
from tests.support.scan_scene import RADIUS_MM, ScanScene
from tests.support.vendor_folder import TRIGGER, Points, VendorSoftware, as_ply

FAST = {"unit": "mm", "stable_s": 0.05}


def camera_of(folder: Path, **settings: object) -> FolderCamera:
    """A camera on a folder of exports."""
    return make_camera(DriverContext({"folder": folder.name, **FAST, **settings}, None, folder.parent))


def triggered(folder: Path, **settings: object) -> FolderCamera:
    """The same, triggered by a file: whatever is written then is written after the camera has looked what lies there."""
    return camera_of(folder, trigger_file=TRIGGER, **settings)


def as_npz(points: Points) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, xyz_mm=points, intensity=np.full(points.shape[:2], 0.5, dtype=np.float32))
    return stream.getvalue()


def in_metres_looking_back(points: Points) -> bytes:
    """As a graphics program would write them."""
    return as_ply(points * np.array([1e-3, -1e-3, -1e-3], dtype=np.float32))


VENDORS: dict[str, tuple[Callable[[Points], bytes], str, dict[str, object]]] = {
    "ply": (as_ply, ".PLY", {}),
    "pcd": (lambda points: encode_pcd(points, "binary"), ".pcd", {}),
    "npz": (as_npz, ".npz", {}),
    "metres and graphics axes": (in_metres_looking_back, ".ply", {"unit": "m", "axes": "graphics"}),
    "no grid in the file": (lambda points: as_ply(points.reshape(-1, 3)), ".ply", {"grid": [160, 120]}),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "exports"
    path.mkdir()
    return path


class TestFolderCamera(CameraContract):
    @pytest.fixture
    def rig(self, folder: Path) -> Iterator[CameraRig]:
        encode, suffix, settings = VENDORS["metres and graphics axes"]
        software = VendorSoftware(folder, ScanScene(), encode, suffix)
        software.write(software.expose())

        def clear() -> None:
            software.silent, software.delay_s = False, 0.0
            for path in folder.parent.glob("away"):
                path.rename(folder)

        def lose() -> None:
            software.silent = True
            folder.rename(folder.parent / "away")

        def misconfigure() -> None:
            software.encode = as_ply

        with software.running():
            yield CameraRig(
                make=lambda: camera_of(folder, trigger_file=TRIGGER, **settings),
                timeout_s=2.0,  # half of it is spent on a late scan
                short_timeout_s=0.6,
                radius_mm=RADIUS_MM,
                centre_mm=lambda: software.scene.centre_mm,
                move_sphere=software.scene.move,
                nobody={"no such folder": lambda: camera_of(folder / "gone", trigger_file=TRIGGER)},
                faults={
                    "silence": lambda: setattr(software, "silent", True),
                    "late": lambda: setattr(software, "delay_s", 0.9),
                    "old_frame": lambda: software.write(software.expose()),
                    "misconfigured": misconfigure,
                    "gone": lose,
                },
                clear=clear,
            )


@pytest.mark.parametrize("vendor", VENDORS)
def test_exports_of_every_kind_show_the_same_sphere(folder: Path, vendor: str) -> None:
    encode, suffix, settings = VENDORS[vendor]
    scene = ScanScene()
    found = capture_while(triggered(folder, **settings), lambda: (folder / f"scan{suffix}").write_bytes(encode(scene.expose())))
    assert found.shape == (120, 160, 3)
    assert np.allclose(found, ScanScene().expose(), rtol=0, atol=1e-4, equal_nan=True)


def test_without_a_trigger_somebody_presses_the_button(folder: Path) -> None:
    points, camera = ScanScene().expose(), camera_of(folder)
    camera.open()
    threading.Timer(0.3, lambda: (folder / "scan.ply").write_bytes(as_ply(points))).start()
    assert np.array_equal(camera.capture(timeout_s=5).xyz_mm, points, equal_nan=True)


def test_a_command_is_told_where_to_write_and_nothing_else_is_taken(folder: Path) -> None:
    scene = ScanScene()
    (folder.parent / "scan").write_bytes(as_ply(scene.expose()))
    code = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2]); open(sys.argv[2] + '.other.ply', 'w').write('ply')"
    camera = camera_of(folder, command=[sys.executable, "-c", code, str(folder.parent / "scan"), "{path}"])
    camera.open()
    frame = camera.capture(timeout_s=10)
    assert str(frame.diagnostics["file"]).startswith("spherecal_")
    require_sphere(frame, CameraRig(make=lambda: camera, radius_mm=RADIUS_MM, centre_mm=lambda: scene.centre_mm))


@pytest.mark.parametrize(
    ("command", "kind", "said"),
    [
        (["no-such-program"], CameraLost, "cannot be run"),
        ([sys.executable, "-c", "import sys; sys.exit('no camera')"], CameraLost, "ended with 1: no camera"),
        ([sys.executable, "-c", "import time; time.sleep(9)"], CameraTimeout, "did not end in time"),
    ],
)
def test_a_command_that_fails(folder: Path, command: list[str], kind: type[CameraError], said: str) -> None:
    camera = camera_of(folder, command=command)
    camera.open()
    with pytest.raises(kind, match=said):
        camera.capture(timeout_s=0.3)


def capture_while(camera: FolderCamera, write: Callable[[], object], timeout_s: float = 2.0) -> Points:
    """A frame of a camera with a trigger file; once that is there, another thread writes."""
    trigger = camera.folder / TRIGGER
    trigger.unlink(missing_ok=True)
    ended = threading.Event()

    def answer() -> None:
        while not (trigger.exists() or ended.wait(0.005)):
            pass
        write()

    camera.open()
    with ThreadPoolExecutor(1) as pool:
        answered = pool.submit(answer)
        try:
            return camera.capture(timeout_s=timeout_s).xyz_mm
        finally:
            ended.set()
            answered.result()


def test_a_file_that_is_written_over_is_new(folder: Path) -> None:
    scene, camera = ScanScene(), triggered(folder)
    path = folder / "latest.ply"
    for _ in range(2):
        points = scene.expose()
        found = capture_while(camera, partial(path.write_bytes, as_ply(points)))
        assert np.array_equal(found, points, equal_nan=True)


def test_the_same_scan_under_another_name_is_stale(folder: Path) -> None:
    camera, data = triggered(folder), as_ply(ScanScene().expose())
    capture_while(camera, lambda: (folder / "a.ply").write_bytes(data))
    with pytest.raises(StaleFrame, match=r"frame 1, byte for byte"):
        capture_while(camera, lambda: (folder / "b.ply").write_bytes(data))


def test_two_files_for_one_trigger_are_refused(folder: Path) -> None:
    camera, data = triggered(folder), as_ply(ScanScene().expose())

    def write() -> None:
        (folder / "a.ply").write_bytes(data)
        (folder / "b.ply").write_bytes(data)

    with pytest.raises(InvalidFrame, match="2 files appeared after one trigger"):
        capture_while(camera, write)


@pytest.mark.parametrize("data", [as_ply(ScanScene().expose())[:-7], b"PK\x03\x04 and no more", b"nothing of the kind", b""])
def test_a_file_that_never_becomes_whole(folder: Path, data: bytes) -> None:
    with pytest.raises(IncompleteFrame, match=r"a\.ply: the scan was not whole within 0\.5 s"):
        capture_while(triggered(folder), lambda: (folder / "a.ply").write_bytes(data), timeout_s=0.5)


def test_other_files_are_left_alone(folder: Path) -> None:
    camera, points = triggered(folder, pattern="scan*.ply"), ScanScene().expose()

    def write() -> None:
        (folder / "texture.png").write_bytes(b"png")
        (folder / "other.ply").write_bytes(b"ply")
        (folder / "scan.ply.tmp").write_bytes(as_ply(points))
        os.replace(folder / "scan.ply.tmp", folder / "scan.ply")

    assert np.array_equal(capture_while(camera, write), points, equal_nan=True)


def misfit(points: Points, kind: str) -> bytes:
    """A scan that does not fit its cell file."""
    return {
        "metres": as_ply(points / np.float32(1000)),
        "behind": as_ply(points * np.array([1, -1, -1], dtype=np.float32)),
        "mirrored": as_ply(points * np.array([-1, 1, 1], dtype=np.float32)),
        "viewpoint": encode_pcd(points, "binary", viewpoint="0 0 500 1 0 0 0"),
        "grid": as_ply(points.reshape(-1, 3)[:-1]),
    }[kind]


@pytest.mark.parametrize("kind", ["metres", "behind", "mirrored", "viewpoint", "grid"])
def test_scans_that_do_not_fit_the_cell_file_are_told(folder: Path, kind: str) -> None:
    camera = triggered(folder, **({"grid": [160, 120]} if kind == "grid" else {}))
    data = misfit(ScanScene().expose(), kind)
    with pytest.raises(CameraMisconfigured) as caught:
        capture_while(camera, lambda: (folder / "a.ply").write_bytes(data))
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("settings", "where", "said"),
    [
        ({}, "camera.folder", "needs the setting 'folder'"),
        ({"folder": "x"}, "camera.unit", "needs the setting 'unit'"),
        ({"folder": "x", "unit": "km"}, "camera.unit", "'mm'"),
        ({"folder": "x", "unit": "mm", "axis": "z"}, "camera.axis", "unknown setting"),
        ({"folder": "x", "unit": "mm", "axes": ["x", "y", "-x"]}, "camera.axes", "names no axes"),
        ({"folder": "x", "unit": "mm", "command": ["a"], "trigger_file": "b"}, "camera (driver folder)", "one trigger"),
        ({"folder": "x", "unit": "mm", "trigger_file": "go.ply"}, "camera (driver folder)", "would be taken for a scan"),
    ],
)
def test_settings_are_checked(tmp_path: Path, settings: dict[str, object], where: str, said: str) -> None:
    with pytest.raises(SettingsError, match=said) as caught:
        make_camera(DriverContext(settings, None, tmp_path))
    assert caught.value.where == where
    assert caught.value.remedy


def test_what_changes_the_points_changes_the_identity(folder: Path) -> None:
    digests = [camera_of(folder, **more).open().settings_digest for more in ({}, {"unit": "m"}, {"axes": "robot"}, {"preset": "p"}, {"grid": [2, 3]})]
    assert len(set(digests)) == 5
    assert camera_of(folder, stable_s=1.0).open().settings_digest == digests[0]
    info = camera_of(folder, serial="7", onboard_correction="2026-11-01").open()
    assert info.identity() == {"camera_serial": "7", "camera_settings": digests[0], "camera_correction": "2026-11-01"}
    assert not info.notes


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CameraNotReached, match="cannot be read"):
        camera_of(tmp_path / "gone").open()


def test_intensity_and_colour_come_along(folder: Path) -> None:
    (folder.parent / "scan").write_bytes(as_npz(ScanScene().expose()))
    command = [sys.executable, "-c", "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[2])", str(folder.parent / "scan"), "{path}"]
    with opened_camera(CameraRig(make=lambda: camera_of(folder, command=command))) as camera:
        frame = camera.capture(timeout_s=10)
    assert frame.intensity is not None
    assert np.all(frame.intensity == 0.5)
