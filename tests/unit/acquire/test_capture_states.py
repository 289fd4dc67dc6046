"""The run as a state machine: whatever is said and whatever breaks, in any order, over several processes."""

from __future__ import annotations

import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from acquire.capture import run_capture
from acquire.capture_pose import Steps
from acquire.capture_states import RunState
from acquire.events import Append, Command, Continue, Event, Finish, Finished, Moving, Pause, Redo, Skip, Stop
from acquire.plan import PlannedPose
from drivers.errors import CameraNotReached, CameraTimeout, RobotNotReached, SpherecalError
from drivers.files.session import read_session
from drivers.protocols import Safety
from tests.support.capture_bench import Bench
from tests.support.fake_devices import fake_plan

SAID: list[Command | None] = [None, None, Continue(), Skip(), Redo(), Pause(), Append(PlannedPose("more", "A", np.array([0.3, 0.3])))]
ENDING: list[Command] = [Stop(), Finish()]
STOPS = [Safety.PROTECTIVE_STOP, Safety.SAFEGUARD_STOP, Safety.EMERGENCY_STOP]
LETTERS = {state: state.value[0] for state in RunState if state not in {RunState.ABORTED, RunState.FAILED}} | {
    RunState.DONE: "D",
    RunState.ABORTED: "A",
    RunState.FAILED: "F",
}
# spelled out here once more, and not taken from the table that the run keeps to: m only after r, s after m (or the
# warm-up's r and p), c after s, an end only at the end, and done never from the middle of a pose
LEGAL = re.compile(r"r(?:(?<=[rp])m|(?<=m)m|(?<=[mrps])s|(?<=[sc])c|r|p)*(?:(?<=[rp])D|A|F)?")


class Run(RuleBasedStateMachine):
    """One session, taken by one process after the other."""

    def __init__(self) -> None:
        super().__init__()
        self.temporary = TemporaryDirectory()
        self.bench = Bench(Path(self.temporary.name))
        self.steps: Steps | None = None
        self.event: Event | None = None
        self.story = ""

    @initialize(vias=st.booleans(), n=st.integers(1, 4))
    def begin(self, vias: bool, n: int) -> None:
        self.plan = fake_plan(n, vias=vias)
        self._start()

    def _start(self) -> None:
        self.steps, self.story = run_capture(self.bench.devices, self.bench.cell, self.plan, self.bench.writer), ""
        self._note(lambda: next(self.steps) if self.steps is not None else None)

    def _note(self, step: object) -> None:
        if not callable(step):
            raise TypeError(step)
        try:
            self.event = step()
        except SpherecalError:
            self.story, self.steps = self.story + "F", None
        except StopIteration:
            self.steps = None
        else:
            if self.event is not None:
                self.story += LETTERS[self.event.state]

    @property
    def going(self) -> bool:
        return self.steps is not None

    def _say(self, command: Command | None) -> None:
        steps = self.steps
        if steps is not None:
            self._note(lambda: steps.send(command))

    @precondition(lambda self: self.going)
    @rule(command=st.sampled_from(SAID))
    def say(self, command: Command | None) -> None:
        self._say(command)

    @precondition(lambda self: self.going)
    @rule(n=st.integers(1, 30))
    def let_it_run(self, n: int) -> None:
        for _ in range(n):
            self._say(None)

    @precondition(lambda self: self.going)
    @rule(command=st.sampled_from(ENDING))
    def say_the_end(self, command: Command) -> None:
        self._say(command)

    @rule(fault=st.sampled_from([CameraTimeout("late"), CameraNotReached("gone"), RobotNotReached("cut")]), n=st.integers(1, 3))
    def something_breaks(self, fault: SpherecalError, n: int) -> None:
        self.bench.camera.faults += [fault] * n

    @rule(safety=st.sampled_from([Safety.NORMAL, *STOPS]))
    def somebody_at_the_cell(self, safety: Safety) -> None:
        self.bench.robot.safety = safety

    @rule(tremble_rad=st.sampled_from([0.0, 0.0, 1e-3]))
    def somebody_leans_on_it(self, tremble_rad: float) -> None:
        self.bench.robot.tremble_rad = tremble_rad

    @rule()
    def a_new_process(self) -> None:
        if self.steps is not None:
            self.steps.close()
        assert not self.bench.robot.moving
        self.bench.resumed()
        self._start()

    @invariant()
    def states_follow_each_other(self) -> None:
        assert LEGAL.fullmatch(self.story or "r"), self.story

    @invariant()
    def the_robot_moves_in_one_state_only(self) -> None:
        assert not self.bench.robot.moving or (self.going and isinstance(self.event, Moving))

    @invariant()
    def the_session_is_whole(self) -> None:
        shots = read_session(self.bench.folder).shots
        good = [shot.pose_id for shot in shots if shot.status == "ok"]
        assert len(set(good)) == len(good)
        assert all(shot.scan is not None and shot.joints_rad is not None for shot in shots if shot.status == "ok")

    @invariant()
    def done_is_done(self) -> None:
        if not self.going and self.story.endswith("D"):
            assert isinstance(self.event, Finished)
            recorded = {shot.pose_id for shot in read_session(self.bench.folder).shots}
            missing = {pose.id for pose in self.plan.poses} - recorded
            assert len(missing) <= self.event.n_left

    def teardown(self) -> None:
        if self.steps is not None:
            self.steps.close()
        self.bench.writer.close()
        self.temporary.cleanup()


Run.TestCase.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
TestRun = Run.TestCase


def test_every_state_that_the_table_lets_in_is_left_only_by_its_end() -> None:
    assert [state for state in RunState if state.is_end] == [RunState.DONE, RunState.ABORTED, RunState.FAILED]


def test_a_story_is_judged() -> None:
    """The law that the machine is held against refuses what must not be."""
    for good in ("r", "rrmmscrrD", "rrmpprmmscA", "rsssrmF", "rpD"):
        assert LEGAL.fullmatch(good), good
    for bad in ("m", "rc", "rrmc", "rrmD", "rDr", "rmrc", "rscm"):
        assert not LEGAL.fullmatch(bad), bad
