"""The vendors' adapters: the shared part under the contract, conversions on the vendors' own types where they can be had."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras import mech_eye, photoneo, zivid
from drivers.cameras.vendor import VendorCamera, VendorScan, stdout_to_stderr, vendor_frame
from drivers.contract.camera import CameraContract, CameraRig
from drivers.contract.camera_rig import require_sphere
from drivers.errors import (
    CameraBusy,
    CameraError,
    CameraLost,
    CameraMisconfigured,
    CameraNotReached,
    CameraSdkMissing,
    CameraTimeout,
    FileError,
    IncompleteFrame,
    InvalidFrame,
    SettingsError,
)
from drivers.protocols import CameraInfo
from drivers.registry import DriverContext, untried_drivers
from tests.support.scan_scene import RADIUS_MM, ScanScene

VENDORS = {"mech_eye": mech_eye, "photoneo": photoneo, "zivid": zivid}


@dataclass(slots=True, eq=False)
class Session:
    """A vendor's library in memory, that may hang or fail."""

    scene: ScanScene
    refuses: CameraError | Exception | None = None
    hangs: threading.Event = field(default_factory=threading.Event)
    fails: bool = False

    def connect(self) -> CameraInfo:
        if self.refuses is not None:
            raise self.refuses
        return CameraInfo("memory", settings_digest="1")

    def scan(self, timeout_s: float) -> VendorScan:
        points = np.nan_to_num(self.scene.expose())
        if self.hangs.is_set():
            time.sleep(3 * timeout_s)
        if self.fails:
            msg = "the library says no"
            raise OSError(msg)
        return VendorScan(points, points[..., 2], "snr", {"lens": 30.0}, {"frame_id": 1})

    def disconnect(self) -> None:
        pass


class Slow(Session):
    """Takes its time to connect."""

    def connect(self) -> CameraInfo:
        time.sleep(0.5)
        return CameraInfo("slow")


class TestVendorCamera(CameraContract):
    @pytest.fixture
    def rig(self) -> CameraRig:
        session = Session(ScanScene())
        faults: dict[str, Callable[[], None]] = {
            "gone": lambda: setattr(session, "fails", True),
            "busy": lambda: setattr(session, "refuses", CameraBusy("another client", remedy="Close it.")),
        }

        def clear() -> None:
            session.fails, session.refuses = False, None
            session.hangs.clear()

        return CameraRig(
            make=lambda: VendorCamera("memory", lambda: session),
            short_timeout_s=0.3,
            radius_mm=RADIUS_MM,
            centre_mm=lambda: session.scene.centre_mm,
            move_sphere=session.scene.move,
            nobody={"refuses": lambda: VendorCamera("memory", lambda: Session(ScanScene(), OSError("no route")))},
            faults=faults,
            clear=clear,
        )


def test_a_library_that_does_not_come_back_is_given_up_with_what_it_still_returns() -> None:
    session = Session(ScanScene())
    camera = VendorCamera("memory", lambda: session)
    camera.open()
    session.hangs.set()
    began_s = time.monotonic()
    with pytest.raises(CameraTimeout, match="did not come back"):
        camera.capture(timeout_s=0.2)
    with pytest.raises(CameraLost, match="did not come back"):
        camera.capture(timeout_s=0.2)
    session.hangs.clear()
    session.scene.move()
    camera.open()
    frame = camera.capture(timeout_s=1.0)
    assert time.monotonic() - began_s < 1.0
    require_sphere(frame, CameraRig(make=lambda: camera, radius_mm=RADIUS_MM, centre_mm=lambda: session.scene.centre_mm))
    camera.close()


def test_a_library_that_never_connects() -> None:
    with pytest.raises(CameraNotReached, match=r"did not connect within 0\.1 s"):
        VendorCamera("memory", lambda: Slow(ScanScene()), connect_s=0.1).open()


@pytest.mark.parametrize("points", [np.zeros((4, 3), np.float32), np.zeros((2, 2, 4), np.float32), np.zeros((2, 2, 3), np.int32)])
def test_scans_of_another_shape_are_refused(points: NDArray[Any]) -> None:
    with pytest.raises(InvalidFrame):
        vendor_frame(VendorScan(points), 1, 0.0)


def test_quality_of_another_size_is_left_out() -> None:
    frame = vendor_frame(VendorScan(np.ones((2, 3, 3), np.float32), np.ones((4, 6)), "snr"), 1, 0.0)
    assert frame.quality is None
    assert frame.quality_kind is None


