"""A reader and an interpreter for the part of RAPID that the shipped modules use: their text is checked and executed.

It is stricter than a controller where that is cheap: identifiers must be declared and short, strings hold 80 characters,
`num` is single precision, routines get the number of arguments they have. It knows nothing of motion or of sockets:
the instructions of a controller are Python functions that a test gives.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

LONGEST_STRING = 80
LONGEST_NAME = 16
KEYWORDS = frozenset(
    [
        *("MODULE", "ENDMODULE", "PROC", "ENDPROC", "FUNC", "ENDFUNC", "TRAP", "ENDTRAP", "LOCAL", "TASK", "VAR", "PERS", "CONST", "INOUT"),
        *("IF", "THEN", "ELSEIF", "ELSE", "ENDIF", "WHILE", "DO", "ENDWHILE", "FOR", "FROM", "TO", "ENDFOR", "RETURN", "TRYNEXT", "RAISE"),
        *("ERROR", "CONNECT", "WITH", "AND", "OR", "NOT", "XOR", "DIV", "MOD", "TRUE", "FALSE"),
    ]
)
_TOKEN = re.compile(
    r'(?P<space>\s+|!.*)|(?P<string>"(?:[^"\\]|\\[0-9A-F]{2})*")|(?P<number>\d+(?:\.\d+)?(?:E\d+)?)|(?P<name>[A-Za-z][A-Za-z0-9_]*)'
    r"|(?P<sign>:=|<>|<=|>=|[-+*/=<>()\[\]{},;:.\\])"
)
_LEVELS: tuple[tuple[str, ...], ...] = (("OR", "XOR"), ("AND",), ("=", "<>", "<", ">", "<=", ">="), ("+", "-"), ("*", "/", "DIV", "MOD"))
_NOT_LEVEL = 1  # NOT binds no tighter than OR: what follows it is everything down to AND


class RapidSyntaxError(Exception):
    """The text is no RAPID, as far as we know it."""


class RapidError(Exception):
    """A recoverable error while running: ERRNO."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


class ExitCycle(Exception):
    """The program begins again at main."""


class _Return(Exception):
    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value


class _TryNext(Exception):
    pass


@dataclass(frozen=True, slots=True)
class Routine:
    """A PROC, FUNC or TRAP."""

    kind: str
    name: str
    parameters: tuple[str, ...]
    body: tuple[Any, ...]
    handler: tuple[Any, ...] | None


@dataclass(slots=True)
class Module:
    """A parsed module."""

    name: str
    data: dict[str, tuple[str, str, Any]] = field(default_factory=dict)
    """name: (CONST, PERS or VAR; type; initial value or None)"""
    routines: dict[str, Routine] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)
    """Every identifier that is read, written or called."""
    options: set[tuple[str, str]] = field(default_factory=set)
    """(instruction, optional argument)"""


def tokens(text: str) -> list[tuple[str, str, int]]:
    """Kind, text and line of every token.

    Raises:
        RapidSyntaxError: a character that RAPID does not know.
    """
    found, at = [], 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        line = text.count("\n", 0, at) + 1
        if match is None:
            raise RapidSyntaxError(f"line {line}: {text[at : at + 20]!r}")
        kind = str(match.lastgroup)
        if kind != "space":
            found.append(("word" if match[0] in KEYWORDS else kind, match[0], line))
        at = match.end()
    return found


