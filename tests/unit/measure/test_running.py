"""Who may run what unattended, what keys and Ctrl-C come to, and what the screen shows."""

from __future__ import annotations

import io
import os
import pty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import Cell
from acquire.events import Captured, Cause, Continue, Event, Moving, Pause, Paused, PoseStarted, Redo, Skip, Skipped, Stop, Suspended, WarmingUp
from acquire.plan import Plan
from acquire.sphere import find_sphere
from acquire.visibility import CameraView
from drivers.errors import ProtectiveStop
from drivers.files.shots import Shot
from drivers.models import load_robot_model
from measure.running_coverage import Coverage, cell_of, strip
from measure.running_keys import Keyboard
from measure.running_operator import Interrupts, Operator
from measure.running_record import RunRecord, append_run, motion_digest, never_driven, read_runs, runs_path
from measure.running_screen import NO_SAFETY, Screen
from tests.support.fake_devices import CENTRE_MM, RADIUS_MM, FakeCamera, fake_cell, fake_plan

SLOW = 0.1


def run_of(cell: Cell, plan: Plan, *driven: str, stepped: bool = True, speed: float = SLOW) -> RunRecord:
    return RunRecord("2026-01-01T00:00:00Z", motion_digest(plan), cell.sha256, "s", stepped, speed, driven, "done")


def test_a_plan_is_driven_when_every_pose_was_shown_slowly_step_by_step(tmp_path: Path) -> None:
    cell, plan = fake_cell(tmp_path), fake_plan(3)
    path = runs_path(cell)
    assert path == tmp_path / "cell.runs.jsonl"
    left = [never_driven(cell, plan, read_runs(path), SLOW)]
    for run in (
        run_of(cell, plan, "p0", "p1", "p2", stepped=False),
        run_of(cell, plan, "p0", "p1", "p2", speed=0.3),
        run_of(cell, fake_plan(3, vias=True), "p0", "p1", "p2"),
        replace(run_of(cell, plan, "p0", "p1", "p2"), cell_sha256="0" * 64),
        run_of(cell, plan, "p0", "p2"),
        run_of(cell, plan, "p1"),
    ):
        append_run(path, run)
        left.append(never_driven(cell, plan, read_runs(path), SLOW))
    assert left == [("p0", "p1", "p2")] * 5 + [("p1",), ()]


def test_the_order_of_poses_is_part_of_a_plan() -> None:
    plan = fake_plan(3)
    assert motion_digest(plan) != motion_digest(replace(plan, poses=plan.poses[::-1]))
    assert motion_digest(plan) == motion_digest(replace(plan, predicted={"length_rms_mm": 1.0}, cell_sha256="1" * 64))


@given(line=st.text() | st.binary().map(lambda data: data.decode(errors="replace")))
def test_lines_that_mean_nothing_prove_nothing(line: str) -> None:
    from measure.running_record import _parsed

    assert _parsed(line) is None


class Terminal:
    """A keyboard and the hand at it."""

    def __init__(self) -> None:
        self.hand, self._other = pty.openpty()
        self.stream = os.fdopen(self._other, "r")

    def types(self, text: str) -> None:
        os.write(self.hand, text.encode())

    def close(self) -> None:
        self.stream.close()
        os.close(self.hand)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    made.close()


POSE = fake_plan(1).poses[0]
STARTED = PoseStarted(POSE, 1, 3)
SHOT = Shot(index=0, sphere="A", joints_rad=None, base_from_flange=None, scan=None, sha256=None, time_utc="", status="skipped")
SUSPENDED = Suspended("p0", Cause.SAFETY, ProtectiveStop("hit", remedy="Clear it."))


def told(*_: object) -> None:
    """Nobody listens."""


def test_keys_become_commands_when_they_can_be_obeyed(terminal: Terminal) -> None:
    with Keyboard.opened(terminal.stream) as keys:
        operator = Operator(keys, Interrupts(told, attended=True), told, step=False, planned=[POSE.id])
        moving = Moving("p0", None, 0.1)
        assert operator.command_at(moving) is None
        terminal.types("s")
        assert operator.command_at(moving) == Skip()
        terminal.types("r")
        assert operator.command_at(moving) == Redo()
        terminal.types("p")
        assert operator.command_at(moving) is None
        assert operator.command_at(Skipped("p0", SHOT)) == Pause()
        assert operator.command_at(STARTED) is None
        terminal.types("q")
        assert operator.command_at(moving) is None
        assert operator.command_at(STARTED) == Stop()