@pytest.mark.parametrize("name", VENDORS)
def test_none_of_them_claims_to_have_run_on_hardware(name: str) -> None:
    assert untried_drivers(name) == (name,)
    assert "Never run on hardware" in str(VENDORS[name].__doc__)


GOOD: dict[str, dict[str, object]] = {
    "mech_eye": {"address": "127.0.0.1"},
    "photoneo": {"serial": "MCL-011"},
    "zivid": {"serial": "1", "settings_file": "s.yml"},
}


@pytest.mark.parametrize("name", VENDORS)
def test_settings_are_checked_and_nothing_is_loaded(name: str) -> None:
    for settings in ({}, {**GOOD[name], "colour": "red"}, {**GOOD[name], "serial": 1}):
        with pytest.raises(SettingsError) as caught:
            VENDORS[name].make_camera(DriverContext(settings, None, Path()))
        assert caught.value.remedy
    assert isinstance(VENDORS[name].make_camera(DriverContext(GOOD[name], None, Path())), VendorCamera)


@pytest.mark.parametrize(("name", "module"), [("mech_eye", "mecheye"), ("photoneo", "phoxi_api"), ("zivid", "zivid")])
def test_a_missing_library_is_told_with_what_to_install(name: str, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CameraSdkMissing, match="cannot be loaded") as caught:
        VENDORS[name].make_camera(DriverContext(GOOD[name], None, Path())).open()
    assert f"spherecal[{name}]" in str(caught.value.remedy)


def test_stdout_is_kept_clean(capfd: pytest.CaptureFixture[str]) -> None:
    import os

    with stdout_to_stderr():
        os.write(1, b"chatter of a C library\n")
    os.write(1, b"ours\n")
    said = capfd.readouterr()
    assert said.out == "ours\n"
    assert "chatter" in said.err


class TestMechEye:
    """On the types of the wheel."""

    @pytest.fixture
    def library(self, capfd: pytest.CaptureFixture[str]) -> Any:
        del capfd  # the library prints while it is imported
        return pytest.importorskip("mecheye.area_scan_3d_camera", reason="mecheyeapi is not installed: pip install 'spherecal[mech_eye]'")

    def test_a_cloud_is_in_mm_with_nan_for_holes(self, library: Any) -> None:
        cloud = library.UntexturedPointCloud()
        cloud.resize(4, 3)
        for i in range(12):
            cloud[i].x, cloud[i].y, cloud[i].z = (float("nan"),) * 3 if i == 5 else (float(i), 10.0, 350.0)
        frame = vendor_frame(VendorScan(cloud.data()), 1, 0.0)
        assert frame.xyz_mm.shape == (3, 4, 3)
        assert np.isnan(frame.xyz_mm[1, 1]).all()
        assert frame.xyz_mm[2, 3].tolist() == [11.0, 10.0, 350.0]
        cloud.resize(1, 1)
        assert frame.xyz_mm[0, 1].tolist() == [1.0, 10.0, 350.0]

    @pytest.mark.parametrize(
        ("name", "kind"),
        [
            ("TIMEOUT_ERROR", CameraTimeout),
            ("DEVICE_OFFLINE", CameraLost),
            ("DEVICE_BUSY", CameraBusy),
            ("PARAMETER_ERROR", CameraMisconfigured),
            ("REPLY_WITH_ERROR", CameraLost),
        ],
    )
    def test_codes_of_the_library_become_our_errors(self, library: Any, name: str, kind: type[CameraError]) -> None:
        from mecheye.shared import ErrorStatus

        del library
        status = ErrorStatus()
        mech_eye.check(status, "nothing")
        status.error_code, status.error_description = getattr(ErrorStatus, f"MMIND_STATUS_{name}"), "so it says"
        with pytest.raises(kind, match=f"capturing failed: so it says .{name}.") as caught:
            mech_eye.check(status, "capturing")
        assert caught.value.remedy

    def test_nobody_at_the_address(self, library: Any) -> None:
        del library
        camera = mech_eye.make_camera(DriverContext({"address": "127.0.0.1"}, None, Path()))
        began_s = time.monotonic()
        with pytest.raises(CameraNotReached):
            camera.open()
        assert time.monotonic() - began_s < 4.0
        camera.close()