class _Reader:
    """Recursive descent over the tokens."""

    def __init__(self, text: str) -> None:
        self.tokens, self.at = tokens(text), 0

    def look(self, ahead: int = 0) -> str:
        return self.tokens[self.at + ahead][1] if self.at + ahead < len(self.tokens) else ""

    def take(self, *expected: str) -> str:
        _, text, line = self.tokens[self.at] if self.at < len(self.tokens) else ("end", "", 0)
        if expected and text not in expected:
            raise RapidSyntaxError(f"line {line}: {text!r} where {' or '.join(expected)} belongs")
        self.at += 1
        return text

    def name(self) -> str:
        kind, text, line = self.tokens[self.at]
        if kind != "name":
            raise RapidSyntaxError(f"line {line}: {text!r} is no name")
        self.at += 1
        return text

    def module(self) -> Module:
        self.take("MODULE")
        module = self.made = Module(self.name())
        while self.look() != "ENDMODULE":
            if self.look() in ("PROC", "FUNC", "TRAP"):
                routine = self.routine()
                if routine.name in module.routines or routine.name in module.data:
                    raise RapidSyntaxError(f"{routine.name} is declared twice")
                module.routines[routine.name] = routine
            else:
                name, what = self.declaration()
                if name in module.data:
                    raise RapidSyntaxError(f"{name} is declared twice")
                module.data[name] = what
        self.take("ENDMODULE")
        if self.at != len(self.tokens):
            raise RapidSyntaxError("text after ENDMODULE")
        return module

    def declaration(self) -> tuple[str, tuple[str, str, Any]]:
        kind, type_name, name = self.take("CONST", "PERS", "VAR"), self.name(), self.name()
        size = None
        if self.look() == "{":
            self.take("{")
            size = int(self.take())
            self.take("}")
        value = None
        if self.look() == ":=":
            self.take(":=")
            value = self.expression()
        self.take(";")
        if kind != "VAR" and value is None:
            raise RapidSyntaxError(f"{kind} {name} has no value")
        return name, (kind, type_name if size is None else f"{type_name}{{{size}}}", value)

    def routine(self) -> Routine:
        kind = self.take()
        if kind == "FUNC":
            self.name()
        name, parameters = self.name(), []
        if kind != "TRAP":
            self.take("(")
            while self.look() != ")":
                if self.look() in ("VAR", "INOUT"):
                    self.take()
                self.name()
                parameters.append(self.name())
                if self.look() == ",":
                    self.take(",")
            self.take(")")
        end = f"END{kind}"
        body = self.block("ERROR", end)
        handler = None
        if self.look() == "ERROR":
            self.take("ERROR")
            handler = self.block(end)
        self.take(end)
        if kind == "FUNC" and (not body or body[-1][0] != "return"):
            raise RapidSyntaxError(f"FUNC {name} does not end with RETURN")
        return Routine(kind, name, tuple(parameters), body, handler)

    def block(self, *ends: str) -> tuple[Any, ...]:
        statements = []
        while self.look() not in ends:
            statements.append(self.statement())
        return tuple(statements)

    def statement(self) -> Any:
        word = self.look()
        if word == "VAR":
            name, (_, type_name, value) = self.declaration()
            return ("local", name, type_name, value)
        if word == "IF":
            return self.conditional()
        if word == "WHILE":
            self.take("WHILE")
            condition = self.expression()
            self.take("DO")
            body = self.block("ENDWHILE")
            self.take("ENDWHILE")
            return ("while", condition, body)
        if word == "FOR":
            return self.counted()
        return self.simple()

    def conditional(self) -> Any:
        self.take("IF")
        condition = self.expression()
        if self.look() != "THEN":
            return ("if", ((condition, (self.simple(),)),), ())
        branches = []
        self.take("THEN")
        branches.append((condition, self.block("ELSEIF", "ELSE", "ENDIF")))
        while self.look() == "ELSEIF":
            self.take("ELSEIF")
            condition = self.expression()
            self.take("THEN")
            branches.append((condition, self.block("ELSEIF", "ELSE", "ENDIF")))
        otherwise: tuple[Any, ...] = ()
        if self.look() == "ELSE":
            self.take("ELSE")
            otherwise = self.block("ENDIF")
        self.take("ENDIF")
        return ("if", tuple(branches), otherwise)

    def counted(self) -> Any:
        self.take("FOR")
        name = self.name()
        self.take("FROM")
        first = self.expression()
        self.take("TO")
        last = self.expression()
        self.take("DO")
        body = self.block("ENDFOR")
        self.take("ENDFOR")
        return ("for", name, first, last, body)

    def simple(self) -> Any:
        word = self.look()
        if word == "RETURN":
            self.take("RETURN")
            value = None if self.look() == ";" else self.expression()
            self.take(";")
            return ("return", value)
        if word in ("TRYNEXT", "RAISE"):
            self.take()
            self.take(";")
            return (word.lower(),)
        if word == "CONNECT":
            self.take("CONNECT")
            name = self.name()
            self.take("WITH")
            trap = self.name()
            self.take(";")
            self.made.used |= {name, trap}
            return ("connect", name, trap)
        line = self.tokens[self.at][2]
        target = self.reference()
        if self.look() == ":=":
            self.take(":=")
            value = self.expression()
            self.take(";")
            return ("assign", target, value)
        if target[0] != "name":
            raise RapidSyntaxError(f"line {line}: neither assignment nor call")
        arguments = self.arguments(target[1], ";")
        self.take(";")
        return ("call", target[1], arguments)

    def arguments(self, called: str, end: str) -> tuple[Any, ...]:
        """(optional name or None, expression or None) each; commas part required ones."""
        found: list[tuple[str | None, Any]] = []
        while self.look() != end:
            if self.look() == "\\":
                self.take("\\")
                option = self.name()
                self.made.options.add((called, option))
                value = None
                if self.look() == ":=":
                    self.take(":=")
                    value = self.expression()
                found.append((option, value))
            else:
                found.append((None, self.expression()))
            if self.look() == ",":
                self.take(",")
                if self.look() in (end, ","):
                    raise RapidSyntaxError(f"{called}: an argument is missing")
        return tuple(found)

    def reference(self) -> Any:
        name = self.name()
        self.made.used.add(name)
        found: Any = ("name", name)
        while self.look() in (".", "{"):
            if self.take() == ".":
                found = ("part", found, self.name())
            else:
                found = ("item", found, self.expression())
                self.take("}")
        return found

    def expression(self, level: int = 0) -> Any:
        if level == len(_LEVELS):
            return self.factor()
        if level == 0 and self.look() == "NOT":
            self.take("NOT")
            found: Any = ("not", self.expression(_NOT_LEVEL))
        else:
            found = self.expression(level + 1)
        while self.look() in _LEVELS[level]:
            sign = self.take()
            found = ("binary", sign, found, self.expression(level + 1))
        return found

    def factor(self) -> Any:
        kind, text, line = self.tokens[self.at]
        if text == "-":
            self.take()
            return ("minus", self.factor())
        if text == "(":
            self.take()
            inner = self.expression()
            self.take(")")
            return inner
        if text == "[":
            self.take()
            parts = [self.expression()]
            while self.look() == ",":
                self.take()
                parts.append(self.expression())
            self.take("]")
            return ("aggregate", tuple(parts))
        if kind == "number":
            self.take()
            return ("value", np.float32(float(text)))
        if kind == "string":
            self.take()
            plain = re.sub(r"\\([0-9A-F]{2})", lambda match: chr(int(match[1], 16)), text[1:-1])
            if len(plain) > LONGEST_STRING:
                raise RapidSyntaxError(f"line {line}: a string of {len(plain)} characters")
            return ("value", plain)
        if text in ("TRUE", "FALSE"):
            self.take()
            return ("value", text == "TRUE")
        found = self.reference()
        if self.look() == "(" and found[0] == "name":
            self.take("(")
            arguments = self.arguments(found[1], ")")
            self.take(")")
            return ("function", found[1], arguments)
        return found


