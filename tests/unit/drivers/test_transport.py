"""TCP by name: however many addresses a name has and whoever keeps silent, the deadline is kept."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

from drivers.contract.checks import in_time
from drivers.errors import RobotNotReached, RobotTimeout
from drivers.simulated.controllers.holes import BlackHole
from drivers.transport import TcpLink
from tests.support.fake_ur import own_address

DEADLINE_S = 0.4
NAME = "robot.cell.example"


def known_as(monkeypatch: pytest.MonkeyPatch, *addresses: str, after_s: float = 0.0) -> None:
    """Let the name have these addresses."""
    real: Callable[..., list[Any]] = socket.getaddrinfo

    def look_up(host: str, *rest: object, **options: object) -> list[Any]:
        if host != NAME:
            return real(host, *rest, **options)
        time.sleep(after_s)
        return [entry for address in addresses for entry in real(address, *rest, **options)]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)


def test_black_holes_share_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    known_as(monkeypatch, own_address(4), own_address(5))
    with BlackHole(own_address(4)) as first, BlackHole(own_address(5), first.port):
        link = TcpLink(NAME, first.port)
        began_s = time.monotonic()
        with in_time(DEADLINE_S), pytest.raises(RobotTimeout):
            link.open(DEADLINE_S)
        assert time.monotonic() - began_s > 0.9 * DEADLINE_S  # both were tried


def test_the_second_address_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    known_as(monkeypatch, own_address(4), own_address(5))
    with socket.create_server((own_address(5), 0)) as listening, BlackHole(own_address(4), listening.getsockname()[1]) as hole:
        link = TcpLink(NAME, hole.port)
        link.open(DEADLINE_S)
        accepted, _ = listening.accept()
        link.write(b"there\n", DEADLINE_S)
        assert accepted.recv(16) == b"there\n"
        accepted.close()
        link.close()


def test_a_silent_name_server(monkeypatch: pytest.MonkeyPatch) -> None:
    known_as(monkeypatch, "127.0.0.1", after_s=3 * DEADLINE_S)
    with in_time(DEADLINE_S), pytest.raises(RobotNotReached, match="name server"):
        TcpLink(NAME, 5000).open(DEADLINE_S)


def test_an_address_of_version_6() -> None:
    try:
        listening = socket.create_server(("::1", 0), family=socket.AF_INET6)
    except OSError:
        pytest.skip("this computer has no IPv6 loopback")
    with listening:
        link = TcpLink("::1", listening.getsockname()[1])
        link.open(DEADLINE_S)
        link.close()
