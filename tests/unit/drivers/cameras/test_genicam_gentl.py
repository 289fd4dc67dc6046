"""The GenICam camera through harvesters, on viky, the producer that comes with the package genicam.

viky's scene is a height map at z = 0: what depends on a camera that looks at something ahead is left out here.
"""

from __future__ import annotations

import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.cameras.genicam import make_camera
from drivers.cameras.genicam.camera import GenicamCamera
from drivers.cameras.genicam.gentl import GentlTransport
from drivers.contract.camera import CameraContract, CameraRig
from drivers.errors import CameraMisconfigured, CameraNotReached
from drivers.registry import DriverContext

genicam = pytest.importorskip("genicam", reason="harvesters and genicam are not installed: pip install 'spherecal[genicam]'")
pytest.importorskip("harvesters", reason="harvesters is not installed: pip install 'spherecal[genicam]'")
VIKY = Path(genicam.__file__).parent / "viky.cti"
FREE_RUNNING = {"trigger": "start", "pixel_format": None}


def camera_of(producer: Path = VIKY, serial: str = "1", **settings: object) -> GenicamCamera:
    """A camera of the producer."""
    return make_camera(DriverContext({"producer": str(producer), "serial": serial, **FREE_RUNNING, **settings}, None, Path()))


class TestVikyCamera(CameraContract):
    @pytest.fixture
    def rig(self, monkeypatch: pytest.MonkeyPatch) -> CameraRig:
        monkeypatch.setattr("drivers.cameras.genicam.camera.require_plausible", lambda *_: None)
        nobody = {"no such serial": lambda: camera_of(serial="9"), "no such producer": lambda: camera_of(Path("a.cti"))}
        return CameraRig(make=camera_of, nobody=nobody)

    def test_frames_are_float32_mm_with_nan_for_holes(self, rig: CameraRig) -> None:
        camera = rig.make()
        camera.open()
        frame = camera.capture(timeout_s=3)
        camera.close()
        assert frame.xyz_mm.shape == (400, 400, 3)
        assert frame.xyz_mm.dtype == np.float32
        x, y, z = np.moveaxis(frame.xyz_mm, -1, 0)
        seen = np.isfinite(z)
        assert seen.mean() > 0.99
        assert len(np.unique(z[seen])) < 300  # flat ground and balls
        for along, across in ((x, y), (y.T, x.T)):
            steps = np.diff(along, axis=1)
            assert np.nanstd(steps) < 1e-3  # one axis runs along the rows, the other along the columns
            assert np.nanmax(np.abs(np.diff(across, axis=1))) < 1e-3


def test_a_height_map_at_zero_is_no_scan() -> None:
    camera = camera_of()
    camera.open()
    with pytest.raises(CameraMisconfigured, match="as if these were metres"):
        camera.capture(timeout_s=3)
    camera.close()


def test_ctrl_c_stays_with_the_run() -> None:
    """harvesters takes SIGINT when a camera is created, and keeps it: a second Ctrl-C would not stop the robot."""
    before = signal.getsignal(signal.SIGINT)
    camera = camera_of()
    camera.open()
    assert signal.getsignal(signal.SIGINT) is before
    camera.close()
    assert signal.getsignal(signal.SIGINT) is before


def test_other_serials_and_producers_are_told() -> None:
    with pytest.raises(CameraNotReached, match="no camera with the serial number 9") as caught:
        camera_of(serial="9").open()
    assert "0, 1, 2" in str(caught.value.remedy)
    with pytest.raises(CameraNotReached, match="no such GenTL producer"):
        camera_of(Path("nowhere.cti")).open()


def gentl_of(kind: str) -> Any:
    """GenTL's entry with one interface of a kind."""
    system = SimpleNamespace(
        open=lambda: None, close=lambda: None, update_interface_info_list=lambda _: None, interface_info_list=[SimpleNamespace(tl_type=kind)]
    )
    producer = SimpleNamespace(open=lambda _: None, close=lambda: None, create_system=lambda: system)
    return SimpleNamespace(GenTLProducer=SimpleNamespace(create_producer=lambda: producer))


def test_a_producer_that_would_broadcast_is_refused_before_it_does() -> None:
    with pytest.raises(CameraMisconfigured, match="by broadcast") as caught:
        GentlTransport(VIKY, "1")._check_interfaces(gentl_of("GEV"))
    assert "address" in str(caught.value.remedy)
    GentlTransport(VIKY, "1")._check_interfaces(gentl_of("U3V"))
    GentlTransport(VIKY, "1", may_broadcast=True)._check_interfaces(gentl_of("GEV"))
