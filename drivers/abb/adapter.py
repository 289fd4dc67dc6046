"""An ABB robot whose controller runs `spherecal.mod`: the `Robot` protocol over the line protocol.

Degrees become radians here and nowhere else. Axis 3 stays what the controller calls axis 3: on arms with a parallelogram
it is the angle of the upper arm against the base, and the coupling matrix of the robot model turns it into link angles.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from drivers.abb.line import LineClient, Refusal, Reply
from drivers.abb.protocol import (
    FASTEST_DEG_S,
    LAST_EPOCH,
    N_AXES,
    OUTCOME_TEXTS,
    VERSION,
    BadLine,
    Outcome,
    Verb,
    angle_text,
    number_text,
    numbers,
    parse_state,
    whole,
)
from drivers.abb.replies import check_free, pose_of, refused, robot_state, two_words, type_notes
from drivers.abb.second import SecondProgram
from drivers.abb.settings import AbbSettings
from drivers.errors import (
    LinkLost,
    MotionInterrupted,
    MotionRefused,
    RobotError,
    RobotNotReached,
    RobotTimeout,
    StaleReading,
    WrongController,
)
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.protocols import CONNECT_S, MAX_AGE_S, SILENCE_S, RobotInfo, RobotState
from drivers.readings import checked_target

Parsed = TypeVar("Parsed")

_MAIN_SHARE = 0.6
"""Of a call's time that the moving program has to answer in where a second one could be asked."""
_READINGS = 5
"""Tries for a fresh one. While the robot moves, the first request waits for the program's next look, the second does not."""
_ECHO_TOLERANCE_DEG = 1.01e-4


@dataclass(slots=True)
class _Session:
    """What holds from `open` to the end of the link."""

    epoch: int
    held: bool = False
    """A stop or motors off hold the program: only the second one answers, and there is no link to the first."""
    moving: bool = False
    moved: bool = False
    """Whether a motion was started: its outcome is then worth asking for."""
    reason: str | None = None


