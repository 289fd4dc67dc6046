"""`spherecal.mod` once more, in Python: what the RAPID program does with a line, on a simulated robot.

Written from the RAPID text, routine by routine, so that the client is tried against the same rules: one cached reply,
targets with a token that lives 5 s, epochs, the dead man's switch, the supervised restart. Numbers pass through single
precision where RAPID's `num` would round them. Not modelled: the time that RAPID itself takes, motion supervision,
singularities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.abb.answers import Answerer, Declined
from drivers.abb.protocol import (
    FASTEST_DEG_S,
    LAST_EPOCH,
    LENGTH_DECIMALS,
    MASTER_VERBS,
    N_AXES,
    QUATERNION_DECIMALS,
    TOKEN_LIFE_S,
    VERSION,
    Fault,
    Line,
    Outcome,
    StateReply,
    Verb,
    angle_text,
    number_text,
    numbers,
    state_arguments,
    whole,
)
from drivers.kinematics import mdh
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.cell import SimulatedCell

RAMP_S = 0.5
"""Added to way over speed, so that the controller's own acceleration never needs more than the speed asked for."""
_VERBS = tuple(verb for verb in Verb if verb is Verb.HELLO or verb not in MASTER_VERBS)


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    token: int
    joints_deg: FloatArray
    given_s: float


@dataclass(frozen=True, slots=True)
class Identity:
    """What GetSysInfo and GetSysData would say."""

    serial: str = "SIMULATED-0001"
    version: str = "6.08.0134"
    kind: str = "IRB 1410-5/1.44"
    tool: str = "sphTool"
    work_object: str = "wobj0"