@cache
def read(text: str) -> Module:
    """The module in a text.

    Raises:
        RapidSyntaxError: it is none.
    """
    return _Reader(text).module()


JOINT_PARTS = {"robax": [f"rax_{i}" for i in range(1, 7)], "extax": [f"eax_{c}" for c in "abcdef"]}
_EMPTY: dict[str, Callable[[], Any]] = {
    "num": lambda: np.float32(0),
    "string": str,
    "bool": lambda: False,
    "jointtarget": lambda: {group: {part: np.float32(0) for part in parts} for group, parts in JOINT_PARTS.items()},
    "robtarget": lambda: {"trans": {}, "rot": {}},
}


class Machine:
    """Runs modules together. Instructions are given: name -> function of (machine, required values, options)."""

    def __init__(self, modules: Sequence[Module], instructions: Mapping[str, Callable[..., Any]], constants: Mapping[str, Any]) -> None:
        self.routines = {name: routine for module in modules for name, routine in module.routines.items()}
        self.instructions, self.constants = dict(instructions), dict(constants)
        self.data: dict[str, Any] = {}
        self._declared = {name: what for module in modules for name, what in module.data.items()}
        self.connected: dict[str, str] = {}
        self._frames: list[dict[str, Any]] = []
        for name in self._declared:
            self.initialise(name)

    def initialise(self, name: str) -> None:
        """Give a variable of a module its first value again."""
        _, type_name, value = self._declared[name]
        self.data[name] = self._first(type_name, value)

    def pp_to_main(self) -> None:
        """Variables get their first values, persistents keep theirs."""
        for name, (kind, _, _) in self._declared.items():
            if kind == "VAR":
                self.initialise(name)
        self.connected.clear()

    def _first(self, type_name: str, value: Any) -> Any:
        if type_name.endswith("}"):
            base, size = type_name[:-1].split("{")
            return [self._first(base, None) for _ in range(int(size))]
        return _EMPTY.get(type_name, lambda: None)() if value is None else self.value(value)

    def call(self, name: str, *values: Any) -> Any:
        """Run a routine of a module.

        Raises:
            RapidError: nothing in it handles an error.
            ExitCycle: the program begins again.
        """
        routine = self.routines[name]
        if len(values) != len(routine.parameters):
            raise RapidSyntaxError(f"{name} takes {len(routine.parameters)} arguments, not {len(values)}")
        self._frames.append(dict(zip(routine.parameters, values, strict=True)))
        depth = len(self._frames)
        try:
            self._run(routine.body, routine)
        except _Return as back:
            return back.value
        finally:
            del self._frames[depth - 1 :]
        return None

    def _run(self, statements: tuple[Any, ...], routine: Routine, *, handling: bool = False) -> None:
        for statement in statements:
            try:
                self._statement(statement, routine, handling)
            except RapidError as error:
                if handling or routine.handler is None or statement[0] in ("if", "while", "for"):
                    raise
                self.constants["ERRNO"] = self.constants.get(error.name, error.name)
                try:
                    self._run(routine.handler, routine, handling=True)
                except _TryNext:
                    continue
                raise

    def _statement(self, statement: Any, routine: Routine, handling: bool) -> None:
        match statement:
            case ("local", name, type_name, value):
                self._frames[-1][name] = self._first(type_name, value)
            case ("if", branches, otherwise):
                for condition, body in branches:
                    if self._truth(condition):
                        self._run(body, routine, handling=handling)
                        return
                self._run(otherwise, routine, handling=handling)
            case ("while", condition, body):
                while self._truth(condition):
                    self._run(body, routine, handling=handling)
            case ("for", name, first, last, body):
                for i in range(int(self.value(first)), int(self.value(last)) + 1):
                    self._frames[-1][name] = np.float32(i)
                    self._run(body, routine, handling=handling)
            case ("return", value):
                raise _Return(None if value is None else self.value(value))
            case ("trynext",):
                raise _TryNext
            case ("connect", name, trap):
                self.connected[name] = trap
            case ("assign", target, value):
                self.assign(target, self.value(value))
            case ("call", name, arguments):
                self._invoke(name, arguments)
            case _:
                raise RapidSyntaxError(str(statement[0]))

    def _truth(self, expression: Any) -> bool:
        value = self.value(expression)
        if not isinstance(value, bool | np.bool_):
            raise RapidSyntaxError(f"{value!r} is no bool")
        return bool(value)

    def _invoke(self, name: str, arguments: tuple[Any, ...]) -> Any:
        if name in self.instructions:  # references to variables come as they are, so that results can be put there
            required = [argument for option, argument in arguments if option is None]
            options = {option: argument for option, argument in arguments if option is not None}
            return self.instructions[name](self, required, options)
        if name not in self.routines:
            raise RapidSyntaxError(f"{name} is not known")
        return self.call(name, *(self.value(argument) for _, argument in arguments))

    def _holder(self, name: str) -> dict[str, Any]:
        if self._frames and name in self._frames[-1]:
            return self._frames[-1]
        if name in self.data:
            return self.data
        if name in self.constants:
            return self.constants
        raise RapidSyntaxError(f"{name} is not declared")

    def assign(self, target: Any, value: Any) -> None:
        """Put a value where a reference points.

        Raises:
            RapidSyntaxError: to a constant, of another type, or a string that is too long.
        """
        if isinstance(value, str) and len(value) > LONGEST_STRING:
            raise RapidSyntaxError(f"a string of {len(value)} characters: {value!r}")
        if isinstance(value, float | int) and not isinstance(value, bool):
            value = np.float32(value)
        if target[0] == "name":
            name = target[1]
            if name in self.constants or self._declared.get(name, ("VAR",))[0] == "CONST":
                raise RapidSyntaxError(f"{name} is a constant")
            holder = self._holder(name)
            if holder[name] is not None and type(holder[name]) is not type(value):
                raise RapidSyntaxError(f"{name} is no {type(value).__name__}")
            holder[name] = _copied(value)
        elif target[0] == "part":
            self.value(target[1])[target[2]] = value
        else:
            self.value(target[1])[int(self.value(target[2])) - 1] = value

    def value(self, expression: Any) -> Any:
        """What an expression is."""
        match expression:
            case ("value", value):
                return value
            case ("name", name):
                return self._holder(name)[name]
            case ("part", record, part):
                return self.value(record)[part]
            case ("item", array, index):
                return self.value(array)[int(self.value(index)) - 1]
            case ("aggregate", parts):
                return [self.value(part) for part in parts]
            case ("minus", inner):
                return np.float32(-self.value(inner))
            case ("not", inner):
                return not self._truth(inner)
            case ("function", name, arguments):
                return self._invoke(name, arguments)
            case ("binary", sign, left, right):
                return _combined(sign, self.value(left), self.value(right))
        raise RapidSyntaxError(str(expression))


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(part) for key, part in value.items()}
    return [_copied(part) for part in value] if isinstance(value, list) else value