@pytest.mark.parametrize(("key", "command"), [("\n", None), ("s", Skip()), ("r", Redo()), ("q", Stop())])
def test_step_mode_asks_and_hasty_keys_answer_nothing(key: str, command: object, terminal: Terminal) -> None:
    with Keyboard.opened(terminal.stream) as keys:
        questions: list[str | None] = []

        def prompt(question: str | None) -> None:
            questions.append(question)
            if question is not None:
                terminal.types("x" + key)

        operator = Operator(keys, Interrupts(told, attended=True), prompt, step=True, planned=[POSE.id])
        terminal.types("\n\n\n")
        assert operator.command_at(STARTED) == command
        assert questions[1:] == [None]
        assert questions[0] is not None
        assert len(questions[0]) <= 80


def test_a_suspended_run_asks_a_person_and_only_a_person(terminal: Terminal) -> None:
    with Keyboard.opened(terminal.stream) as keys:
        operator = Operator(keys, Interrupts(told, attended=True), lambda question: terminal.types("\n") if question else None, step=False)
        assert operator.command_at(SUSPENDED) == Continue()
        assert operator.command_at(Paused(None)) == Continue()
    nobody = Operator(None, Interrupts(told, attended=False), told, step=False)
    assert nobody.command_at(SUSPENDED) is None
    assert nobody.command_at(Paused(None)) == Stop()


def test_ctrl_c_pauses_where_somebody_sits_and_ends_where_nobody_does(terminal: Terminal) -> None:
    with Keyboard.opened(terminal.stream) as keys:
        for own, at_rest, ended in ((keys, Pause(), False), (None, Stop(), True)):
            interrupts = Interrupts(told, attended=own is not None)
            operator = Operator(own, interrupts, told, step=False)
            interrupts._interrupted(2, None)
            assert operator.command_at(Moving("p0", None, None)) is None
            assert operator.command_at(Skipped("p0", SHOT)) == at_rest
            assert interrupts.ended is ended
        interrupts._interrupted(2, None) if not interrupts.asked else None
        with pytest.raises(KeyboardInterrupt):
            interrupts._interrupted(2, None)
        # at a question the robot stands: the first one ends the run
        interrupts = Interrupts(told, attended=True)
        operator = Operator(keys, interrupts, lambda question: interrupts._interrupted(2, None) if question else None, step=True)
        assert operator.command_at(STARTED) == Stop()
        assert interrupts.ended


def test_a_pipe_has_no_keys() -> None:
    with Keyboard.opened(io.StringIO("q\n")) as keys:
        assert keys is None


VIEW = CameraView((250.0, 450.0), (float(np.radians(27)), float(np.radians(18))))


def captured() -> Captured:
    xyz = FakeCamera().xyz_mm
    finding = find_sphere(xyz, radius_mm=RADIUS_MM, predicted_centre_in_camera_mm=CENTRE_MM)
    joints = np.array([0.1, 0.2, 0.3, 0.0, 1.2, -3.0])
    return Captured("p0", replace(SHOT, joints_rad=joints, status="ok"), xyz, finding, 1.25)


def test_coverage_tells_which_parts_of_ranges_were_used() -> None:
    assert strip(np.array([-1.0, 1.0]), np.array([-1.0, 1.0])) == "[#............#]"
    assert cell_of(np.array([0.0, 0.0, 350.0]), VIEW) == (1, 1, 1)
    assert cell_of(np.array([-150.0, 80.0, 440.0]), VIEW) == (2, 2, 0)
    coverage = Coverage(load_robot_model("abb_irb1410"), VIEW)
    assert coverage.lines() == []
    for _ in range(12):
        coverage.add(captured())
    assert coverage.counts.sum() == coverage.counts[1, 1, 1] == 12
    lines = coverage.lines()
    assert len(lines) == 3
    assert max(map(len, lines)) <= 80
    assert "+" in lines[-1]


def test_the_picture_fits_and_always_says_what_a_stop_is_not() -> None:
    from rich.console import Console

    pictures: list[str] = []

    def draw(shown: object) -> None:
        console = Console(file=io.StringIO(), width=80)
        console.print(shown)
        pictures.append(console.file.getvalue())  # type: ignore[attr-defined]

    screen = Screen(told, told, draw, Coverage(load_robot_model("abb_irb1410"), VIEW), keys=True)
    events: list[Event] = [WarmingUp(30, 0.5, 0.001, warm=False), STARTED, Moving("p0", None, 0.1), *[captured()] * 30, SUSPENDED]
    for event in events:
        screen.show(event)
    screen.prompt("goes on?")
    assert all(NO_SAFETY in picture for picture in pictures)
    last = pictures[-1].splitlines()
    assert len(last) <= 24
    assert max(map(len, last)) <= 80
    for words in ("PAUSED", "goes on?", "Clear it.", "axes", "view"):
        assert words in pictures[-1]
    assert "0.50 K/min and 1 um/min" in pictures[0]
