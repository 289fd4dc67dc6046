"""Client and program together, in any order of commands, faults and buttons: no motion is begun that was not asked for once."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from drivers.errors import MotionInterrupted, MotionRefused, RobotError
from drivers.simulated.controllers.abb_faults import press
from tests.support.abb_virtual import virtual_cell

ANGLES_DEG = st.sampled_from([-40.0, -7.5, 0.0, 12.0, 33.0])


class AbbUnderFaults(RuleBasedStateMachine):
    """The truth is the program's; the machine knows which motions it asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.cell = virtual_cell(self.patch)
        self.asked_deg: list[float] = []
        self.may_move = False
        """Whether a motion may be under way: one was asked for since the last thing that ends motions."""
        self.last_motions = 0
        self.cell.robot.open()

    def teardown(self) -> None:
        self.patch.undo()

    @rule(first_deg=ANGLES_DEG, speed=st.sampled_from([0.05, 0.5, 1.0]))
    def move(self, first_deg: float, speed: float) -> None:
        target = np.radians([first_deg, 0.0, 0.0, 0.0, 0.0, 0.0])
        before = self.cell.program.n_motions
        self.asked_deg.append(first_deg)
        try:
            self.cell.robot.start_move(target, speed_rad_s=speed)
        except MotionRefused:
            assert self.cell.program.n_motions == before
            self.asked_deg.pop()
        except RobotError:
            self.may_move = True
            assert self.cell.program.n_motions in (before, before + 1)
        else:
            self.may_move = True
            assert self.cell.program.n_motions == before + 1

    @rule()
    def read(self) -> None:
        before = self.cell.program.n_motions
        began_s = self.cell.time.now_s
        try:
            state = self.cell.robot.read_state()
        except RobotError:
            pass
        else:
            assert state.moving == (self.cell.program.moving)
            assert state.joints_rad is not None
            np.testing.assert_allclose(state.joints_rad, self.cell.program.cell.joints_rad(), atol=2e-3)
        assert self.cell.time.now_s - began_s <= 1.2
        assert self.cell.program.n_motions == before

    @rule()
    def stop(self) -> None:
        try:
            self.cell.robot.stop()
        except RobotError:
            return
        assert not self.cell.program.moving
        self.may_move = False

    @rule(seconds=st.sampled_from([0.02, 0.3, 2.0, 10.0]))
    def wait(self, seconds: float) -> None:
        self.cell.robot.wait(seconds)

    @rule()
    def reopen(self) -> None:
        before = self.cell.program.n_motions
        with contextlib.suppress(RobotError):
            self.cell.robot.open()
        assert not self.cell.program.moving or self.cell.program.held
        assert self.cell.program.n_motions == before

    @rule(count=st.integers(1, 4))
    def lose_replies(self, count: int) -> None:
        left = [count]

        def lose(reply: bytes) -> bytes | None:
            left[0] -= 1
            return None if left[0] >= 0 else reply

        self.cell.link.spoil = lose

    @rule(count=st.integers(1, 4))
    def break_replies(self, count: int) -> None:
        left = [count]

        def broken(reply: bytes) -> bytes:
            left[0] -= 1
            return b"?" + reply[1:] if left[0] >= 0 else reply

        self.cell.link.spoil = broken

    @rule()
    def mend_the_line(self) -> None:
        self.cell.link.spoil = lambda reply: reply

    @rule()
    def pull_the_cable(self) -> None:
        self.cell.link.cut()
        if not self.cell.program.held:
            assert not self.cell.program.moving
            self.may_move = False

    @precondition(lambda self: not self.cell.program.held)
    @rule(button=st.sampled_from(["emergency_stop", "stop_button"]))
    def press_stop(self, button: str) -> None:
        press(self.cell.program, button)

    @precondition(lambda self: self.cell.program.held)
    @rule(button=st.sampled_from(["start_button", "restart"]))
    def press_start(self, button: str) -> None:
        press(self.cell.program, button)
        assert not self.cell.program.moving
        self.may_move = False

    @invariant()
    def no_motion_nobody_asked_for(self) -> None:
        program = self.cell.program
        assert program.n_motions <= len(self.asked_deg)
        program.tick()
        if program.moving:
            assert self.may_move
            if not program.held:
                axes = program.cell.axes()
                assert np.degrees(axes.asked_rad[0]) == pytest.approx(self.asked_deg[-1], abs=1e-4)


TestAbbUnderFaults = AbbUnderFaults.TestCase
TestAbbUnderFaults.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)


def test_a_new_epoch_on_the_same_line_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A serial line does not notice that the program began anew; the state does."""
    cell = virtual_cell(monkeypatch)
    cell.robot.open()
    cell.robot.read_state()
    press(cell.program, "restart")
    with pytest.raises(MotionInterrupted):
        cell.robot.read_state()
    cell.robot.open()
    assert not cell.robot.read_state().moving
