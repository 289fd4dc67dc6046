"""What `doctor` says of a camera: another camera, mirrored axes, lost packets, no grid, nobody there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.folder import make_camera
from drivers.errors import CameraTimeout
from drivers.protocols import CameraHealth, CameraInfo, Frame3D
from drivers.registry import DriverContext
from measure.doctor import Diagnosis, examine_camera
from measure.doctor_camera import camera_hints, frame_facts, identity_problems
from tests.support.fake_devices import FakeCamera, fake_cell
from tests.support.scan_scene import ScanScene

INFO = CameraInfo("x", serial="7", settings_digest="abc", onboard_correction="2026")


def a_frame(scale: float = 1.0) -> Frame3D:
    return Frame3D(xyz_mm=ScanScene().expose() * np.float32(scale), sequence=1, time_s=1.0, done_s=1.5)


def test_a_healthy_camera(tmp_path: Path) -> None:
    found = Diagnosis({}, {})
    examine_camera(FakeCamera(), fake_cell(tmp_path), found)
    assert found.problems == []
    assert found.camera["ok"] is True


@pytest.mark.parametrize(
    ("identity", "said"),
    [
        ({"camera_serial": "8"}, "the camera's serial number is 7, the cell file says 8"),
        ({"camera_settings": "abd"}, "the digest of the camera's settings is abc"),
        ({"camera_correction": "2025"}, "the camera's own correction is 2026"),
    ],
)
def test_another_camera_or_other_settings(identity: dict[str, object], said: str) -> None:
    (problem,) = identity_problems(INFO, identity, "area")
    assert said in problem


def test_what_is_not_told_is_no_fault() -> None:
    assert not identity_problems(INFO, {"camera_serial": 7, "camera_settings": None}, "area")
    assert not identity_problems(CameraInfo("x"), {"camera_serial": "8"}, "area")
    assert "line_profile" in identity_problems(INFO, {}, "line_profile")[0]


def test_frames_that_are_wrong() -> None:
    facts, problems = frame_facts(a_frame(), (250, 450))
    assert problems == []
    assert facts["seconds"] == 0.5
    assert "metres" in frame_facts(a_frame(0.001), None)[1][0]
    mirrored = replace(a_frame(), xyz_mm=a_frame().xyz_mm[:, ::-1])
    assert "mirror" in frame_facts(mirrored, None)[1][0]
    assert "working range" in frame_facts(a_frame(), (1000, 2000))[1][0]


def test_what_is_worth_knowing() -> None:
    assert camera_hints(INFO, a_frame()) == []
    lossy = replace(a_frame(), diagnostics={"packets_missing": 3, "packets_resent": 0})
    assert "packets missing: 3" in camera_hints(INFO, lossy)[0]
    assert camera_hints(replace(INFO, notes=("so and so",)), a_frame()) == ["so and so"]
    flat = replace(a_frame(), xyz_mm=a_frame().xyz_mm.reshape(1, -1, 3))
    assert "no grid" in camera_hints(INFO, flat)[0]
    empty = replace(a_frame(), xyz_mm=np.full((4, 5, 3), np.nan, dtype=np.float32))
    assert "only 0.0 %" in camera_hints(INFO, empty)[0]


def test_a_camera_that_is_not_there(tmp_path: Path) -> None:
    found = Diagnosis({}, {})
    examine_camera(make_camera(DriverContext({"folder": "gone", "unit": "mm"}, None, tmp_path)), fake_cell(tmp_path), found)
    assert found.camera["ok"] is False
    (problem,) = found.problems
    assert problem.startswith("camera: ")
    assert "cannot be read" in problem


class Telling(FakeCamera):
    """A camera that tells how it is; a picture may fail all the same."""

    def health(self) -> CameraHealth:
        return CameraHealth({"housing": 48.0}, {"packets_missing": 7})


def test_how_a_camera_is_is_told_although_no_picture_comes(tmp_path: Path) -> None:
    found = Diagnosis({}, {})
    examine_camera(Telling([CameraTimeout("nothing came")]), fake_cell(tmp_path), found)
    assert found.camera["health"] == {"temperatures_c": {"housing": 48.0}, "link": {"packets_missing": 7}}
    assert found.problems == ["camera: nothing came"]
    found = Diagnosis({}, {})
    examine_camera(FakeCamera(), fake_cell(tmp_path), found)
    assert "health" not in found.camera
