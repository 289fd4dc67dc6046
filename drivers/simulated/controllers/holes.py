"""Addresses that swallow connections without an answer, as an unplugged controller does."""

from __future__ import annotations

import socket
from types import TracebackType
from typing import Self

_QUEUE = 1


class BlackHole:
    """A port at which no connection is refused and none succeeds, while the object lives.

    The accept queue is full, so Linux drops every further SYN: to a client it looks like a host that is not there.

    Args:
        host: a loopback address.
        port: 0 for any free one.
    """

    def __init__(self, host: str, port: int = 0) -> None:
        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.bind((host, port))
        self._listener.listen(0)
        self.host, self.port = self._listener.getsockname()
        self._fillers: list[socket.socket] = []
        for _ in range(_QUEUE + 1):
            filler = socket.socket()
            filler.setblocking(False)
            filler.connect_ex((self.host, self.port))
            self._fillers.append(filler)

    def __enter__(self) -> Self:
        """The hole itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Fill it in."""
        self.close()

    def close(self) -> None:
        """From now on connections are refused."""
        for filler in self._fillers:
            filler.close()
        self._listener.close()
