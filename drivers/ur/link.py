"""The parent's side of the child process: one request, one reply, each with a deadline; a child that is late is killed."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
from collections import deque
from typing import Any

from drivers.errors import LinkLost, RobotTimeout
from drivers.ur.net import Deadline

_LAST_WORDS = 20
_QUIT_S = 2.0
_CHUNK = 65536
_REMEDY = "Look at the pendant and the network cable, then continue with --resume."


class Child:
    """A running child process with ur_rtde in it.

    Args:
        host: IPv4 address of the controller.
        frequency_hz: of its readings.
        flags: for ur_rtde's control client.
    """

    def __init__(self, host: str, frequency_hz: float, flags: int) -> None:
        command = [sys.executable, "-P", "-m", "drivers.ur.child", host, str(frequency_hz), str(flags)]
        # its own session: Ctrl-C at the terminal is for the parent, which stops the robot in good order
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        self._buffer = b""
        self._number = 0
        self._said: deque[str] = deque(maxlen=_LAST_WORDS)
        self._listener = threading.Thread(target=self._listen, name="ur_rtde's words", daemon=True)
        self._listener.start()

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return self._process.poll() is None

    @property
    def last_words(self) -> str:
        """What ur_rtde printed last: the only place where it gives reasons."""
        return self._said[-1] if self._said else ""

    def ask(self, what: str, deadline: Deadline, **arguments: object) -> dict[str, Any]:
        """The reply to a request.

        Raises:
            RobotTimeout: none in time; the child is dead then.
            LinkLost: the child has died, as ur_rtde does when its link breaks at a bad moment.
        """
        pipe = self._process.stdin
        self._number += 1
        try:
            if pipe is None or not self.alive:
                raise BrokenPipeError
            pipe.write(json.dumps({"do": what, "number": self._number, **arguments}).encode() + b"\n")
            while (reply := self._reply(what, deadline)).get("number") != self._number:
                pass  # of a request whose wait was interrupted (Ctrl-C)
            return reply
        except BrokenPipeError as error:
            self.kill()
            raise LinkLost(f"the link to the controller broke ({self.last_words or 'no reason given'})", remedy=_REMEDY) from error

    def close(self) -> None:
        """Let it stop the arm and leave; kill it when it does not."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_QUIT_S)
        self.kill()

    def kill(self) -> None:
        """End it now; the controller finds its connections closed."""
        self._process.kill()
        self._process.wait()
        self._listener.join(_QUIT_S)
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    def _reply(self, what: str, deadline: Deadline) -> dict[str, Any]:
        descriptor = self._process.stdout.fileno() if self._process.stdout is not None else -1
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([descriptor], [], [], deadline.left_s)
            if not ready:
                self.kill()
                raise RobotTimeout(f"the controller did not answer in time ({what})", remedy=_REMEDY)
            data = os.read(descriptor, _CHUNK)
            if not data:
                raise BrokenPipeError
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\n")
        try:
            reply: dict[str, Any] = json.loads(line)
        except ValueError:
            return {}  # the rest of a reply whose beginning was read when Ctrl-C came
        return reply

    def _listen(self) -> None:
        stream = self._process.stderr
        if stream is None:
            return
        try:
            for line in iter(stream.readline, b""):
                text = line.decode("utf-8", "replace").strip()
                if text:
                    self._said.append(text)
        except ValueError:
            return  # closed by `kill`