class TestPhotoneo:
    """On the shapes that phoxi_api documents."""

    POINTS = np.ones((2, 3, 3), np.float32)

    def frame(self, **changes: object) -> SimpleNamespace:
        plain = {"Successful": True, "PointCloud": self.POINTS, "ConfidenceMap": np.full((2, 3), 0.5), "Messages": []}
        return SimpleNamespace(**{**plain, **changes})

    def test_zeros_are_holes(self) -> None:
        points = self.POINTS.copy()
        points[1, 2] = 0
        frame = vendor_frame(photoneo.frame_scan(self.frame(PointCloud=points), 4), 1, 0.0)
        assert np.isnan(frame.xyz_mm[1, 2]).all()
        assert np.isfinite(frame.xyz_mm).all(axis=-1).sum() == 5
        assert frame.quality_kind == "confidence"
        assert frame.diagnostics["frame_id"] == 4

    @pytest.mark.parametrize("changes", [{"Successful": False}, {"Successful": None}, {"PointCloud": None}])
    def test_a_frame_that_did_not_succeed(self, changes: dict[str, object]) -> None:
        messages = [{"severity": 2, "text": "Projector throttling active"}]
        with pytest.raises(IncompleteFrame, match="Projector throttling active"):
            photoneo.frame_scan(self.frame(Messages=messages, **changes), 4)

    def test_warnings_of_a_good_frame_are_kept(self) -> None:
        messages = [{"severity": 1, "text": "warm"}, {"severity": 0, "text": "fine"}]
        assert photoneo.frame_scan(self.frame(Messages=messages), 4).diagnostics["messages"] == "warm"

    def test_clouds_in_another_space_are_refused(self) -> None:
        photoneo.check_space("CameraSpace")
        photoneo.check_space(None)
        with pytest.raises(CameraMisconfigured, match="a transform is active: clouds are in MarkerSpace"):
            photoneo.check_space("MarkerSpace")


class TestZivid:
    """On the shapes that zivid-python documents."""

    XYZ = np.full((2, 2, 3), np.nan, np.float32)

    def module(self, points: NDArray[np.float32]) -> tuple[ModuleType, SimpleNamespace]:
        cloud = SimpleNamespace(copy_data={"xyz": points, "snr": np.ones((2, 2), np.float32)}.get)
        camera = SimpleNamespace(
            info=SimpleNamespace(serial_number="2020C0DE", model_name="Zivid 2+ M130", firmware_version="1.0"),
            state=SimpleNamespace(temperature=SimpleNamespace(dmd=40.0, lens=35.0)),
            capture_3d=lambda settings: SimpleNamespace(point_cloud=lambda: cloud),
            disconnect=lambda: None,
        )
        corrected = datetime.fromisoformat("2026-11-01T12:00:00")
        module: Any = ModuleType("zivid")
        module.Settings = SimpleNamespace(load=lambda path: path)
        module.Application = lambda: SimpleNamespace(connect_camera=lambda serial_number: camera)
        module.calibration = SimpleNamespace(has_camera_correction=lambda _: True, camera_correction_timestamp=lambda _: corrected)
        return module, camera

    def test_the_identity_holds_settings_and_infield_correction(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        points = self.XYZ.copy()
        points[0, 1] = (1, 2, 700)
        module, _ = self.module(points)
        monkeypatch.setitem(sys.modules, "zivid", module)
        digests = []
        for text in ("aperture: 4", "aperture: 8"):
            (tmp_path / "s.yml").write_text(text, encoding="utf-8")
            camera = zivid.make_camera(DriverContext({"serial": "2020C0DE", "settings_file": "s.yml"}, None, tmp_path))
            info = camera.open()
            digests.append(info.settings_digest)
            frame = camera.capture(timeout_s=2)
            camera.close()
        assert digests[0] != digests[1]
        assert info.onboard_correction == "infield 2026-11-01T12:00:00"
        assert np.isfinite(frame.xyz_mm).all(axis=-1).sum() == 1
        assert frame.temperatures_c == {"dmd": 40.0, "lens": 35.0}
        assert frame.quality_kind == "snr"

    def test_another_camera_and_a_missing_file_are_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "zivid", self.module(self.XYZ)[0])
        context = DriverContext({"serial": "2020C0DF", "settings_file": "s.yml"}, None, tmp_path)
        with pytest.raises(FileError):
            zivid.make_camera(context).open()
        (tmp_path / "s.yml").touch()
        with pytest.raises(CameraMisconfigured, match="serial number 2020C0DE"):
            zivid.make_camera(context).open()
