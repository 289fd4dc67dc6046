"""A simulated UR controller in a process of its own, as a user starts it, at a loopback address of its own."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.simulated.controllers.bench import BenchClient

_STARTS_WITHIN_S = 30.0


def own_address(of_ten: int = 0) -> str:
    """A loopback address that no other test process uses at the same time: ten for each worker of pytest-xdist."""
    worker = int("".join(c for c in os.environ.get("PYTEST_XDIST_WORKER", "0") if c.isdigit()) or 0)
    return f"127.0.{40 + worker}.{10 + of_ten}"


@dataclass(frozen=True, slots=True)
class FakeUr:
    """A running controller."""

    host: str
    process: subprocess.Popen[bytes]

    @property
    def bench(self) -> BenchClient:
        """Where faults are asked for."""
        return BenchClient(self.host)

    def fault(self, text: str) -> None:
        """Misbehave."""
        self.bench.ask(f"fault {text}")

    def clear(self) -> None:
        """Behave again, as after an operator has mended everything."""
        self.bench.ask("clear")

    def n_motions(self) -> int:
        """How many motions the controller has begun."""
        return self.bench.axes().n_motions


@contextmanager
def fake_ur(host: str, *options: str, speed_up: float = 1.0) -> Iterator[FakeUr]:
    """Start a controller, and end it however the block ends; it also ends with this process."""
    script = [sys.executable, "-c", "from measure.cli import main; main()", "simulate-controller", "ur"]
    command: Sequence[str] = [*script, "--host", host, "--speed-up", str(speed_up), "--until-eof", *options]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        _wait_until_ready(process)
        yield FakeUr(host, process)
    finally:
        if process.stdin is not None:
            process.stdin.close()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stderr is not None:
            process.stderr.close()


def _wait_until_ready(process: subprocess.Popen[bytes]) -> None:
    if process.stderr is None:
        raise ValueError
    until_s = time.monotonic() + _STARTS_WITHIN_S
    said = b""
    while b"bench at" not in said:
        ready, _, _ = select.select([process.stderr], [], [], max(until_s - time.monotonic(), 0))
        data = os.read(process.stderr.fileno(), 4096) if ready else b""
        said += data
        if not data:
            process.kill()
            message = f"the simulated controller did not start: {said.decode()}"
            raise RuntimeError(message)
