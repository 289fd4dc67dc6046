"""The bench of a simulated controller: one TCP port, lines of text, for what no real controller would do.

    axes                 where the axes truly are (JSON), for a simulated camera in another process
    fault NAME [ARGS]    misbehave from now on; `faults` lists the names of a controller
    clear                behave again
    quit                 end the process

Every request is one line, every answer one line: `ok ...` or `error ...`. A controller may add verbs.
"""

from __future__ import annotations

import json
import socket
import socketserver
import threading
from collections.abc import Callable
from dataclasses import asdict

from drivers.errors import CameraNotReached, SettingsError
from drivers.simulated.cell import Axes

BENCH_PORT = 29900
_TIMEOUT_S = 2.0
_LONGEST_LINE = 65536

Answer = Callable[[str], str]
"""Given the words of a request, the answer after `ok`; ValueError becomes `error`. Called from a thread of its own."""


def bench_address(address: str) -> tuple[str, int]:
    """Host and port of `HOST` or `HOST:PORT`.

    Raises:
        SettingsError: the port is no number.
    """
    host, _, port = address.partition(":")
    if not host or (port and not port.isdigit()):
        raise SettingsError(f"{address!r} is no address", where="controller", remedy="Write HOST or HOST:PORT, e.g. 127.0.0.2.")
    return host, int(port) if port else BENCH_PORT


def axes_text(axes: Axes) -> str:
    """Axes as one line of JSON; floats keep every bit."""
    return json.dumps(asdict(axes))


def axes_from_text(text: str) -> Axes:
    """The inverse of `axes_text`.

    Raises:
        ValueError: no such line.
    """
    from pydantic import TypeAdapter

    return TypeAdapter(Axes).validate_json(text)


class BenchServer:
    """Serves the bench in threads of its own until `close`.

    Args:
        host: a loopback address.
        port: 0 for any free one.
        answer: what the requests mean.
    """

    def __init__(self, host: str, port: int, answer: Answer) -> None:
        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                while line := self.rfile.readline(_LONGEST_LINE):
                    try:
                        text = f"ok {answer(line.decode('utf-8', 'replace').strip())}"
                    except ValueError as error:
                        text = f"error {error}"
                    self.wfile.write(text.replace("\n", " ").encode() + b"\n")

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = True

        self._server = Server((host, port), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="bench", daemon=True)

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self._server.server_address[1])

    def start(self) -> None:
        """Serve from now on."""
        self._thread.start()

    def close(self) -> None:
        """Serve no longer."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class BenchClient:
    """Asks a bench; connects for every request, so it outlives restarts of the controller."""

    def __init__(self, host: str, port: int = BENCH_PORT) -> None:
        self._address = (host, port)

    def ask(self, line: str, *, timeout_s: float = _TIMEOUT_S) -> str:
        """The answer after `ok`.

        Raises:
            SettingsError: the controller does not know the request.
            OSError: nobody is there, or no answer came in time.
        """
        with socket.create_connection(self._address, timeout_s) as link, link.makefile("rwb") as stream:
            stream.write(line.encode() + b"\n")
            stream.flush()
            word, _, rest = stream.readline(_LONGEST_LINE).decode().strip().partition(" ")
        if word != "ok":
            raise SettingsError(f"the simulated controller refuses {line!r}: {rest or 'no answer'}", remedy="Ask it for `faults`.")
        return rest

    def axes(self) -> Axes:
        """Where the axes truly are.

        Raises:
            CameraNotReached: the controller is gone (it carries the camera that asks).
        """
        try:
            return axes_from_text(self.ask("axes"))
        except (OSError, ValueError) as error:
            host, port = self._address
            remedy = f"Start it: spherecal simulate-controller ur --host {host} (or abb)."
            raise CameraNotReached(f"no simulated controller at {host}:{port} ({error})", remedy=remedy) from error
