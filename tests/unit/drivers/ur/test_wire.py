"""What comes over the wire ends in a message or in a typed error, never in a hang; and the arm is read as it is."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.contract.checks import ContractBroken, in_time
from drivers.contract.wire import serving
from drivers.errors import RobotError, RobotNotReached, RobotTimeout, WrongController
from drivers.kinematics import mdh
from drivers.models import load_robot_model
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.holes import BlackHole
from drivers.simulated.controllers.ur import primary
from drivers.simulated.controllers.ur.machine import Machine, pose_transform
from drivers.simulated.controllers.ur.make import calibrated
from drivers.simulated.truth import Truth
from drivers.ur import dashboard, wire
from drivers.ur.arm import arm_of, read_arm
from drivers.ur.net import DASHBOARD_PORT, PRIMARY_PORT, Deadline, address_of
from drivers.ur.preflight import Version, preflight
from tests.support.fake_ur import own_address
from tests.support.source import ROOT

HOST = "127.0.0.1"
WIRE = ROOT / "fixtures" / "wire"
N_PACKAGES = 2000
GOOD_REPLIES = wire.package(wire.REQUEST_PROTOCOL_VERSION, b"\x01") + wire.package(wire.GET_URCONTROL_VERSION, struct.pack(">4I", 5, 11, 1, 7))


class Talker:
    """Says its piece to every client, whatever it asks, then hangs up or keeps silent."""

    def __init__(self, host: str = HOST, port: int = 0) -> None:
        self._listener = socket.create_server((host, port))
        self.host, self.port = self._listener.getsockname()
        self.says, self.hangs_up = b"", True
        self._kept: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                link, _ = self._listener.accept()
            except OSError:
                return
            self._kept.append(link)
            with contextlib.suppress(OSError):  # the client may have gone
                link.sendall(self.says)
                if self.hangs_up:
                    link.shutdown(socket.SHUT_WR)
            while len(self._kept) > 20:
                self._kept.pop(0).close()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for link in self._kept:
            link.close()


@pytest.fixture
def talker() -> Iterator[Talker]:
    talker = Talker()
    yield talker
    talker.close()


def test_a_controller_that_answers(talker: Talker) -> None:
    talker.says = wire.package(wire.TEXT_MESSAGE, b"\x05hello") + GOOD_REPLIES
    assert preflight(HOST, Deadline.after(1), port=talker.port) == Version(5, 11, 1, 7)


def test_preflight_and_dashboard_say_exactly_what_was_recorded() -> None:
    with serving(WIRE / "ur_preflight.txt") as (host, port):
        assert str(preflight(host, Deadline.after(2), port=port)) == "5.11.1"
    with serving(WIRE / "ur_dashboard.txt", own_address(6), DASHBOARD_PORT) as (host, _):
        who = dashboard.identity(host, Deadline.after(2))
    assert (who.model, who.serial, who.remote, who.program) == ("UR5", "20235500123", False, "production.urp")
    for questions in (("PolyscopeVersion",), ("robotmode",)):  # one step too few, and another one than was recorded
        with pytest.raises(ContractBroken, match="where '> "), serving(WIRE / "ur_dashboard.txt", own_address(6), DASHBOARD_PORT) as (host, _):
            ask_and_leave(host, *questions)


def ask_and_leave(host: str, *questions: str) -> None:
    with contextlib.suppress(RobotError):
        dashboard.ask(host, *questions, deadline=Deadline.after(2))


def outcome(port: int) -> str:
    """What a preflight ends in."""
    try:
        return type(preflight(HOST, Deadline.after(2), port=port)).__name__
    except RobotError as error:
        return type(error).__name__ if error.remedy else "an error without a remedy"


def test_random_packages_into_the_preflight(talker: Talker) -> None:
    """Two thousand: framed packages of any type, good ones cut short or with bytes changed, and plain noise."""
    rng = np.random.default_rng(4)
    kinds = [wire.REQUEST_PROTOCOL_VERSION, wire.GET_URCONTROL_VERSION, wire.TEXT_MESSAGE, wire.DATA_PACKAGE]
    began_s = time.monotonic()
    outcomes: dict[str, int] = {}
    for i in range(N_PACKAGES):
        match i % 4:
            case 0:
                talker.says = rng.bytes(int(rng.integers(0, 60)))
            case 1:
                talker.says = b"".join(wire.package(int(rng.choice(kinds)), rng.bytes(int(rng.integers(0, 20)))) for _ in range(3))
            case 2:
                talker.says = GOOD_REPLIES[: int(rng.integers(0, len(GOOD_REPLIES)))]
            case _:
                changed = bytearray(GOOD_REPLIES)
                changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
                talker.says = bytes(changed)
        name = outcome(talker.port)
        outcomes[name] = outcomes.get(name, 0) + 1
    assert time.monotonic() - began_s < 60
    assert set(outcomes) <= {"Version", "WrongController", "RobotNotReached", "RobotTimeout"}
    assert outcomes["WrongController"] > N_PACKAGES / 10
    assert outcomes["Version"] > 0


@given(st.lists(st.binary(max_size=40), max_size=8))
def test_random_bytes_into_the_streams(pieces: list[bytes]) -> None:
    """A message or a WireError, and the same ones however the bytes are chopped."""

    def parsed(chopped: list[bytes], stream: wire.RtdeStream | wire.PrimaryStream) -> list[object]:
        found: list[object] = []
        try:
            for piece in chopped:
                found.extend(stream.feed(piece))
        except wire.WireError as error:
            found.append(str(error))
        return found

    whole = b"".join(pieces)
    for kind in (wire.RtdeStream, wire.PrimaryStream):
        assert parsed(pieces, kind()) == parsed([whole], kind()) == parsed([bytes([byte]) for byte in whole], kind())


@given(st.binary(max_size=300), st.integers(0, 9), st.binary(max_size=250))
def test_random_bytes_into_the_robot_state(payload: bytes, kind: int, content: bytes) -> None:
    for data in (payload, wire.primary_package(kind, content), wire.primary_package(4, content) + wire.primary_package(5, content * 2)):
        try:
            parts = wire.sub_packages(data)
        except wire.WireError:
            continue
        arm = arm_of(parts)
        assert arm is None or arm.flange_from_tcp is None or np.isfinite(arm.flange_from_tcp).all()


@given(st.integers(0, 2**31), st.sampled_from(["ur5e", "ur10e"]))
def test_the_arm_is_what_the_controller_believes(seed: int, name: str) -> None:
    """Its message, read back, gives the forward kinematics of its own model, by UR's own convention."""
    rng = np.random.default_rng(seed)
    model = load_robot_model(name)
    own = calibrated(model, rng)
    machine = Machine(SimulatedCell(Truth(), model), own)
    machine.flange_from_tcp = pose_transform(rng.uniform(-0.5, 0.5, 6))
    ((kind, payload),) = wire.PrimaryStream().feed(primary.robot_state(machine))
    assert kind == wire.ROBOT_STATE
    arm = arm_of(wire.sub_packages(payload))
    assert arm is not None
    assert arm.flange_from_tcp is not None
    np.testing.assert_allclose(arm.flange_from_tcp, machine.flange_from_tcp, atol=1e-9)
    joints = rng.uniform(-3, 3, (5, 6))
    found = arm.base_from_flange(joints)
    assert found is not None
    np.testing.assert_allclose(found, mdh.base_from_flange(own, joints), atol=1e-8)
    deviation_mm = arm.deviation_mm(model)
    assert deviation_mm is not None
    assert 0.01 < deviation_mm < 10
    other = arm.deviation_mm(load_robot_model("ur10e" if name == "ur5e" else "ur5e"))
    assert other is not None
    assert other > 100