class AbbRobot:
    """A robot behind `spherecal.mod`. Satisfies `drivers.protocols.Robot`.

    Args:
        settings: where it is.
        model: its nominal model: axes and limits of targets; None for work with flange poses only.
    """

    def __init__(self, settings: AbbSettings, model: RobotModel | None) -> None:
        self._settings, self._model = settings, model
        self._client = LineClient(settings.link())
        self._second = SecondProgram(settings.state_link())
        self._session: _Session | None = None

    def open(self) -> RobotInfo:
        """Connect and see that the right program answers, within 3 s; or, where a second program tells of a stop, that one.

        Raises:
            RobotNotReached: nobody is there (WrongController: somebody else is).
            RobotTimeout: nobody answers in time.
            RobotError: a tool or work object is active that the cell file does not name.
        """
        self.close()
        end_s = time.monotonic() + CONNECT_S
        if self._second.hold(0.2 * CONNECT_S) is not None:
            self._session = _Session(epoch=0, held=True)
            return RobotInfo("abb_socket", controller="IRC5", notes=("a stop or motors off hold the program on the controller",))
        try:
            self._client.open(0.5 * CONNECT_S)
            epoch = self._hello()
            info = self._identity(end_s)
        except BaseException:
            self.close()
            raise
        self._session = _Session(epoch)
        return info

    def _hello(self) -> int:
        try:
            arguments = self._client.ask(Verb.HELLO, timeout_s=0.8 * SILENCE_S).line.arguments
        except RobotTimeout as error:
            remedy = "Is spherecal.mod running there, and does no other program hold the connection? Emergency stop and stop button hold it, too."
            raise RobotTimeout(error.message, where=error.where, remedy=remedy) from error
        version, epoch = self._read(lambda: (whole(arguments[0], 99), whole(arguments[1], LAST_EPOCH)))
        if version != VERSION:
            raise WrongController(
                f"the program on the controller speaks version {version} of the protocol, this is version {VERSION}",
                where=self._client.link.name,
                remedy="Load the program of this version: spherecal abb-program --out DIR.",
            )
        return epoch

    def _identity(self, end_s: float) -> RobotInfo:
        def ask(verb: Verb, *arguments: str) -> tuple[str, ...]:
            return self._client.ask(verb, *arguments, timeout_s=min(max(end_s - time.monotonic(), 0.05), SILENCE_S)).line.arguments

        serial, version, kind = (" ".join(ask(Verb.INFO, str(i))[1:]) or None for i in (1, 2, 3))
        tool, work_object = self._read(lambda: two_words(ask(Verb.TOOL)))
        self._check_frames(tool, work_object)
        notes = () if self._model is None else type_notes(kind, self._model.name)
        return RobotInfo("abb_socket", model=kind, serial=serial, controller=f"IRC5 {version}", notes=notes)

    def _check_frames(self, tool: str, work_object: str) -> None:
        for what, key, found, allowed in (
            ("tool", "tool", tool, ("tool0", "sphTool", self._settings.tool)),
            ("work object", "work_object", work_object, ("wobj0", self._settings.work_object)),
        ):
            if found.lower() not in {name.lower() for name in allowed if name is not None}:
                raise RobotError(
                    f"the {what} {found} is active on the controller",
                    where=f"robot.{key}",
                    remedy=f"Select {allowed[0]} in the jogging window, or write `{key}: {found}` into the cell file if it is meant.",
                )

    def read_state(self) -> RobotState:
        """Axis angles, motion and stops, not older than 50 ms; while it stands also the flange pose (tool0 in wobj0).

        Raises:
            LinkLost: not open, or the link has gone; open again.
            RobotTimeout: no answer within 1 s (StaleReading: none that is fresh).
            MotionInterrupted: the program on the controller was started anew; open again.
        """
        session = self._opened()
        end_s = time.monotonic() + SILENCE_S
        if session.held:
            return self._of_the_hold(end_s)
        for _ in range(_READINGS):
            try:
                pose = self._pose(session, end_s)
                reply = self._client.ask(Verb.STATE, timeout_s=self._left(end_s))
            except RobotTimeout as error:
                return self._second_opinion(session, error, end_s)
            if reply.age_s <= MAX_AGE_S:
                return self._state(session, reply, pose, end_s)
            if time.monotonic() > end_s - SILENCE_S / 2:
                break
        raise StaleReading(
            f"readings are {reply.age_s * 1000:.0f} ms old when they come, allowed {MAX_AGE_S * 1000:.0f} ms",
            where=self._client.link.name,
            remedy="Use a faster line (38400 baud or more) or a cable of its own, then continue with --resume.",
        )

    def _left(self, end_s: float) -> float:
        share = _MAIN_SHARE if self._second.is_there else 1.0
        return max((end_s - time.monotonic()) * share, 0.05)

    def _pose(self, session: _Session, end_s: float) -> FloatArray | None:
        if session.moving or not self._settings.flange_pose:
            return None
        return self._read(lambda: pose_of(self._client.ask(Verb.POSE, timeout_s=self._left(end_s))))

    def _state(self, session: _Session, reply: Reply, pose: FloatArray | None, end_s: float) -> RobotState:
        state = self._read(lambda: parse_state(reply.line))
        if state.epoch != session.epoch:
            self._lose()
            raise MotionInterrupted(
                f"the program on the controller was started anew (epoch {session.epoch}, now {state.epoch})",
                where=self._client.link.name,
                remedy="No motion goes on by itself. See that the robot stands as it should, then continue with --resume.",
            )
        session.moving = state.motion == "M"
        session.reason = self._why_interrupted(session, end_s) if state.motion == "X" else None
        return robot_state(state, reply, None if session.moving else pose, session.reason)

    def _why_interrupted(self, session: _Session, end_s: float) -> str | None:
        if session.reason is None and session.moved:
            arguments = self._client.ask(Verb.LAST, timeout_s=self._left(end_s)).line.arguments
            outcome = self._read(lambda: Outcome(whole(arguments[2], max(Outcome))))
            return OUTCOME_TEXTS[outcome]
        return session.reason

    def _second_opinion(self, session: _Session, error: RobotTimeout, end_s: float) -> RobotState:
        """The first program is silent: a stop or motors off that the second one tells of, or the error."""
        state = self._second.hold(max(end_s - time.monotonic(), 0.1))
        if state is None:
            self._lose()
            raise error
        session.held, session.moving = True, False
        return state

    def _of_the_hold(self, end_s: float) -> RobotState:
        """A reading while a stop or motors off hold the first program."""
        state = self._second.hold(max(end_s - time.monotonic(), 0.1))
        if state is None:
            self._lose()
            raise self._not_open()
        return state

    def start_move(self, joints_rad: FloatArray, *, speed_rad_s: float) -> None:
        """Start a motion: give the target, see it come back unchanged, start it by its token. It stops without us.

        Raises:
            MotionRefused: limits, speed, or what the program says (MotorsOff: no power on the drives).
            SafetyStop: a stop is active.
            LinkLost: the link has gone; whatever moves is stopped by the program itself.
            RobotTimeout: no answer in time.
        """
        session = self._opened()
        target_deg = self._checked_deg(joints_rad, speed_rad_s)
        end_s = time.monotonic() + SILENCE_S
        if session.held:
            check_free(self._of_the_hold(end_s))
        try:
            token = self._give_target(target_deg, end_s)
            session.moved, session.reason, session.moving = True, None, True
            speed, watchdog = number_text(float(np.degrees(speed_rad_s)), 4), number_text(self._settings.watchdog_s, 2)
            self._client.ask(Verb.GO, str(session.epoch), token, speed, watchdog, timeout_s=self._left(end_s))
        except Refusal as error:
            raise refused(error) from error
        except RobotTimeout as error:
            check_free(self._second_opinion(session, error, end_s))
            raise

    def _give_target(self, target_deg: FloatArray, end_s: float) -> str:
        """Tell the target and compare what the controller understood; its token."""
        told = self._client.ask(Verb.TARGET, *(angle_text(angle) for angle in target_deg), timeout_s=self._left(end_s)).line
        echo = self._read(lambda: numbers(told.arguments, N_AXES))
        if float(np.abs(np.array(echo) - target_deg).max()) > _ECHO_TOLERANCE_DEG:
            raise MotionRefused("the controller understood another target than was sent", remedy="Is the line disturbed? Try again.")
        return f"{told.number:04d}"

    def _checked_deg(self, joints_rad: FloatArray, speed_rad_s: float) -> FloatArray:
        if self._model is None:
            joints_rad = np.asarray(joints_rad, dtype=np.float64)
            if joints_rad.shape != (N_AXES,) or not np.isfinite(joints_rad).all() or not (np.isfinite(speed_rad_s) and speed_rad_s > 0):
                raise MotionRefused("a target that is not six finite axis angles, or no positive speed", remedy="Give every axis angle in rad.")
            target_rad = joints_rad
        else:
            target_rad = checked_target(self._model, joints_rad, speed_rad_s=speed_rad_s)
        if target_rad.shape != (N_AXES,):
            raise MotionRefused(f"a target of {target_rad.size} axes", remedy="The program on the controller moves six axes.")
        if np.degrees(speed_rad_s) > FASTEST_DEG_S:
            found = f"a speed of {speed_rad_s:g} rad/s, the program allows up to {np.radians(FASTEST_DEG_S):.2f} rad/s"
            raise MotionRefused(found, remedy="Lower motion.speed_rad_s of the cell file.")
        return np.degrees(target_rad)

    def stop(self) -> None:
        """Stop now; over a new connection where the old one has gone. Nothing else is done with that one.

        Raises:
            RobotNotReached: nobody can be told; the program then stops a motion by itself (`watchdog_s`).
            RobotTimeout: likewise, no answer.
        """
        end_s = time.monotonic() + SILENCE_S
        if self._client.is_open:
            try:
                self._client.ask(Verb.STOP, timeout_s=SILENCE_S / 2)
            except (RobotNotReached, RobotTimeout):
                pass  # the link is closed now
            else:
                return
        if self._second.hold(SILENCE_S / 5) is not None:
            return  # it stands
        self._stop_over_a_new_link(end_s)

    def _stop_over_a_new_link(self, end_s: float) -> None:
        self._lose()
        try:
            self._client.open(max(end_s - time.monotonic(), 0.1) / 2)
            self._client.ask(Verb.STOP, timeout_s=max(end_s - time.monotonic(), 0.1))
        finally:
            self._lose()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        if seconds > 0:
            time.sleep(seconds)

    def close(self) -> None:
        """Let go of the links; the program stops a motion that is under way."""
        self._lose()
        self._second.close()

    def _lose(self) -> None:
        self._session = None
        self._client.close()

    def _opened(self) -> _Session:
        if self._session is None or not (self._session.held or self._client.is_open):
            raise self._not_open()
        return self._session

    def _not_open(self) -> LinkLost:
        remedy = "Open it again; with capture: --resume."
        return LinkLost("the robot is not open, or its link was lost", where=self._client.link.name, remedy=remedy)

    def _read(self, parse: Callable[[], Parsed]) -> Parsed:
        try:
            return parse()
        except (BadLine, IndexError, ValueError) as error:
            self._lose()
            told = f"an answer makes no sense: {error}"
            raise WrongController(told, where=self._client.link.name, remedy="Load the program of this version: spherecal abb-program.") from error
