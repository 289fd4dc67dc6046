"""Room for a whole frame in the socket that Aravis receives a stream with, from its first packet on.

Aravis itself leaves the socket as the system makes it (208 KiB on Linux, about 90 packets) or, asked to, enlarges it when
the first packet is in: too late where a camera sends faster than this computer wakes up.
"""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Generator
from contextlib import closing
from pathlib import Path

_DESCRIPTORS = Path("/dev/fd")
_FORCE = 33
"""SO_RCVBUFFORCE of Linux: beyond net.core.rmem_max, for who may administer the network."""
_LARGEST = 256 * 1024 * 1024


def make_room(port: int, n_bytes: int) -> int | None:
    """Enlarge the receive buffer of this process's UDP socket at a port, as far as the system allows.

    Returns:
        Its size now; None where there is no such socket, or no way to find it.
    """
    wanted = min(n_bytes, _LARGEST)
    with closing(_own_datagram_sockets()) as channels:
        for channel in channels:
            if channel.getsockname()[1] == port:
                if channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < wanted:
                    _enlarge(channel, wanted)
                return channel.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return None


def _enlarge(channel: socket.socket, wanted: int) -> None:
    try:
        channel.setsockopt(socket.SOL_SOCKET, _FORCE, wanted)
    except OSError:
        channel.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)


def _own_datagram_sockets() -> Generator[socket.socket, None, None]:
    """Duplicates: closing one leaves the socket open."""
    for name in _listed():
        channel = _duplicate(int(name)) if name.isdecimal() else None
        if channel is not None:
            with channel:
                if channel.type is socket.SOCK_DGRAM and channel.family is socket.AF_INET:
                    yield channel


def _duplicate(descriptor: int) -> socket.socket | None:
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return None
        copy = os.dup(descriptor)
    except OSError:
        return None  # closed meanwhile
    try:
        return socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        return None


def _listed() -> list[str]:
    try:
        return os.listdir(_DESCRIPTORS)
    except OSError:
        return []