def test_no_answer_no_name_no_dashboard(talker: Talker) -> None:
    talker.hangs_up = False
    with in_time(0.3), pytest.raises(RobotTimeout):
        preflight(HOST, Deadline.after(0.3), port=talker.port)
    talker.hangs_up = True
    with pytest.raises(RobotNotReached):
        preflight(HOST, Deadline.after(1), port=talker.port)
    talker.says = wire.package(wire.REQUEST_PROTOCOL_VERSION, b"\x00")
    with pytest.raises(WrongController, match="version 2"):
        preflight(HOST, Deadline.after(1), port=talker.port)
    with BlackHole(HOST) as hole, in_time(0.3), pytest.raises(RobotNotReached):
        preflight(HOST, Deadline.after(0.3), port=hole.port)
    for name in ("no.such.host.invalid", "x" * 300, ".."):
        with in_time(3), pytest.raises(RobotNotReached):
            address_of(name, Deadline.after(3))


@pytest.mark.parametrize("says", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\xff" * 70000, b"Connected: Universal Robots Dashboard Server\n"])
def test_what_is_no_dashboard(says: bytes) -> None:
    host = own_address(5)
    talker = Talker(host, DASHBOARD_PORT)
    talker.says = says
    try:
        with pytest.raises(RobotNotReached):
            dashboard.identity(host, Deadline.after(1))
        assert not dashboard.answers(host)
    finally:
        talker.close()


@pytest.mark.parametrize("says", [b"", b"\x00\x00\x00\x01", b"\x7f" * 30, wire.primary_package(wire.ROBOT_STATE, b"\x00\x00\x00\xff\x04")])
def test_what_is_no_primary_interface_is_no_arm(says: bytes) -> None:
    host = own_address(6)
    talker = Talker(host, PRIMARY_PORT)
    talker.says = says
    try:
        with in_time(0.5):
            assert read_arm(host, Deadline.after(0.5)) is None
    finally:
        talker.close()
