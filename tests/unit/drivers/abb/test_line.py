"""Requests and replies: transcripts consumed to the last byte, lost and broken replies, streams of garbage."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

import drivers.abb.line
from drivers.abb.adapter import AbbRobot
from drivers.abb.line import LineClient, Refusal
from drivers.abb.protocol import Code, Fault, Verb, encode
from drivers.abb.settings import AbbSettings
from drivers.contract.checks import ContractBroken
from drivers.contract.wire import Recorder, Transcript, played
from drivers.errors import LinkLost, MotionRefused, RobotError, RobotTimeout, WrongController
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import MAX_AGE_S, RobotState
from tests.support.abb import TARGETS_DEG, abb_model, controller, robot_over_tcp
from tests.support.abb_virtual import VirtualCell, VirtualTime, virtual_cell
from tests.support.source import ROOT

SESSION = ROOT / "fixtures" / "wire" / "abb_session.txt"


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> VirtualCell:
    return virtual_cell(monkeypatch)


@pytest.fixture
def from_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers.abb.line, "first_number", lambda: 0)


def over(transcript: Transcript) -> AbbRobot:
    robot = AbbRobot(AbbSettings(host="transcript"), abb_model())
    robot._client = LineClient(transcript)
    return robot


def joints_of(state: RobotState) -> FloatArray:
    assert state.joints_rad is not None
    return state.joints_rad


@pytest.mark.usefixtures("from_one")
def test_a_session_says_exactly_what_was_recorded() -> None:
    with played(SESSION) as transcript:
        robot = over(transcript)
        info = robot.open()
        assert (info.model, info.serial) == ("IRB 1410-5/1.44", "SIMULATED-0001")
        state = robot.read_state()
        assert state.base_from_flange is not None
        np.testing.assert_allclose(state.base_from_flange[:3, 3], [955, 0, 1195], atol=1e-3)
        robot.start_move(np.radians(TARGETS_DEG[1]), speed_rad_s=0.5)
        assert robot.read_state().moving
        state = robot.read_state()
        assert not state.moving
        np.testing.assert_allclose(np.degrees(joints_of(state)), TARGETS_DEG[1], atol=1e-9)
        robot.start_move(np.radians(TARGETS_DEG[0]), speed_rad_s=0.01)
        assert robot.read_state().moving
        robot.stop()
        assert robot.read_state().reason == "the motion was stopped by a request"


@pytest.mark.usefixtures("from_one")
def test_the_recorder_writes_what_the_player_reads(tmp_path: Path) -> None:
    with controller() as made:
        robot = robot_over_tcp(made, state=False)
        recorder = Recorder(robot._client.link)
        robot._client.link = recorder
        robot.open()
        robot.close()
    path = tmp_path / "transcript.txt"
    path.write_text("\n".join(recorder.lines), encoding="ascii")
    with played(path) as transcript:
        over(transcript).open()


@pytest.mark.usefixtures("from_one")
@pytest.mark.parametrize("change", ["more", "other", "fewer"])
def test_a_transcript_is_strict(change: str) -> None:
    text = SESSION.read_text(encoding="ascii")
    steps = [line for line in text.splitlines() if not line.startswith("#")][:4]
    if change == "fewer":
        transcript = Transcript("\n".join([*steps, "> 0003 J*00"]))
        client = LineClient(transcript)
        client.open(1.0)
        client.ask(Verb.HELLO, timeout_s=1.0)
        assert transcript.steps
        return
    if change == "other":
        steps[0] = steps[0].replace("HELLO", "HALLO")
    client = LineClient(Transcript("\n".join(steps[:2])))
    client.open(1.0)
    if change == "more":
        client.ask(Verb.HELLO, timeout_s=1.0)
    with pytest.raises(ContractBroken):
        client.ask(Verb.HELLO, timeout_s=1.0)


def test_a_lost_reply_is_asked_for_again_and_nothing_is_done_twice(cell: VirtualCell) -> None:
    cell.robot.open()
    lost = [0]

    def lose_two(reply: bytes) -> bytes | None:
        lost[0] += 1
        return reply if lost[0] % 3 == 0 else None

    cell.link.spoil = lose_two
    cell.robot.start_move(np.radians(TARGETS_DEG[1]), speed_rad_s=0.5)
    assert cell.program.n_motions == 1
    assert cell.robot._client.n_repeats >= 2


def test_replies_of_others_are_not_taken_for_ours(cell: VirtualCell) -> None:
    cell.robot.open()
    cell.link.spoil = lambda reply: encode(4242, Code.STATE, "1", *["1.0"] * 6, "RA--") + reply
    state = cell.robot.read_state()
    np.testing.assert_allclose(joints_of(state), 0.0, atol=1e-12)


def test_a_refusal_leaves_the_link_open(cell: VirtualCell) -> None:
    cell.robot.open()
    with pytest.raises(Refusal) as caught:
        cell.robot._client.ask(Verb.GO, "1", "0001", "10.0", "3.0", timeout_s=1.0)
    assert caught.value.number == Fault.TOKEN
    cell.robot.read_state()


def test_a_target_that_comes_back_changed_is_not_started(cell: VirtualCell) -> None:
    cell.robot.open()

    def changed(reply: bytes) -> bytes:
        number, code, *arguments = reply[:-4].decode().split()
        return encode(int(number), code, *["1.00000", *arguments[1:]]) if code == Code.TARGET else reply

    cell.link.spoil = changed
    with pytest.raises(MotionRefused):
        cell.robot.start_move(np.radians(TARGETS_DEG[1]), speed_rad_s=0.5)
    assert cell.program.n_motions == 0


def test_a_line_that_arrives_broken_there_is_sent_again_but_not_for_ever(cell: VirtualCell) -> None:
    cell.robot.open()
    broken = encode(0, Code.ERROR, str(int(Fault.CHECKSUM)), "checksum")
    left = [2]

    def twice(reply: bytes) -> bytes:
        left[0] -= 1
        return broken if left[0] >= 0 else reply

    cell.link.spoil = twice
    cell.robot.read_state()
    cell.link.spoil = lambda _: broken
    with pytest.raises(WrongController, match="arrive broken"):
        cell.robot.read_state()


def test_two_hundred_moves_in_a_row_lose_nothing(cell: VirtualCell) -> None:
    """Every seventh reply is lost on the way."""
    cell.robot.open()
    count, rng = [0], np.random.default_rng(7)

    def lose_some(reply: bytes) -> bytes | None:
        count[0] += 1
        return None if count[0] % 7 == 0 else reply

    cell.link.spoil = lose_some
    for i in range(200):
        target_rad = np.radians(rng.uniform(-60, 60, 6) * [1, 0.5, 0.5, 1, 1, 2])
        cell.robot.start_move(target_rad, speed_rad_s=1.0)
        assert cell.program.n_motions == i + 1
        while (state := cell.robot.read_state()).moving:
            assert state.age_s <= MAX_AGE_S
            cell.robot.wait(0.2)
        np.testing.assert_allclose(joints_of(state), target_rad, atol=1e-6)


class Noise:
    """A link on which random bytes come."""

    name = "noise"

    def __init__(self, seed: int, clock: VirtualTime) -> None:
        self.random, self.clock = random.Random(seed), clock
        self.alphabet = self.random.choice([bytes(range(256)), b"0123456789 JE*\n", b"0001 J 1 0.0 RA--*\r\nE\n"])

    def open(self, timeout_s: float) -> None: ...

    def write(self, data: bytes, timeout_s: float) -> None: ...

    def read(self, timeout_s: float) -> bytes:
        self.clock.now_s += min(timeout_s, 0.05)
        kind = self.random.random()
        if kind < 0.1:
            return b""
        if kind < 0.12:
            raise LinkLost("gone")
        return bytes(self.random.choices(self.alphabet, k=self.random.randint(1, 60)))

    def close(self) -> None: ...


def test_ten_thousand_random_streams_end_in_a_typed_error_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = VirtualTime()
    monkeypatch.setattr(drivers.abb.line, "time", clock)
    kinds: dict[str, int] = {}
    for seed in range(10_000):
        client = LineClient(Noise(seed, clock))
        client.open(1.0)
        asked_s = clock.now_s
        with pytest.raises((WrongController, RobotTimeout, LinkLost, Refusal)) as caught:
            client.ask(Verb.STATE, timeout_s=1.0)
        assert isinstance(caught.value, RobotError)
        assert clock.now_s - asked_s <= 1.06
        kinds[type(caught.value).__name__] = kinds.get(type(caught.value).__name__, 0) + 1
    assert set(kinds) >= {"WrongController", "LinkLost"}
