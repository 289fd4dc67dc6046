"""One RTDE connection of the simulated controller: recipes in both directions, and the data that flows by them."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain

from drivers.simulated.controllers.ur.machine import Machine
from drivers.simulated.controllers.ur.readings import output
from drivers.simulated.controllers.ur.variables import Value, input_type, output_type, packer, widths
from drivers.ur import wire

VERSION = (5, 11, 1, 108318)
_NOT_FOUND, _IN_USE = "NOT_FOUND", "IN_USE"


@dataclass(frozen=True, slots=True)
class Recipe:
    """Variables that travel together."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    packed: struct.Struct

    @classmethod
    def of(cls, names: Sequence[str], kinds: Sequence[str]) -> Recipe:
        """The recipe of names and their types."""
        return cls(tuple(names), tuple(kinds), packer(kinds))

    def pack(self, machine: Machine) -> bytes:
        """The values now."""
        values = (output(machine, name) for name in self.names)
        return self.packed.pack(*chain.from_iterable([value] if isinstance(value, int | float) else value for value in values))

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """Values by name; a payload of the wrong length is ignored, as the real controller does."""
        if len(payload) != self.packed.size:
            return {}
        numbers = iter(self.packed.unpack(payload))
        taken = ([next(numbers) for _ in range(width)] for width in widths(self.kinds))
        return {name: values[0] if len(values) == 1 else values for name, values in zip(self.names, taken, strict=True)}


@dataclass(slots=True, eq=False)
class RtdeSession:
    """State of one connection.

    Args:
        machine: the controller.
        send: writes bytes to the client.
        claimed: input variables that this or other connections hold; shared by all of them.
    """

    machine: Machine
    send: Callable[[bytes], None]
    claimed: dict[str, object]
    period_s: float = 0.008
    started: bool = False
    due_s: float = 0.0
    frozen_s: float | None = None
    """Timestamp that is sent again and again, where the data is made stale."""
    _stream: wire.RtdeStream = field(default_factory=wire.RtdeStream)
    _out: Recipe | None = None
    _in: list[Recipe] = field(default_factory=list)

    def receive(self, data: bytes) -> None:
        """Take bytes of the client and answer them.

        Raises:
            WireError: they are no RTDE; the connection has to be closed.
        """
        for kind, payload in self._stream.feed(data):
            self._handle(kind, payload)

    def release(self) -> None:
        """Give back the input variables of this connection."""
        for name in [name for name, owner in self.claimed.items() if owner is self]:
            del self.claimed[name]

    def data(self) -> bytes:
        """A data package with the values now."""
        if self._out is None:
            return b""
        now_s = self.machine.timestamp_s
        if self.frozen_s is not None:
            self.machine.timestamp_s = self.frozen_s
        payload = b"\x01" + self._out.pack(self.machine)
        self.machine.timestamp_s = now_s
        return wire.package(wire.DATA_PACKAGE, payload)

    def _handle(self, kind: int, payload: bytes) -> None:
        match kind:
            case wire.REQUEST_PROTOCOL_VERSION:
                self._reply(kind, bytes([int(payload == struct.pack(">H", wire.PROTOCOL_VERSION))]))
            case wire.GET_URCONTROL_VERSION:
                self._reply(kind, struct.pack(">4I", *VERSION))
            case wire.SETUP_OUTPUTS:
                self._reply(kind, self._setup_outputs(payload))
            case wire.SETUP_INPUTS:
                self._reply(kind, self._setup_inputs(payload))
            case wire.START | wire.PAUSE:
                self.started = kind == wire.START and self._out is not None
                self._reply(kind, bytes([int(self.started or kind == wire.PAUSE)]))
            case wire.DATA_PACKAGE if payload and 1 <= payload[0] <= len(self._in):
                self.machine.write_inputs(self._in[payload[0] - 1].unpack(payload[1:]))
            case _:
                pass

    def _reply(self, kind: int, payload: bytes) -> None:
        self.send(wire.package(kind, payload))

    def _setup_outputs(self, payload: bytes) -> bytes:
        if len(payload) < 8:
            return b"\x00"
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = _names(payload[8:])
        kinds = [output_type(name) or _NOT_FOUND for name in names]
        if 1 <= frequency_hz <= 500 and _NOT_FOUND not in kinds:
            self.period_s = 1 / frequency_hz
            self._out = Recipe.of(names, kinds)
        return bytes([int(self._out is not None)]) + ",".join(kinds).encode()

    def _setup_inputs(self, payload: bytes) -> bytes:
        names = _names(payload)
        kinds = [self._claim(name) for name in names]
        good = not {_NOT_FOUND, _IN_USE} & set(kinds)
        if good:
            self._in.append(Recipe.of(names, kinds))
        return bytes([len(self._in) if good else 0]) + ",".join(kinds).encode()

    def _claim(self, name: str) -> str:
        kind = input_type(name)
        if kind is None:
            return _NOT_FOUND
        return kind if self.claimed.setdefault(name, self) is self else _IN_USE


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii", "replace").split(",") if name]
