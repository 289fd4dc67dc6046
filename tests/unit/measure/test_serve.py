"""The controller as master: its requests answered at once, its pictures kept and judged; the RAPID text of the job executed."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import Cell
from acquire.plan import PlannedPose
from acquire.session import SessionWriter
from drivers.abb.line import LineClient, Refusal
from drivers.abb.program import module_text
from drivers.abb.protocol import Code, Fault, Verb, angle_text, checksum, decode, encode
from drivers.errors import CameraLost, CameraNotReached, CameraTimeout, SettingsError
from drivers.files.session import read_session
from drivers.protocols import CameraInfo
from drivers.transport import TcpLink
from measure.serve import EXPOSING, NG, OK, CellDesk, CellWorker, Job, Orders
from measure.serve_line import LineServer
from tests.support.fake_devices import FakeCamera, fake_cell
from tests.support.rapid import Machine, RapidError, read
from tests.support.rapid_world import World
from tests.support.source import ROOT

JOINTS_DEG = (10.0, -5.5, 3.25, 0.0, 20.12345, -170.1234)


def trigger(number: int, id_: int, joints_deg: tuple[float, ...] = JOINTS_DEG) -> bytes:
    return encode(number, Verb.TRIGGER, str(id_), *(angle_text(angle) for angle in joints_deg))[:-1]


def result(number: int, id_: int) -> bytes:
    return encode(number, Verb.RESULT, str(id_))[:-1]


def reply(data: bytes) -> tuple[str, tuple[str, ...]]:
    line = decode(data[:-1])
    return line.word, line.arguments


class Serving:
    """Desk, worker and session, worked by hand."""

    def __init__(self, folder: Path, orders: Orders, camera: FakeCamera | None = None) -> None:
        self.cell: Cell = fake_cell(folder)
        self.camera = camera or FakeCamera()
        self.writer = SessionWriter.create(folder / "s", purpose="calibration", cell=self.cell)
        self.desk = CellDesk()
        self.done: list[Job] = []
        self.worker = CellWorker(self.cell, None, self.camera, self.writer, orders, self.done.append)

    def work(self) -> None:
        """Everything that waits now."""
        self.desk.waiting.put(None)
        self.worker.work(self.desk.waiting)


Make = Callable[..., Serving]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[Serving] = []

    def one(*arguments: Any) -> Serving:
        made.append(Serving(tmp_path, *arguments))
        return made[-1]

    yield one
    for each in made:
        each.writer.close()


@pytest.fixture
def serving(make: Make) -> Serving:
    return make(Orders(sphere="A"))


def test_a_trigger_is_acknowledged_at_once_and_its_result_told_later(serving: Serving) -> None:
    assert reply(serving.desk.answer(trigger(1, 7))) == (Code.TRIGGER, ("7",))
    assert reply(serving.desk.answer(result(2, 7))) == (Code.RESULT, ("7", EXPOSING))
    serving.work()
    assert reply(serving.desk.answer(result(3, 7))) == (Code.RESULT, ("7", OK))
    (shot,) = read_session(serving.writer.folder).shots
    assert (shot.sphere, shot.pose_id, shot.status) == ("A", "trigger7", "ok")
    assert shot.joints_rad is not None
    np.testing.assert_allclose(np.degrees(shot.joints_rad), JOINTS_DEG, atol=1e-9)


def test_a_repeated_trigger_is_one_picture_and_the_same_id_again_replaces_it(serving: Serving) -> None:
    first = serving.desk.answer(trigger(1, 7))
    assert serving.desk.answer(trigger(1, 7)) == first
    serving.work()
    assert serving.desk.answer(trigger(1, 7)) == first
    serving.desk.answer(trigger(2, 7))
    serving.work()
    assert [shot.replaces for shot in serving.writer.shots] == [None, 0]
    assert len(serving.done) == 2


def test_while_it_exposes_another_trigger_is_refused(serving: Serving) -> None:
    serving.desk.answer(trigger(1, 7))
    word, arguments = reply(serving.desk.answer(trigger(2, 8)))
    assert (word, arguments[0]) == (Code.ERROR, str(int(Fault.BUSY)))


def test_a_picture_without_the_sphere_is_ng_with_the_reason(make: Make) -> None:
    camera = FakeCamera()
    camera.xyz_mm = np.where(camera.xyz_mm[..., 2:] > 0, camera.xyz_mm * np.float32(1.0), camera.xyz_mm)
    camera.xyz_mm[..., 2] = 400.0
    serving = make(Orders(sphere="A"), camera)
    serving.desk.answer(trigger(1, 1))
    serving.work()
    word, arguments = reply(serving.desk.answer(result(2, 1)))
    assert (word, arguments[1]) == (Code.RESULT, NG)
    assert len(arguments) > 2
    (shot,) = read_session(serving.writer.folder).shots
    assert shot.status == "failed"
    assert shot.scan is not None  # the picture is kept for whoever asks why


def test_a_camera_that_fails_once_is_ng_and_one_that_is_gone_ends_the_service(make: Make) -> None:
    serving = make(Orders(), FakeCamera([CameraTimeout("no frame"), None, CameraNotReached("gone")]))
    for i in (1, 2):
        serving.desk.answer(trigger(i, i))
        serving.work()
    assert serving.worker.counts == {OK: 1, NG: 1}
    serving.desk.answer(trigger(3, 3))
    with pytest.raises(CameraNotReached):
        serving.work()
    assert reply(serving.desk.answer(result(4, 3)))[1][1] == NG


def test_a_camera_whose_link_was_lost_is_opened_anew_for_the_next_picture_if_it_is_the_same(make: Make) -> None:
    camera = FakeCamera([None, CameraLost("cut")])
    serving = make(Orders(), camera)
    serving.worker.told = {"camera_serial": "c1"}
    camera.info = CameraInfo("fake", serial="c2")
    for i in range(1, 4):
        serving.desk.answer(trigger(i, i))
        serving.work()
    assert serving.worker.counts == {OK: 1, NG: 2}
    assert "is c2, the run was begun with c1" in str(read_session(serving.writer.folder).shots[-1].reason)
    camera.info, camera.sequence = CameraInfo("fake", serial="c1"), 0
    serving.desk.answer(trigger(4, 4))
    serving.work()
    assert serving.worker.counts == {OK: 2, NG: 2}


def test_a_plan_says_which_sphere_and_where_the_robot_must_stand(make: Make) -> None:
    poses = (PlannedPose("p1", "A", np.radians(JOINTS_DEG)), PlannedPose("p2", None, np.zeros(6)))
    serving = make(Orders(poses))
    for number, id_ in ((1, 1), (2, 2), (3, 9)):
        serving.desk.answer(trigger(number, id_))
        serving.work()
    states = [reply(serving.desk.answer(result(10 + id_, id_)))[1] for id_ in (1, 2, 9)]
    assert [state[1] for state in states] == [OK, NG, NG]
    assert " ".join(states[1][2:]) == "170.12 degrees from pose p2"
    shots = read_session(serving.writer.folder).shots
    assert (shots[0].pose_id, shots[0].sphere, shots[0].status) == ("p1", "A", "ok")


def test_what_is_not_known_is_an_error_of_the_protocol(serving: Serving) -> None:
    for data, fault in ((result(1, 5), Fault.TOKEN), (encode(2, Verb.STATE)[:-1], Fault.VERB), (encode(3, Verb.TRIGGER, "1")[:-1], Fault.SYNTAX)):
        word, arguments = reply(serving.desk.answer(data))
        assert (word, arguments[0]) == (Code.ERROR, str(int(fault)))
    assert reply(serving.desk.answer(encode(4, Verb.HELLO)[:-1])) == (Code.HELLO, ("1", "0"))


@given(st.binary(max_size=100))
def test_any_bytes_get_an_answer(data: bytes) -> None:
    reply(CellDesk().answer(data))


@contextmanager
def served(serving: Serving) -> Iterator[int]:
    """The desk over TCP, its worker in a thread."""
    worker = threading.Thread(target=lambda: serving.worker.work(serving.desk.waiting))
    worker.start()
    try:
        with LineServer(serving.desk).over_tcp("127.0.0.1", 0) as port:
            yield port
    finally:
        serving.desk.waiting.put(None)
        worker.join()


def test_a_client_over_tcp_comes_and_goes_and_a_second_one_follows_a_dead_one(serving: Serving) -> None:
    with served(serving) as port:
        for id_ in (1, 2):
            client = LineClient(TcpLink("127.0.0.1", port))
            client.open(1.0)
            client.ask(Verb.TRIGGER, str(id_), *(angle_text(angle) for angle in JOINTS_DEG), timeout_s=1.0)
            assert _outcome(client, id_) == OK
            if id_ == 2:
                with pytest.raises(Refusal):
                    client.ask(Verb.RESULT, "99", timeout_s=1.0)
            client.close()
        dead = socket.create_connection(("127.0.0.1", port))  # says nothing, closes nothing
        time.sleep(0.2)
        client = LineClient(TcpLink("127.0.0.1", port))
        client.open(1.0)
        client.ask(Verb.HELLO, timeout_s=3.0)
        client.close()
        dead.close()


def _outcome(client: LineClient, id_: int) -> str:
    end_s = time.monotonic() + 5
    while time.monotonic() < end_s:
        told = client.ask(Verb.RESULT, str(id_), timeout_s=1.0).line.arguments[1]
        if told in (OK, NG):
            return told
        time.sleep(0.02)
    pytest.fail("no result")


def test_a_port_that_is_taken_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        serves = LineServer(CellDesk()).over_tcp("127.0.0.1", taken.getsockname()[1])
        with pytest.raises(SettingsError):
            serves.__enter__()


class JobWorld(World):
    """`spherecal_job.mod` executed with real sockets."""

    def __init__(self, port: int) -> None:
        super().__init__([])
        self.socket: socket.socket | None = None
        names = [name[2:] for name in dir(self) if name.startswith("i_")]
        text = module_text("spherecal_job.mod").replace('"192.168.125.2"', '"127.0.0.1"').replace("5005", str(port))
        self.machine = Machine([read(text)], {name: getattr(self, f"i_{name}") for name in names}, {})
        self.joints_deg = list(JOINTS_DEG)

    def i_SocketCreate(self, machine: Machine, required: Any, options: Any) -> None: ...

    def i_SocketClose(self, machine: Machine, required: Any, options: Any) -> None:
        if self.socket is not None:
            self.socket.close()
            self.socket = None

    def i_SocketConnect(self, machine: Machine, required: Any, options: Any) -> None:
        address, port = machine.value(required[1]), int(machine.value(required[2]))
        try:
            self.socket = socket.create_connection((address, port), timeout=float(machine.value(options["Time"])))
        except OSError as error:
            raise RapidError("ERR_SOCK_TIMEOUT") from error

    def i_SocketSend(self, machine: Machine, required: Any, options: Any) -> None:
        if self.socket is None:
            raise RapidError("ERR_SOCK_CLOSED")
        self.socket.sendall(machine.value(options["Str"]).encode("ascii"))

    def i_SocketReceive(self, machine: Machine, required: Any, options: Any) -> None:
        if self.socket is None:
            raise RapidError("ERR_SOCK_CLOSED")
        try:
            data = self.socket.recv(int(machine.value(options["ReadNoOfBytes"])))
        except OSError as error:
            raise RapidError("ERR_SOCK_TIMEOUT") from error
        if not data:
            raise RapidError("ERR_SOCK_CLOSED")
        machine.assign(options["Str"], data.decode("latin-1"))

    def i_WaitRob(self, machine: Machine, required: Any, options: Any) -> None: ...

    def i_WaitTime(self, machine: Machine, required: Any, options: Any) -> None:
        time.sleep(0.01)

    def i_ErrWrite(self, machine: Machine, required: Any, options: Any) -> None:
        self.journal.append(machine.value(required[0]))


def test_the_rapid_job_triggers_and_hears_ok_and_ng(make: Make) -> None:
    serving = make(Orders(), FakeCamera([None, CameraTimeout("no frame")]))
    with served(serving) as port:
        world = JobWorld(port)
        assert world.machine.call("SphTrigger", np.float32(1)) is True
        assert world.machine.call("SphResult", np.float32(1)) is True
        assert world.machine.call("SphTrigger", np.float32(2)) is False
        assert world.machine.call("SphResult", np.float32(2)) is False
        assert world.machine.call("SphResult", np.float32(3)) is False
        world.i_SocketClose(world.machine, [], {})
    first, second = read_session(serving.writer.folder).shots
    assert (first.status, second.status) == ("ok", "failed")
    assert first.joints_rad is not None
    np.testing.assert_allclose(np.degrees(first.joints_rad), JOINTS_DEG, atol=1e-4)


def test_the_rapid_job_gives_up_where_nobody_serves() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    world = JobWorld(port)
    assert world.machine.call("SphTrigger", np.float32(1)) is False
    assert world.journal == ["spherecal does not answer"]


def urscript() -> dict[str, Any]:
    """The functions of the page, run as Python: without `end` and `local` URScript is that, as far as it is used here."""
    page = (ROOT / "docs" / "controller_as_master.md").read_text(encoding="utf-8")
    text = page.split("```urscript\n")[1].split("```")[0]
    lines = [line.replace("local ", "", 1) for line in text.splitlines() if line.strip() != "end"]
    numbered = [("  global sph_number\n" + line if line.startswith("  sph_number = ") else line) for line in lines]
    names: dict[str, Any] = {
        "str_find": lambda text, wanted: text.find(wanted),
        "str_len": len,
        "str_at": lambda text, at: text[at],
        "str_cat": lambda a, b: a + b,
        "str_sub": lambda text, at, count: text[at : at + count],
        "to_str": str,
        "floor": math.floor,
        "r2d": math.degrees,
        "is_steady": lambda: True,
        "sleep": lambda _: time.sleep(0.005),
        "get_actual_joint_positions": lambda: [math.radians(angle) for angle in JOINTS_DEG],
    }
    exec("\n".join(numbered), names)
    return names


def test_the_urscript_of_the_page_triggers_and_hears_ok_and_ng(make: Make) -> None:
    serving = make(Orders(), FakeCamera([None, CameraTimeout("no frame")]))
    script = urscript()
    with served(serving) as port, socket.create_connection(("127.0.0.1", port), timeout=2) as link, link.makefile("rb") as lines:
        script["socket_send_line"] = lambda text, _: link.sendall(text.encode("ascii") + b"\n")
        script["socket_read_line"] = lambda _, timeout_s: lines.readline().decode("ascii").strip()
        assert script["sph_trigger"](1) is True
        assert script["sph_result"](1) is True
        assert script["sph_trigger"](2) is False
        assert script["sph_result"](2) is False
    first = serving.writer.shots[0]
    assert first.joints_rad is not None
    np.testing.assert_allclose(np.degrees(first.joints_rad), JOINTS_DEG, atol=0.51e-4)


@pytest.mark.parametrize("body", ["0001 HELLO", "0042 TRIG 7 10.0000 -5.5000 0.0000 0.0000 20.1235 -170.1234", "9999 RESULT 123"])
def test_the_checksum_of_the_urscript_is_ours(body: str) -> None:
    assert urscript()["sph_sum"](body) == checksum(body)
