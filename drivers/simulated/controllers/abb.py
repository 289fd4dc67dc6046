"""A simulated IRC5: the line server of `spherecal.mod` over TCP and a pty, the second program's port, faults and a bench.

    5000   the program that moves (one client at a time, as in RAPID)
    5001   spherecal_state.mod: state alone, also while the first program is held
    bench  drivers.simulated.controllers.bench

While the robot moves, requests are looked at every 0.1 s, as TRAP SphPoll does.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from dataclasses import dataclass, field

from drivers.abb.protocol import Code, LineBuffer, decode, encode, state_arguments
from drivers.errors import SettingsError
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.abb_faults import BUTTONS, WIRE_FAULTS, WireFault, press
from drivers.simulated.controllers.abb_program import AbbProgram, Identity
from drivers.simulated.controllers.bench import BENCH_PORT, BenchServer, axes_text
from drivers.simulated.controllers.holes import BlackHole

POLL_S = 0.1
LINGER_S = 0.05
_TICK_S = 0.02
_STALE_S = 0.08


@dataclass(slots=True)
class _Wire:
    """One connection, or the pty."""

    descriptor: int
    connection: socket.socket | None
    buffer: LineBuffer = field(default_factory=LineBuffer)
    awake_until_s: float = 0.0

    def send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            if self.connection is not None:
                self.connection.send(data)
            else:
                os.write(self.descriptor, data)


class AbbController:
    """The whole controller; `start` serves in threads until `close`.

    Args:
        cell: the robot; its clock is instant, and goes on with real time.
        host: a loopback address.
        port: of the program that moves; 0 for any free one.
        state_port: of the second program; None for port + 1, or any free one.
        bench_port: 0 for any free one.
        with_pty: whether to offer a serial line, too.
        identity: what it says it is.
        speed_up: how much faster than real the robot moves.

    Raises:
        SettingsError: no loopback address, or a port that is taken.
    """

    def __init__(
        self,
        cell: SimulatedCell,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        state_port: int | None = None,
        bench_port: int = BENCH_PORT,
        with_pty: bool = True,
        identity: Identity | None = None,
        speed_up: float = 1.0,
    ) -> None:
        if not host.startswith("127."):
            remedy = "Simulated controllers serve 127.0.0.1 to 127.255.255.254 only."
            raise SettingsError(f"{host} is no loopback address", where="--host", remedy=remedy)
        self.program = AbbProgram(cell, time.monotonic, identity, speed_up)
        self.host = host
        self._lock = threading.RLock()
        self._fault = WireFault()
        self._main = _Listener(host, port)
        self._second = _Listener(host, state_port if state_port is not None else (port + 1 if port else 0))
        self._pty = os.openpty() if with_pty else None
        self.serial_port: str | None = None
        if self._pty is not None:
            for end in self._pty:
                tty.setraw(end)
            os.set_blocking(self._pty[0], False)
            self.serial_port = os.ttyname(self._pty[1])
        self._bench = BenchServer(host, bench_port, self._bench_answer)
        self._ends = threading.Event()
        self._drop_at_s: float | None = None
        self._threads = [threading.Thread(target=target, name=target.__name__, daemon=True) for target in (self._serve_main, self._serve_second)]

    @property
    def port(self) -> int:
        """Port of the program that moves."""
        return self._main.port

    @property
    def state_port(self) -> int:
        """Port of the second program."""
        return self._second.port

    @property
    def bench_port(self) -> int:
        """Port of the bench."""
        return self._bench.port

    @property
    def ended(self) -> threading.Event:
        """Set when somebody asked the bench to quit."""
        return self._ends

    def start(self) -> None:
        """Serve from now on."""
        self._bench.start()
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Serve no longer; safe to call twice."""
        if self._ends.is_set() and not any(thread.is_alive() for thread in self._threads):
            return
        self._ends.set()
        for thread in self._threads:
            thread.join()
        self._bench.close()
        for listener in (self._main, self._second):
            listener.close()
        for end in self._pty or ():
            os.close(end)

    def fault(self, name: str, argument: str | None = None) -> None:
        """Misbehave from now on, or press a button.

        Raises:
            ValueError: no such fault.
        """
        with self._lock:
            if name in BUTTONS:
                press(self.program, name)
                if name == "restart":
                    self._main.drop()  # RAPID closes its sockets when the program pointer is moved
                return
            if name == "drop":
                self._main.drop()
                self.program.link_lost()
                return
            self._fault.set(name, argument)
            if name == "refuse":
                self._main.close()
                self.program.link_lost()
            elif name == "black_hole":
                self._main.swallow()

    def clear(self) -> None:
        """Behave again: end the fault of the line, reset a stop, start the program where it was held."""
        with self._lock:
            self._fault.clear()
            self._drop_at_s = None
            self._main.listen()
            self.program.press_start()

    def n_motions(self) -> int:
        """How many motions the program has begun."""
        with self._lock:
            return self.program.n_motions

    def _bench_answer(self, request: str) -> str:
        verb, *words = request.split()
        if verb == "axes":
            with self._lock:
                return axes_text(self.program.cell.axes())
        if verb == "fault" and words:
            self.fault(words[0], words[1] if len(words) > 1 else None)
        elif verb == "clear":
            self.clear()
        elif verb == "faults":
            return ", ".join((*WIRE_FAULTS, *BUTTONS))
        elif verb == "motions":
            return str(self.n_motions())
        elif verb == "quit":
            self._ends.set()
        else:
            msg = f"{request!r} is none of axes, fault, clear, faults, motions, quit"
            raise ValueError(msg)
        return ""

    def _serve_main(self) -> None:
        serial = None if self._pty is None else _Wire(self._pty[0], None)
        while not self._ends.is_set():
            self._serve_once(self._main, serial)
            with self._lock:
                self.program.tick()
                if self._drop_at_s is not None and time.monotonic() > self._drop_at_s:
                    self._drop_at_s = None
                    self._main.drop()
                    self.program.link_lost()

    def _serve_once(self, listener: _Listener, serial: _Wire | None) -> None:
        with self._lock:
            listener.accept()
            wires = [wire for wire in (listener.wire, serial) if wire is not None]
            held = self.program.held
        if held:  # a held RAPID task reads nothing
            time.sleep(_TICK_S)
            return
        try:
            ready = select.select([wire.descriptor for wire in wires], [], [], _TICK_S)[0] if wires else self._ends.wait(_TICK_S) and []
        except (OSError, ValueError):
            return
        for wire in wires:
            if ready and wire.descriptor in ready:
                self._wait_for_the_trap(wire)
                self._serve_wire(listener, wire)

    def _wait_for_the_trap(self, wire: _Wire) -> None:
        now_s = time.monotonic()
        if self.program.moving and now_s > wire.awake_until_s:
            time.sleep(POLL_S - now_s % POLL_S)

    def _serve_wire(self, listener: _Listener, wire: _Wire) -> None:
        try:
            data = os.read(wire.descriptor, 4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        with self._lock:
            if not data:
                if wire.connection is not None:
                    listener.drop()
                    self.program.link_lost()
                return
            if self.program.held or self._fault.name in {"silence", "black_hole"}:
                return
            for line in wire.buffer.feed(data):
                moved = self.program.n_motions
                reply = self.program.answer(line.removesuffix(b"\r"))
                if self.program.n_motions > moved and self._fault.take("drop_mid_move"):
                    self._drop_at_s = time.monotonic() + 0.2
                with contextlib.suppress(OSError):
                    self._send(wire, reply)
        wire.awake_until_s = time.monotonic() + LINGER_S

    def _send(self, wire: _Wire, reply: bytes) -> None:
        """A reply, as the fault in force leaves it."""
        fault = self._fault
        if fault.take("slow"):
            time.sleep(fault.seconds)
        if fault.name == "stale" and decode(reply[:-1]).word == Code.STATE:
            time.sleep(_STALE_S)
        if fault.take("lost_replies"):
            return
        if fault.take("garbage"):
            reply = bytes(range(128, 200)) + b"\n"
        elif fault.take("half_lines"):
            reply = reply[: len(reply) // 2]
        elif fault.take("wrong_checksum"):
            reply = reply[:-3] + (b"00" if reply[-3:-1] != b"00" else b"01") + b"\n"
        elif fault.take("doubled_replies"):
            reply = reply * 2
        elif fault.take("two_halves"):
            wire.send(reply[:7])
            time.sleep(0.01)
            reply = reply[7:]
        wire.send(reply)

    def _serve_second(self) -> None:
        while not self._ends.is_set():
            with self._lock:
                self._second.accept()
                wire = self._second.wire
            if wire is None:
                time.sleep(_TICK_S)
                continue
            if not select.select([wire.descriptor], [], [], _TICK_S)[0]:
                continue
            try:
                data = os.read(wire.descriptor, 4096)
            except OSError:
                data = b""
            with self._lock, contextlib.suppress(OSError):
                if not data:
                    self._second.drop()
                for line in wire.buffer.feed(data):
                    wire.send(self._second_answer(line))

    def _second_answer(self, data: bytes) -> bytes:
        number = data[:4].decode("ascii", "replace")
        state = self.program.state(seen_from_outside=True)
        return encode(int(number) if number.isdigit() else 0, Code.STATE, *state_arguments(state))


class _Listener:
    """A port that serves one connection at a time."""

    def __init__(self, host: str, port: int) -> None:
        self._host = host
        self._socket: socket.socket | None = None
        self._hole: BlackHole | None = None
        self.wire: _Wire | None = None
        self.port = port
        self.listen()

    def listen(self) -> None:
        """Listen again where it had ended, or was a black hole."""
        if self._socket is not None:
            return
        self._close_listening()
        listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((self._host, self.port))
        except OSError as error:
            listening.close()
            remedy = "Choose another address with --host (127.0.0.2 to 127.0.0.254) or another port."
            raise SettingsError(f"{self._host}:{self.port} cannot be listened on ({error.strerror})", remedy=remedy) from error
        listening.listen()
        listening.setblocking(False)
        self._socket, self.port = listening, listening.getsockname()[1]

    def swallow(self) -> None:
        """Become a black hole; the open connection stays."""
        self._close_listening()
        self._hole = BlackHole(self._host, self.port)

    def accept(self) -> None:
        """Take a waiting connection, if there is none yet."""
        if self._socket is None or self.wire is not None:
            return
        with contextlib.suppress(BlockingIOError):
            connection, _ = self._socket.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.wire = _Wire(connection.fileno(), connection)

    def drop(self) -> None:
        """Cut the connection."""
        wire, self.wire = self.wire, None
        if wire is not None and wire.connection is not None:
            wire.connection.close()

    def close(self) -> None:
        """Cut the connection and listen no longer: connections are refused."""
        self.drop()
        self._close_listening()

    def _close_listening(self) -> None:
        if self._hole is not None:
            self._hole.close()
            self._hole = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None
