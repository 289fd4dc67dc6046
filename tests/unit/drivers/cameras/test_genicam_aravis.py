"""The GenICam camera through Aravis: the contract, against Aravis' own fake GigE Vision camera on loopback."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.genicam import aravis, aravis_library, make_camera
from drivers.cameras.genicam.aravis import AravisTransport, local_address, network_notes
from drivers.cameras.genicam.camera import GenicamCamera
from drivers.cameras.genicam.receive_buffer import make_room
from drivers.contract.camera import CameraContract, CameraRig
from drivers.contract.camera_rig import opened_camera
from drivers.errors import CameraError, CameraLost, CameraMisconfigured, CameraNotReached, CameraSdkMissing, CameraTimeout, SettingsError
from drivers.protocols import CameraHealth, TellsHealth
from drivers.registry import DriverContext
from tests.support.fake_gige import ADDRESS, FakeGige, fake_gige
from tests.support.scan_scene import RADIUS_MM, ScanScene


def camera_of(**settings: object) -> GenicamCamera:
    """A camera at the fake's address."""
    return make_camera(DriverContext({"address": ADDRESS, **settings}, None, Path()))


class Bench:
    """The fake camera and its scene, and its faults."""

    def __init__(self, fake: FakeGige, scene: ScanScene) -> None:
        self.fake, self.scene = fake, scene
        self.other: AravisTransport | None = None

    def take(self) -> None:
        """Another client takes control."""
        self.other = AravisTransport(ADDRESS)
        self.other.open()

    def delay(self) -> None:
        """The next frames are late."""
        self.fake.delay_s = 0.9

    def lose(self) -> None:
        """A part of the packets gets lost."""
        self.fake.lose(0.01)

    def mend(self) -> None:
        """As an operator would."""
        self.fake.delay_s = 0.0
        self.fake.lose(0.0)
        if self.other is not None:
            self.other.close()
            self.other = None
        if not self.fake.running:
            self.fake.start()

    def rig(self) -> CameraRig:
        """For the contract."""
        return CameraRig(
            make=camera_of,
            short_timeout_s=0.6,
            radius_mm=RADIUS_MM,
            centre_mm=lambda: self.scene.centre_mm,
            move_sphere=self.scene.move,
            nobody={"loopback, no camera": lambda: camera_of(address="127.0.0.77")},
            faults={
                "busy": self.take,
                "misconfigured": self.fake.transform,
                "silence": self.fake.hush,
                "late": self.delay,
                "old_frame": self.fake.trigger,
                "lost_packets": self.lose,
                "gone": self.fake.stop,
            },
            clear=self.mend,
        )


@pytest.fixture
def bench() -> Iterator[Bench]:
    scene = ScanScene()
    with fake_gige(scene.expose) as fake:
        bench = Bench(fake, scene)
        yield bench
        bench.mend()


class TestAravisCamera(CameraContract):
    @pytest.fixture
    def rig(self, bench: Bench) -> CameraRig:
        return bench.rig()


def test_points_come_bit_for_bit(bench: Bench) -> None:
    sent = bench.scene.expose()
    bench.fake.expose = lambda: sent
    with opened_camera(bench.rig()) as camera:
        frame = camera.capture(timeout_s=3)
    assert np.array_equal(frame.xyz_mm, sent, equal_nan=True)
    assert frame.diagnostics["packets_missing"] == 0


