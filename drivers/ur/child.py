"""The process in which ur_rtde lives: requests in, one line of JSON each, replies out.

Why a process: the constructors of ur_rtde hold Python's global lock while they wait, some for ever, and a blocked call
cannot be cancelled. A process can be killed. It imports nothing of spherecal and no numpy, so that it starts at once.

Why no new connections once it is connected: ur_rtde opens a lost link anew by itself and then sends the command again
that was under way. Here no socket can be opened any more, so nothing is ever repeated: the command fails.

When the parent goes away (end of the input), or a motion outlives its deadline, the arm is stopped. When this process or
the line to the controller dies, the controller's own RTDE watchdog ends the program, and with it the motion.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_LOOK_S = 0.0005
_SETTLE_S = 0.0003
"""The variables of a package are stored one after the other; the timestamp comes first."""
_PATIENCE_S = 0.5
_FRESH_S = 0.05
_CLOCK_DRIFT = 1e-4
_STARTS_WITHIN_S = 0.5
_STILL_RAD_S = 2e-3
_STOP_RAD_S2 = 5.0
_STANDS_WITHIN_S = 0.3
_WATCHDOG_HZ, _KICK_S = 0.5, 0.2
"""The controller ends the program when no input came for 2 s; an input is sent every 0.2 s."""
_LEAVE_S = 1.5
_POLL_S = 0.05
_PLAYING = 2


class Failure(Exception):
    """A request that cannot be done; the kind is one that the parent knows."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


def freeze_connections() -> None:
    """From now on this process can open no file and no socket; those that are open stay."""
    _limit_files(1)  # not 0: poll() refuses to look at more descriptors than the limit says


@contextmanager
def connections_allowed() -> Iterator[None]:
    """The block may open connections."""
    _limit_files(None)
    try:
        yield
    finally:
        freeze_connections()


def _limit_files(soft: int | None) -> None:
    try:
        import resource
    except ImportError:  # Windows: there is no such limit, and the parent's deadline alone ends a repeated command
        return
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, hard) if soft is None else soft, hard))


