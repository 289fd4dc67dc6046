"""The side of the line protocol that answers: one answer to one request, the same words to a repeated one."""

from __future__ import annotations

from collections.abc import Callable

from drivers.abb.protocol import ANSWERS, ARGUMENTS, BadLine, Code, Fault, Line, Verb, decode, encode

FAULT_TEXTS = {
    Fault.CHECKSUM: "checksum",
    Fault.SYNTAX: "syntax",
    Fault.VERB: "unknown verb",
    Fault.EPOCH: "another epoch",
    Fault.TOKEN: "no such target",
    Fault.EXPIRED: "target expired",
    Fault.BUSY: "moving",
    Fault.SPEED: "speed",
    Fault.NUMBER: "number used for another request",
    Fault.NOT_READY: "not ready",
}


class Declined(Exception):
    """A request that is answered by an error; raised by what carries requests out."""

    def __init__(self, fault: Fault, text: str | None = None) -> None:
        super().__init__()
        self.fault = fault
        self.text = text or FAULT_TEXTS[fault]


class Answerer:
    """Answers lines; `do` carries a request out, once, and gives the arguments of its reply.

    Args:
        do: raises Declined, BadLine or ValueError for what it does not do.
        verbs: what is answered at all.
    """

    def __init__(self, do: Callable[[Line], tuple[str, ...]], verbs: tuple[Verb, ...]) -> None:
        self._do, self._verbs = do, verbs
        self._last: tuple[bytes, bytes] | None = None

    def forget(self) -> None:
        """A new conversation begins."""
        self._last = None

    def answer(self, data: bytes) -> bytes:
        """The reply to a line without its line feed; never raises for what came over the line."""
        data = data.removesuffix(b"\r")
        try:
            line = decode(data)
        except BadLine:
            return _error(0, Fault.CHECKSUM, FAULT_TEXTS[Fault.CHECKSUM])
        if line.word == Verb.HELLO:
            self.forget()
        if self._last is not None and self._last[0] == data:
            return self._last[1]
        if self._last is not None and self._last[0][:4] == data[:4]:
            return _error(line.number, Fault.NUMBER, FAULT_TEXTS[Fault.NUMBER])
        reply = self._reply(line)
        self._last = (data, reply)
        return reply

    def _reply(self, line: Line) -> bytes:
        verb = next((verb for verb in self._verbs if verb == line.word), None)
        if verb is None:
            return _error(line.number, Fault.VERB, FAULT_TEXTS[Fault.VERB])
        try:
            if len(line.arguments) != ARGUMENTS[verb]:
                raise Declined(Fault.SYNTAX)
            return encode(line.number, ANSWERS[verb], *self._do(line))
        except Declined as no:
            return _error(line.number, no.fault, no.text)
        except (BadLine, ValueError):
            return _error(line.number, Fault.SYNTAX, FAULT_TEXTS[Fault.SYNTAX])


def _error(number: int, fault: Fault, text: str) -> bytes:
    return encode(number, Code.ERROR, str(int(fault)), *text.split())