@contextmanager
def passing_by(datagram: bytes) -> Iterator[None]:
    """Other programs of this computer talk to each other meanwhile."""
    ended = threading.Event()

    def talk() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
            listener.bind(("127.0.0.9", 0))
            while not ended.wait(0.0005):
                speaker.sendto(datagram, listener.getsockname())

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_what_passes_by_on_the_network_is_no_matter(bench: Bench) -> None:
    """For root Aravis reads a packet socket, whose filter is set late: what is in it by then looks like a frame with the number 65450."""
    frame_id = struct.pack(">HHI", 0, 65450, 0)
    with passing_by(frame_id.ljust(64, b"\0")), opened_camera(bench.rig()) as camera:
        frame = camera.capture(timeout_s=3)
    assert frame.diagnostics["packets_ignored"] == frame.diagnostics["frames_dropped"] == 0
    assert frame.diagnostics["packets_received"] == -(-frame.xyz_mm.nbytes // 1364) + 2  # leader, data, trailer


def test_a_socket_is_given_room_for_a_frame_and_no_descriptor_stays_behind() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind(("127.0.0.1", 0))
        before, descriptors = channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF), os.listdir("/dev/fd")
        allowed = min(300_000, int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii")))
        now = make_room(channel.getsockname()[1], 300_000)
        assert now == channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= max(before, allowed)
        assert make_room(channel.getsockname()[1], 10_000) == now
        assert make_room(1, 10_000) is None
        assert os.listdir("/dev/fd") == descriptors


@pytest.mark.parametrize(
    ("settings", "kind", "said"),
    [
        ({"serial": "OTHER"}, CameraMisconfigured, "serial number FAKE3D-1, the cell file names OTHER"),
        ({"pixel_format": "Coord3D_C16"}, CameraMisconfigured, "PixelFormat does not take 'Coord3D_C16'"),
        ({"pixel_format": "Mono8"}, CameraMisconfigured, "sends Mono8, and no coordinates"),
        ({"features": {"NoSuchThing": 1}}, CameraMisconfigured, "no feature NoSuchThing"),
        ({"user_set": "Default"}, CameraMisconfigured, "no feature UserSetSelector"),
        ({"axes": "graphics"}, CameraMisconfigured, "behind the camera"),
    ],
)
def test_settings_that_do_not_fit_the_camera(bench: Bench, settings: dict[str, object], kind: type[CameraError], said: str) -> None:
    del bench
    camera = camera_of(**settings)

    def open_and_capture() -> None:
        camera.open()
        camera.capture(timeout_s=3)

    with pytest.raises(kind, match=said) as caught:
        open_and_capture()
    assert caught.value.remedy
    camera.close()


def test_how_it_is_is_told_with_every_frame_and_without_one(bench: Bench) -> None:
    bench.fake.warm_to(41.5)
    camera = camera_of()
    with pytest.raises(CameraNotReached):
        camera.health()
    camera.open()
    assert isinstance(camera, TellsHealth)
    assert camera.health() == CameraHealth({"device": 41.5}, {})
    assert camera.capture(timeout_s=3).temperatures_c == {"device": 41.5}
    bench.fake.lose(1.0)
    with pytest.raises(CameraTimeout):
        camera.capture(timeout_s=0.3)
    bench.fake.lose(0.0)
    camera.capture(timeout_s=3)
    bench.fake.warm_to(43)
    told = camera.health()
    assert told.temperatures_c == {"device": 43.0}
    assert told.link["packets_missing"] == 0
    camera.close()


def test_a_wrong_unit_is_refused(bench: Bench) -> None:
    bench.fake.measure_in_pixels()
    with pytest.raises(CameraMisconfigured, match="distance unit is Pixel"):
        camera_of().open()


def test_features_are_set_and_are_part_of_the_identity(bench: Bench) -> None:
    digests = []
    for exposure in (20000.0, 30000.0):
        camera = camera_of(features={"ExposureTimeAbs": exposure})
        digests.append(camera.open().settings_digest)
        camera.close()
    assert digests[0] != digests[1]
    transport = AravisTransport(ADDRESS)
    transport.open()
    assert transport.get("ExposureTimeAbs") == "30000"
    transport.close()
    del bench


@pytest.mark.qualify
def test_a_camera_that_came_back_is_not_trusted_before_it_is_opened_anew(bench: Bench) -> None:
    """Its settings are gone: a restarted camera accepts triggers, in whatever format it starts with (facts)."""
    camera = camera_of()
    camera.open()
    camera.capture(timeout_s=3)
    bench.fake.stop()
    with pytest.raises(CameraLost):
        camera.capture(timeout_s=0.5)
    bench.fake.start()
    began_s = time.monotonic()
    with pytest.raises(CameraLost, match="does not answer any more"):
        camera.capture(timeout_s=0.5)
    assert time.monotonic() - began_s < 0.1
    camera.open()
    assert np.isfinite(camera.capture(timeout_s=3).xyz_mm).any()
    camera.close()


@pytest.mark.parametrize("address", ["255.255.255.255", "192.168.0.255", "224.0.0.1", "0.0.0.0", "camera", "::1"])
def test_only_the_address_of_one_camera_is_taken(address: str) -> None:
    with pytest.raises(CameraMisconfigured):
        local_address(address)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "exactly one of"),
        ({"address": "127.0.0.1", "producer": "a.cti"}, "exactly one of"),
        ({"producer": "a.cti"}, "serial number"),
        ({"address": "127.0.0.1", "trigger": "hardware"}, "'software'"),
        ({"address": "127.0.0.1", "packet_size": 10}, "220"),
        ({"address": "127.0.0.1", "adress": 1}, "unknown setting"),
    ],
)
def test_settings_are_checked(settings: dict[str, object], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        make_camera(DriverContext(settings, None, Path()))


def test_calls_on_a_closed_transport_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    transport = AravisTransport(ADDRESS)
    transport.close()
    monkeypatch.setattr(aravis, "load", lambda: None)  # asked before the library is needed
    with pytest.raises(CameraNotReached, match="Connection refused"):
        AravisTransport("127.0.0.78").open()
    calls: list[Callable[[], object]] = [lambda: transport.get("Width"), lambda: transport.execute("TriggerSoftware"), transport.start]
    for call in calls:
        with pytest.raises(CameraNotReached):
            call()
    assert transport.drain() == 0
    assert transport.fetch(0.01) is None


def test_a_small_socket_buffer_is_told(tmp_path: Path) -> None:
    setting = tmp_path / "rmem_max"
    assert network_notes(setting) == ()
    setting.write_text("212992\n", encoding="ascii")
    (note,) = network_notes(setting)
    assert "208 KiB" in note
    setting.write_text("16777216\n", encoding="ascii")
    assert network_notes(setting) == ()


def test_without_the_library_it_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis_library, "NAMES", ("libnowhere.so.0",))
    with pytest.raises(CameraSdkMissing, match="not installed") as caught:
        camera_of().open()
    assert "libaravis-0.8-0" in str(caught.value.remedy)