class Robot:
    """ur_rtde's two clients, as far as they are needed.

    Args:
        host: IPv4 address.
        frequency_hz: of the readings.
        flags: for ur_rtde's control client.
    """

    def __init__(self, host: str, frequency_hz: float, flags: int) -> None:
        self._host, self._frequency_hz, self._flags = host, frequency_hz, flags
        self._receive: Any = None
        self._control: Any = None
        self._floor_s: float | None = None
        self._floor_at_s = self._seen_s = 0.0
        self._last_timestamp = -1.0
        self._operation = -1
        self._commanded_s = self._kicked_s = 0.0
        self.motion_ends_s: float | None = None

    def connect(self) -> dict[str, object]:
        """Open the reading client."""
        with connections_allowed():
            import rtde_control  # noqa: F401 - now, while files can be opened
            from rtde_receive import RTDEReceiveInterface

            upper = bool(self._flags & 8)
            self._receive = RTDEReceiveInterface(self._host, self._frequency_hz, [], False, upper)
        return {}

    def control(self) -> dict[str, object]:
        """Open the commanding client, which puts its script on the controller."""
        from rtde_control import RTDEControlInterface

        if self._control is None:
            with connections_allowed():
                self._control = RTDEControlInterface(self._host, self._frequency_hz, self._flags)
            if not self._control.setWatchdog(_WATCHDOG_HZ):
                raise Failure("refused", "the RTDE watchdog was not set")
        return {}

    def kick(self) -> None:
        """Tell the controller's watchdog, when it is time, that somebody is here."""
        now_s = time.monotonic()
        if self._control is not None and now_s - self._kicked_s >= _KICK_S and self._control.isConnected():
            self._control.kickWatchdog()
            self._kicked_s = now_s

    def state(self) -> dict[str, object]:
        """A reading whose timestamp appeared while it was waited for."""
        receive = self._linked()
        began_s = time.monotonic()
        self._last_timestamp = float(receive.getTimestamp())
        while True:
            timestamp = self._next_timestamp(receive, began_s + _PATIENCE_S)
            reading = self._values(receive)
            late_s = self._late_s(timestamp)
            fresh = time.monotonic() - self._seen_s + late_s <= _FRESH_S
            if receive.getTimestamp() == timestamp and fresh:
                break
            if time.monotonic() - began_s > _PATIENCE_S:
                raise Failure("stale", f"the newest reading is {time.monotonic() - self._seen_s + late_s:.2f} s old")
        if not reading["moving"]:
            self.motion_ends_s = None
        return {**reading, "at_s": self._seen_s - late_s, "controller_s": timestamp}

    def move(self, q: list[float], speed: float, acceleration: float, deadline_s: float) -> dict[str, object]:
        """Start a motion."""
        control = self._commandable()
        if self._moving(self._values(self._linked())):
            raise Failure("busy", "a motion is still under way")
        self._operation, self._commanded_s = control.getAsyncOperationProgressEx().operationId(), time.monotonic()
        self.motion_ends_s = self._commanded_s + deadline_s
        if not control.moveJ(q, speed, acceleration, True):
            self.motion_ends_s, self._commanded_s = None, 0.0
            raise Failure("refused", "moveJ was not carried out")
        return {}

    def stop(self) -> dict[str, object]:
        """Stop the motion, the program goes on."""
        self.motion_ends_s, self._commanded_s = None, 0.0
        if self._control is None:
            raise Failure("no_control", "nothing was commanded")
        control = self._commandable()
        control.stopJ(_STOP_RAD_S2)  # gives no result
        until_s = time.monotonic() + _STANDS_WITHIN_S
        while control.getAsyncOperationProgressEx().isAsyncOperationRunning():
            if time.monotonic() > until_s:
                raise Failure("refused", "stopJ was not carried out")
            time.sleep(_LOOK_S)
        return {}

    def freedrive(self, on: bool) -> dict[str, object]:
        """Let the arm be led by hand, or hold it."""
        control = self._commandable()
        self.motion_ends_s = None
        if not (control.teachMode() if on else control.endTeachMode()):
            raise Failure("refused", "freedrive was not switched")
        return {}

    def leave(self) -> None:
        """Stop the arm and end the script on the controller, as far as the link allows."""
        if self._control is None or not self._control.isConnected():
            return
        if self._values(self._receive)["runtime"] == _PLAYING:
            self._control.stopJ(_STOP_RAD_S2)
            self._control.stopScript()

    def give_up_motion(self) -> None:
        """Its deadline is over: stop it."""
        if self._control is not None and self._moving(self._values(self._linked())):
            self._control.stopJ(_STOP_RAD_S2)
        self.motion_ends_s = None

    def _linked(self) -> Any:
        if self._receive is None or not self._receive.isConnected():
            raise Failure("lost", "the reading link is down")
        if self._control is not None and not self._control.isConnected():
            raise Failure("lost", "the commanding link is down")
        return self._receive

    def _commandable(self) -> Any:
        self._linked()
        if self._control is None:
            raise Failure("no_control", "the commanding client is not open")
        return self._control

    def _next_timestamp(self, receive: Any, until_s: float) -> float:
        first = self._last_timestamp
        while True:
            timestamp = float(receive.getTimestamp())
            now_s = time.monotonic()
            if timestamp not in (first, 0.0):
                self._last_timestamp, self._seen_s = timestamp, now_s
                time.sleep(_SETTLE_S)
                return timestamp
            self._linked()
            if now_s > until_s:
                raise Failure("stale", f"no new reading for {now_s - (self._seen_s or until_s - _PATIENCE_S):.2f} s")
            time.sleep(_LOOK_S)

    def _late_s(self, timestamp: float) -> float:
        """How much later than the quickest ones this reading came: data that waited in a buffer."""
        offset_s, now_s = self._seen_s - timestamp, self._seen_s
        floor_s = offset_s if self._floor_s is None else min(offset_s, self._floor_s + _CLOCK_DRIFT * (now_s - self._floor_at_s))
        self._floor_s, self._floor_at_s = floor_s, now_s
        return offset_s - floor_s

    def _values(self, receive: Any) -> dict[str, Any]:
        values: dict[str, Any] = {
            "q": receive.getActualQ(),
            "qd": receive.getActualQd(),
            "pose": receive.getActualTCPPose(),
            "safety_mode": receive.getSafetyMode(),
            "robot_mode": receive.getRobotMode(),
            "runtime": receive.getRuntimeState(),
            "controlled": self._control is not None,
        }
        values["moving"] = self._moving(values)
        return values

    def _moving(self, values: dict[str, Any]) -> bool:
        if max((abs(speed) for speed in values["qd"]), default=0.0) > _STILL_RAD_S:
            return True
        if self._control is None or values["runtime"] != _PLAYING or not self._commanded_s:
            return False
        status = self._control.getAsyncOperationProgressEx()
        if status.operationId() == self._operation:
            return time.monotonic() - self._commanded_s < _STARTS_WITHIN_S
        return bool(status.isAsyncOperationRunning())


def serve(robot: Robot, requests: int, replies: int) -> None:
    """Answer requests until their end."""
    buffer = b""
    while True:
        if b"\n" not in buffer:
            ready, _, _ = select.select([requests], [], [], _POLL_S)
            robot.kick()
            if robot.motion_ends_s is not None and time.monotonic() > robot.motion_ends_s:
                robot.give_up_motion()
            if ready:
                data = os.read(requests, 65536)
                if not data:
                    return
                buffer += data
            continue
        line, _, buffer = buffer.partition(b"\n")
        os.write(replies, json.dumps(answer(robot, line)).encode() + b"\n")
        robot.kick()


def answer(robot: Robot, line: bytes) -> dict[str, object]:
    """The reply to one request, with its number: a parent that was interrupted while it waited finds old replies before its own."""
    number: object = None
    try:
        request = json.loads(line)
        number = request.pop("number", None)
        actions: dict[str, Callable[..., dict[str, object]]] = {
            "connect": robot.connect,
            "control": robot.control,
            "state": robot.state,
            "move": robot.move,
            "stop": robot.stop,
            "freedrive": robot.freedrive,
        }
        return {"number": number, "ok": True, **actions[request.pop("do")](**request)}
    except Failure as failure:
        return {"number": number, "ok": False, "kind": failure.kind, "text": str(failure)}
    except Exception as error:  # whatever the client throws has to reach the parent
        return {"number": number, "ok": False, "kind": "exception", "text": f"{type(error).__name__}: {error}"}


def main() -> None:
    """Serve the parent at standard input and output; what ur_rtde prints goes to standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    replies = os.dup(1)
    os.dup2(2, 1)
    robot = Robot(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))
    freeze_connections()
    try:
        serve(robot, 0, replies)
        # the last calls may block, and so may ur_rtde's destructors
        last = threading.Timer(_LEAVE_S, os._exit, args=(1,))
        last.daemon = True
        last.start()
        robot.leave()
    finally:
        os._exit(0)


if __name__ == "__main__":
    main()
