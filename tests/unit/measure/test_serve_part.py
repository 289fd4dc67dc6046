"""The controller as master of an inspection: pictures fused as they come, RESULT 0 the part's own OK or NG."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import load_cell
from acquire.session import SessionWriter
from calibrate.result import Calibration
from drivers.abb.protocol import Code, Fault
from drivers.files.session import read_scan, read_session
from measure.cli import app
from measure.cli_run import run_app
from measure.history.store import History
from measure.inspecting.nominal import load_nominal
from measure.inspecting.spec import load_spec
from measure.part import CLOUD_FILE, Drawing, measure_part
from measure.serve import EXPOSED, EXPOSING, NG, OK, CellDesk, CellWorker, Job, Orders
from measure.serve_line import LineServer
from measure.serve_part import PartLine, PartPlaces
from measure.stitch import scans_once
from tests.support.fake_devices import FakeCamera
from tests.support.jobs import Parts, draw_ball, edit_head, make_parts
from tests.unit.measure.test_part import told
from tests.unit.measure.test_serve import JobWorld, reply, result, trigger, urscript


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return make_parts(tmp_path_factory.mktemp("served"), 1, 0, seed=12)


class Line:
    """Desk, worker and parts, worked by hand; the camera shows what a recorded session shows."""

    def __init__(self, parts: Parts, folder: Path, tolerance_mm: float) -> None:
        mesh, spec = draw_ball(folder, tolerance_mm=tolerance_mm)
        self.recorded = read_session(parts.folder / parts.good[0])
        self.cell = load_cell(self.recorded.cell_path)
        self.calibration, self.drawing = Calibration.load(parts.calibration), Drawing(load_nominal(mesh), load_spec(spec))
        places = PartPlaces(folder / "parts", folder / "results", parts.calibration, str(folder / "history.sqlite"))
        self.said: list[str] = []
        self.parts = PartLine(self.calibration, self.drawing, places, self.begin, self.said.append)
        self.camera, self.desk, self.number = FakeCamera(), CellDesk(judges_parts=True), 0
        self.worker = CellWorker(self.cell, None, self.camera, None, Orders(), parts=self.parts)

    def begin(self, folder: Path) -> SessionWriter:
        return SessionWriter.create(folder, purpose="workpiece", cell=self.cell, identity=dict(self.recorded.identity))

    def ask(self, data: bytes) -> tuple[str, tuple[str, ...]]:
        answer = reply(self.desk.answer(data))
        self.desk.waiting.put(None)
        self.worker.work(self.desk.waiting)
        return answer

    def picture(self, shot_number: int, id_: int) -> tuple[str, tuple[str, ...]]:
        shot = scans_once(self.recorded)[shot_number]
        self.camera.xyz_mm = read_scan(self.recorded, shot).points_mm[None]
        self.number += 1
        return self.ask(trigger(self.number, id_, tuple(np.degrees(np.asarray(shot.joints_rad)))))

    def verdict(self) -> tuple[str, ...]:
        end_s = time.monotonic() + 20
        while time.monotonic() < end_s:
            self.number += 1
            _, (number, state, *why) = self.ask(result(self.number, 0))
            if state not in {EXPOSING, EXPOSED}:
                return number, state, " ".join(why)
            time.sleep(0.01)
        pytest.fail("no verdict")


@contextmanager
def line(parts: Parts, folder: Path, tolerance_mm: float = 20.0) -> Iterator[Line]:
    made = Line(parts, folder, tolerance_mm)
    with made.parts:
        yield made


def test_a_part_is_ok_by_its_inspection_and_the_next_trigger_begins_another(parts: Parts, tmp_path: Path) -> None:
    with line(parts, tmp_path) as served:
        assert served.verdict()[1] == NG, "there is no picture yet"
        for i in (0, 1):
            assert served.picture(i, i + 1) == (Code.TRIGGER, (str(i + 1),))
        assert served.verdict() == ("0", OK, "")
        assert served.verdict() == ("0", OK, ""), "asked again, told again"
        # the second part: a picture taken again counts once
        for i, id_ in ((0, 1), (1, 2), (1, 2)):
            served.picture(i, id_)
        assert served.verdict()[1] == OK
        word, (fault, *_) = served.picture(0, 0)
        assert (word, fault) == (Code.ERROR, str(int(Fault.TOKEN)))
        served.picture(0, 1)  # nobody asks what this part is worth
    assert served.parts.counts == {"conform": 2}
    sessions = [read_session(tmp_path / "parts" / name) for name in ("0001", "0002", "0003")]
    assert [len(session.shots) for session in sessions] == [2, 2, 1]
    for session in sessions[:2]:
        folder = tmp_path / "results" / session.folder.name
        written = json.loads((folder / "inspection.json").read_text(encoding="utf-8"))
        alone = measure_part(served.calibration, session, served.drawing, folder)
        assert told(json.loads(json.dumps(written["checks"]))) == told(alone.inspection)["checks"]  # type: ignore[index]
        alone.write_cloud(tmp_path)
        assert (folder / CLOUD_FILE).read_bytes() == (tmp_path / CLOUD_FILE).read_bytes()
    assert not (tmp_path / "results" / "0003").exists()
    with History.open(str(tmp_path / "history.sqlite")) as history:
        assert [row.data["part"] for row in history.results(served.calibration.cell_name, "inspection")] == ["0001", "0002"]


def test_a_part_that_is_not_proven_good_is_ng_and_so_is_one_that_cannot_be_measured(parts: Parts, tmp_path: Path) -> None:
    with line(parts, tmp_path, tolerance_mm=0.001) as served:
        served.picture(0, 1)
        served.picture(1, 2)
        _, state, why = served.verdict()
        assert (state, why.split(":")[0] in {"not_proven", "reject"}) == (NG, True)
        served.recorded = read_session(parts.folder / parts.good[0])
        edit = served.parts.places.sessions
        served.picture(0, 1)
        edit_head(edit / "0002", {"camera_serial": "CAM-9"})
        _, state, why = served.verdict()
        assert state == NG
        assert why.startswith("error:")
    assert served.parts.counts["error"] == 1
    assert any("part 0002: error" in line for line in served.said)


def test_the_programs_for_pictures_hear_the_verdict_of_a_part(parts: Parts, tmp_path: Path) -> None:
    script = urscript()
    with line(parts, tmp_path) as served:
        served.picture(0, 1)
        served.picture(1, 2)
        worker = threading.Thread(target=lambda: served.worker.work(served.desk.waiting))
        worker.start()
        try:
            with LineServer(served.desk).over_tcp("127.0.0.1", 0) as port:
                world = JobWorld(port)
                assert world.machine.call("SphResult", np.float32(0)) is True
                world.i_SocketClose(world.machine, [], {})
                with socket.create_connection(("127.0.0.1", port), timeout=2) as link, link.makefile("rb") as lines:
                    script["socket_send_line"] = lambda text, _: link.sendall(text.encode("ascii") + b"\n")
                    script["socket_read_line"] = lambda _, timeout_s: lines.readline().decode("ascii").strip()
                    assert script["sph_result"](0) is True
        finally:
            served.desk.waiting.put(None)
            worker.join()


def test_half_an_inspection_is_refused(parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    mesh, spec = draw_ball(tmp_path)
    cell = read_session(parts.folder / parts.good[0]).cell_path
    words = ["serve-cell", str(cell), "-o", str(tmp_path / "out"), "--json", "--nominal", str(mesh)]
    for more in ([], ["--spec", str(spec)], ["--spec", str(spec), "--calibration", str(parts.calibration), "--resume"]):
        assert run_app(app, [*words, *more]) == 1
        assert "inspection" in json.loads(capfd.readouterr().out)["error"]["message"]


def test_a_job_of_the_part_is_told_as_a_picture_that_is_judged() -> None:
    desk = CellDesk(judges_parts=True)
    desk.answer(trigger(1, 4))
    assert reply(desk.answer(result(2, 0)))[1][1] == EXPOSING, "the robot must stand"
    job = desk.waiting.get()
    assert isinstance(job, Job)
    job.state = OK
    assert reply(desk.answer(result(3, 0)))[1][1] == EXPOSED
    assert reply(CellDesk().answer(result(1, 0)))[0] == Code.ERROR, "without an inspection 0 is a number as any other"