class AbbProgram:
    """The program's variables and routines; the caller holds a lock around every call.

    Args:
        cell: the robot, on a clock of its own (instant), which goes on with `now`.
        now: seconds of a clock that never goes back.
        identity: what it says it is.
        speed_up: how much faster than real the robot moves.
    """

    def __init__(self, cell: SimulatedCell, now: Callable[[], float], identity: Identity | None = None, speed_up: float = 1.0) -> None:
        self.cell, self._now, self._speed_up = cell, now, speed_up
        self._ticked_s = now()
        self.identity = identity or Identity()
        self.epoch = 1
        self.n_motions = 0
        self.held = False
        """Whether the program stands still (emergency stop, stop button): then it answers nothing."""
        self.stop_letter, self.motors, self.mode = "N", "1", "A"
        self._outcome, self._last_token = Outcome.NONE, 0
        self._target: _Target | None = None
        self._answers = Answerer(self._do, _VERBS)
        self._heard_s, self._watchdog_s = now(), 3.0
        self._path_rad: FloatArray | None = None

    @property
    def moving(self) -> bool:
        """Whether a motion is under way."""
        return self._outcome is Outcome.RUNNING

    def answer(self, data: bytes) -> bytes:
        """The reply to a line; a repeated request gets the same words and does nothing (PROC SphAnswer)."""
        self.tick()
        reply = self._answers.answer(data)
        if not reply.startswith(b"0000"):
            self._heard_s = self._now()
        return reply

    def _do(self, line: Line) -> tuple[str, ...]:
        routines: dict[Verb, Callable[[Line], tuple[str, ...]]] = {
            Verb.HELLO: lambda _: (str(VERSION), str(self.epoch)),
            Verb.INFO: self._info,
            Verb.TOOL: lambda _: (self.identity.tool, self.identity.work_object),
            Verb.STATE: lambda _: state_arguments(self.state()),
            Verb.POSE: lambda _: self._pose(),
            Verb.TARGET: self._take_target,
            Verb.GO: self._go,
            Verb.LAST: lambda _: (str(self.epoch), str(self._last_token), str(int(self._outcome))),
            Verb.STOP: lambda _: self._stop(),
        }
        return routines[Verb(line.word)](line)

    def _info(self, line: Line) -> tuple[str, ...]:
        which = whole(line.arguments[0], 3)
        text = {1: self.identity.serial, 2: self.identity.version, 3: self.identity.kind}.get(which)
        if text is None:
            raise Declined(Fault.SYNTAX)
        return (str(which), *text.split())

    def state(self, *, seen_from_outside: bool = False) -> StateReply:
        """What `J` tells; motors and stop only the second program knows."""
        self.tick()
        joints_deg = np.degrees(self.cell.read_joints_rad()).astype(np.float32)
        letters = {Outcome.NONE: "R", Outcome.RUNNING: "M", Outcome.REACHED: "D"}
        motion = letters.get(self._outcome, "X")
        flags = (self.motors, self.stop_letter) if seen_from_outside else ("-", "-")
        return StateReply(self.epoch, tuple(float(angle) for angle in joints_deg), "X" if self.held and motion == "M" else motion, self.mode, *flags)

    def _pose(self) -> tuple[str, ...]:
        flange = mdh.base_from_flange(self.cell.model, self.cell.read_joints_rad())
        xyz = (number_text(float(np.float32(value)), LENGTH_DECIMALS) for value in flange[:3, 3])
        return (*xyz, *(number_text(float(np.float32(value)), QUATERNION_DECIMALS) for value in quaternion_wxyz(flange[:3, :3])))

    def _take_target(self, line: Line) -> tuple[str, ...]:
        if self.moving:
            raise Declined(Fault.BUSY)
        joints_deg = np.array(numbers(line.arguments, N_AXES))
        self._target = _Target(line.number, joints_deg, self._now())
        return tuple(angle_text(float(angle)) for angle in joints_deg.astype(np.float32))

    def _go(self, line: Line) -> tuple[str, ...]:
        epoch, token = whole(line.arguments[0], LAST_EPOCH), whole(line.arguments[1], 9999)
        speed_deg_s, watchdog_s = numbers(line.arguments[2:], 2)
        if self.moving:
            raise Declined(Fault.BUSY)
        if epoch != self.epoch:
            raise Declined(Fault.EPOCH)
        target, self._target = self._target, None
        if target is None or target.token != token:
            raise Declined(Fault.TOKEN)
        if self._now() - target.given_s > TOKEN_LIFE_S:
            raise Declined(Fault.EXPIRED)
        if not (0 < speed_deg_s <= FASTEST_DEG_S and 0 < watchdog_s <= 30):
            raise Declined(Fault.SPEED)
        way_deg = float(np.abs(target.joints_deg - np.degrees(self.cell.joints_rad())).max())
        self._begin(np.radians(target.joints_deg), float(np.radians(speed_deg_s)))
        self._watchdog_s, self._last_token, self._outcome = watchdog_s, token, Outcome.RUNNING
        return str(self.epoch), f"{token:04d}", number_text(way_deg / speed_deg_s + RAMP_S, 2)

    def _begin(self, target_rad: FloatArray, speed_rad_s: float) -> None:
        self.n_motions += 1
        self.cell.start_motion(target_rad, speed_rad_s=speed_rad_s)

    def _stop(self) -> tuple[str, ...]:
        self._target = None
        if self.moving:
            self._give_up(Outcome.STOPPED)
        return (str(self.epoch),)

    def _give_up(self, outcome: Outcome) -> None:
        """StopMove, ClearPath, StartMove, ExitCycle."""
        self.cell.stop_motion()
        self._outcome = outcome

    def tick(self) -> None:
        """Let time pass, and what TRAP SphPoll and the end of MoveAbsJ see: arrival, silence of the computer."""
        now_s = self._now()
        self.cell.advance((now_s - self._ticked_s) * self._speed_up)
        self._ticked_s = now_s
        if self.held or not self.moving:
            return
        if not self.cell.moving():
            self._outcome = Outcome.REACHED
        elif self._now() - self._heard_s > self._watchdog_s:
            self._give_up(Outcome.SILENCE)

    def link_lost(self) -> None:
        """The socket closed: a motion is given up."""
        self.tick()
        self._target = None
        if self.moving and not self.held:
            self._give_up(Outcome.LINK_LOST)

    def hold(self, stop_letter: str, *, motors_on: bool) -> None:
        """The controller stops the program, wherever it is; the path is kept, as a real one keeps it."""
        self.tick()
        self.held, self.stop_letter, self.motors = True, stop_letter, "1" if motors_on else "0"
        if self.moving:
            self._path_rad = np.array(self.cell.axes().target_rad)
            self.cell.stop_motion()

    def clear_stop(self) -> None:
        """The stop is reset and the motors are on; the program is still held."""
        self.stop_letter, self.motors = "N", "1"

    def press_start(self) -> None:
        """Start without moving the program pointer: SphOnRestart and the trap give the kept path up."""
        if not self.held:
            return
        self.clear_stop()
        self.held = False
        self._heard_s = self._now()
        self._target = None
        if self.moving:
            self._path_rad = None
            self._give_up(Outcome.HELD)

    def pp_to_main(self) -> None:
        """The program starts from its beginning: new epoch, no path, no target, no cached reply."""
        self.clear_stop()
        self.held = False
        self.cell.stop_motion()
        self.epoch = self.epoch % LAST_EPOCH + 1
        self._answers.forget()
        self._outcome, self._last_token, self._target, self._path_rad = Outcome.NONE, 0, None, None

    def use(self, **changes: str) -> None:
        """Another identity."""
        self.identity = replace(self.identity, **changes)


def quaternion_wxyz(rotation: FloatArray) -> FloatArray:
    """(4,) of a rotation matrix, w not negative."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])
