"""The simulated UR controller on its ports. One thread serves everything; the bench has its own and asks this one.

    29999  dashboard            30001, 30002  primary and secondary interface (state; scripts are taken, too)
    30004  RTDE                 30003         scripts
    29900  the bench (drivers.simulated.controllers.bench), which alone may have another port

The other ports are fixed in the real clients, so every controller has a loopback address of its own.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from concurrent.futures import Future

from drivers.errors import SettingsError
from drivers.simulated.controllers.bench import BenchServer, axes_text
from drivers.simulated.controllers.holes import BlackHole
from drivers.simulated.controllers.ur import primary
from drivers.simulated.controllers.ur.connections import Connection, DashboardConnection, PrimaryConnection, RtdeConnection, ScriptConnection
from drivers.simulated.controllers.ur.faults import BUTTONS, WIRE_FAULTS, LineState, press
from drivers.simulated.controllers.ur.machine import Machine, RobotMode

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, PRIMARY_PORTS = 30004, 29999, 30003, (30001, 30002)
_SLOWEST_CYCLE_S, _PRIMARY_PERIOD_S = 0.008, 0.1
_DROP_AFTER_S = 0.1
_BENCH_TIMEOUT_S = 5.0


class UrController:
    """The whole controller; `run` serves until `quit` or cancelled.

    Args:
        machine: its inside.
        host: a loopback address of its own.
        bench_port: 0 for any free one.
    """

    def __init__(self, machine: Machine, host: str, *, bench_port: int) -> None:
        self.machine, self.host = machine, host
        self.line = LineState()
        self.connections: set[Connection] = set()
        self.claimed: dict[str, object] = {}
        self._servers: list[asyncio.Server] = []
        self._holes: list[BlackHole] = []
        self._bench_port = bench_port
        self._loop: asyncio.AbstractEventLoop | None = None
        self._quit = asyncio.Event()
        self._returns: asyncio.TimerHandle | None = None
        self._n_motions = 0

    @property
    def bench_port(self) -> int:
        """Port of the bench, the real one once the controller serves."""
        return self._bench_port

    async def run(self, tell: Callable[[str], None], faults: Sequence[str] = ()) -> None:
        """Serve; `tell` is given one line when the ports are open and the faults in force.

        Raises:
            SettingsError: a port is taken, or there is no such fault.
        """
        self._loop = asyncio.get_running_loop()
        with contextlib.ExitStack() as stack:
            stack.callback(self._vanish)
            await self._listen()
            bench = self._open_bench()
            stack.callback(bench.close)
            cycles = asyncio.create_task(self._cycles())
            stack.callback(cycles.cancel)
            await self._misbehave(faults)
            tell(f"simulated UR controller at {self.host}, bench at {self.host}:{self._bench_port}")
            await self._quit.wait()

    async def _misbehave(self, faults: Sequence[str]) -> None:
        try:
            for name, *numbers in (text.split() for text in faults):
                await self._fault(name, [float(number) for number in numbers])
        except ValueError as error:
            raise SettingsError(str(error), where="--fault", remedy="Name one of them, with its numbers.") from error

    def _open_bench(self) -> BenchServer:
        try:
            bench = BenchServer(self.host, self._bench_port, self._ask)
        except OSError as error:
            raise _taken(self._bench_port, self.host, error) from error
        self._bench_port = bench.port
        bench.start()
        return bench

    def stop(self) -> None:
        """Let `run` end."""
        self._quit.set()

    async def _listen(self) -> None:
        loop = asyncio.get_running_loop()
        kinds = {RTDE_PORT: RtdeConnection, DASHBOARD_PORT: DashboardConnection, SCRIPT_PORT: ScriptConnection}
        for port in (*kinds, *PRIMARY_PORTS):
            kind = kinds.get(port, PrimaryConnection)
            try:
                self._servers.append(await loop.create_server(lambda kind=kind: kind(self), self.host, port))  # type: ignore[misc]
            except OSError as error:
                raise _taken(port, self.host, error) from error

    def _vanish(self) -> None:
        """No listener, no connection."""
        for server in self._servers:
            server.close()
        for hole in self._holes:
            hole.close()
        self._servers, self._holes = [], []
        for connection in list(self.connections):
            if connection.transport is not None:
                connection.transport.abort()

    async def _cycles(self) -> None:
        loop = asyncio.get_running_loop()
        last_s, primary_s = loop.time(), 0.0
        while True:
            await asyncio.sleep(max(0.0, last_s + self._period_s() - loop.time()))
            now_s = loop.time()
            self.machine.cycle(max(now_s - last_s, 1e-6))
            last_s = now_s
            self._drop_at_motion()
            for connection in list(self.connections):
                if isinstance(connection, RtdeConnection):
                    connection.send_data(now_s)
                elif isinstance(connection, PrimaryConnection) and now_s - primary_s >= _PRIMARY_PERIOD_S:
                    connection.answer(primary.robot_state(self.machine))
            if now_s - primary_s >= _PRIMARY_PERIOD_S:
                primary_s = now_s
            if self.line.half:
                self.line.half, self.line.silent = False, True

    def _period_s(self) -> float:
        periods = [c.session.period_s for c in self.connections if isinstance(c, RtdeConnection) and c.session.started]
        return min([*periods, _SLOWEST_CYCLE_S])

    def _drop_at_motion(self) -> None:
        count = self.machine.cell.axes().n_motions
        after_s = self.line.drop_after_s
        if after_s is not None and count > self._n_motions:
            self.line.drop_after_s = None
            if after_s:
                asyncio.get_running_loop().call_later(after_s, self._drop)
            else:
                self._drop()
        self._n_motions = count

    def _drop(self, *, commanding_only: bool = False) -> None:
        for connection in list(self.connections):
            if isinstance(connection, RtdeConnection) and not (commanding_only and connection.session not in self.claimed.values()):
                connection.drop()

    def _ask(self, line: str) -> str:
        """A request of the bench, in the bench's thread."""
        if self._loop is None:
            msg = "not serving"
            raise ValueError(msg)
        done: Future[str] = asyncio.run_coroutine_threadsafe(self._obey(line.split()), self._loop)
        return done.result(_BENCH_TIMEOUT_S)

    async def _obey(self, words: list[str]) -> str:
        match words:
            case ["axes"]:
                return axes_text(self.machine.cell.axes())
            case ["faults"]:
                return " ".join((*WIRE_FAULTS, *BUTTONS))
            case ["log"]:
                return "; ".join(self.machine.messages)
            case ["clear"]:
                await self._clear()
            case ["home"]:
                self.machine.end_program()
                self.machine.cell.reset()
            case ["quit"]:
                asyncio.get_running_loop().call_soon(self.stop)
            case ["fault", name, *rest]:
                await self._fault(name, [float(word) for word in rest])
            case _:
                msg = "axes, faults, fault NAME [NUMBERS], clear, home, log or quit"
                raise ValueError(msg)
        return ""

    async def _clear(self) -> None:
        self.line = LineState()
        for name in [name for name, owner in self.claimed.items() if owner == "fieldbus"]:
            del self.claimed[name]
        if self._returns is not None:
            self._returns.cancel()
            self._returns = None
        if not self._servers:
            self._vanish()
            await self._listen()
        press(self.machine, "mend", [])

    async def _fault(self, name: str, numbers: list[float]) -> None:
        line = self.line
        match name:
            case "refuse":
                self._vanish()
            case "black_hole":
                await self._swallow()
            case "silence" | "half_packets" | "fragments" | "stale" | "garbage" | "noise":
                setattr(line, {"silence": "silent", "half_packets": "half"}.get(name, name), True)
            case "drop" | "drop_commanding":
                self._drop(commanding_only=name == "drop_commanding")
            case "drop_mid_move" | "drop_at_command":
                line.drop_after_s = _DROP_AFTER_S if name == "drop_mid_move" else 0.0
            case "slow":
                line.slow_s = numbers[0] if numbers else 0.3
            case "lag":
                line.lag_s = numbers[0] if numbers else 0.2
            case "registers_taken":
                self.claimed.update((f"input_{kind}_register_{i}", "fieldbus") for kind in ("int", "double") for i in range(24))
            case "restart":
                self._restart(numbers[0] if numbers else 0.5)
            case _:
                press(self.machine, name, numbers)

    async def _swallow(self) -> None:
        """Nobody is refused, nobody is let in; those who are in hear nothing more."""
        self.line.silent = True
        for server in self._servers:
            server.close()
        self._servers = []
        await asyncio.sleep(0)
        self._holes = [BlackHole(self.host, port) for port in (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, *PRIMARY_PORTS)]

    def _restart(self, seconds: float) -> None:
        machine = self.machine
        self._vanish()
        machine.end_program()
        machine.inputs.clear()
        machine.outputs.clear()
        machine.timestamp_s, machine.mode = 0.0, RobotMode.POWER_OFF

        def back() -> None:
            self._returns = None
            task = asyncio.ensure_future(self._listen())
            task.add_done_callback(lambda done: None if done.cancelled() else done.exception())

        self._returns = asyncio.get_running_loop().call_later(seconds, back)


def _taken(port: int, host: str, error: OSError) -> SettingsError:
    remedy = "Choose another loopback address with --host, e.g. 127.0.0.3."
    return SettingsError(f"port {port} of {host} cannot be opened ({error.strerror})", where="--host", remedy=remedy)


def serve(controller: UrController, tell: Callable[[str], None], faults: Sequence[str] = ()) -> None:
    """Run a controller, misbehaving from the start where faults are named, until it is told to quit, or interrupted.

    Raises:
        SettingsError: a port is taken, or there is no such fault.
    """
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(controller.run(tell, faults))