def _combined(sign: str, left: Any, right: Any) -> Any:
    if isinstance(left, str) is not isinstance(right, str) or isinstance(left, bool) is not isinstance(right, bool):
        raise RapidSyntaxError(f"{left!r} {sign} {right!r}")
    simple: dict[str, Callable[[Any, Any], Any]] = {
        "=": lambda a, b: a == b,
        "<>": lambda a, b: a != b,
        "<": lambda a, b: a < b,
        ">": lambda a, b: a > b,
        "<=": lambda a, b: a <= b,
        ">=": lambda a, b: a >= b,
        "AND": lambda a, b: a and b,
        "OR": lambda a, b: a or b,
        "XOR": lambda a, b: a is not b,
    }
    if sign in simple:
        return bool(simple[sign](left, right))
    if isinstance(left, str):
        if sign != "+" or len(left + right) > LONGEST_STRING:
            raise RapidSyntaxError(f"a string of {len(left + right)} characters: {left + right!r}")
        return left + right
    numbers: dict[str, Callable[[Any, Any], Any]] = {
        "+": lambda a, b: a + b,
        "-": lambda a, b: a - b,
        "*": lambda a, b: a * b,
        "/": lambda a, b: a / b,
        "DIV": lambda a, b: a // b,
        "MOD": lambda a, b: a % b,
    }
    return np.float32(numbers[sign](np.float32(left), np.float32(right)))
