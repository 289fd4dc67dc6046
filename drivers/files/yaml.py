"""YAML with 1.2 core scalars, duplicate keys refused, every error with its line.

PyYAML follows YAML 1.1: `1e-3` is text, `no` is False and `12:30` is 750. Here they are 0.001, "no" and "12:30"
(YAML 1.2.2, section 10.3.2). Tags beyond the core schema are refused; aliases are expanded within a bound.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drivers.errors import FileError
from drivers.files.disk import read_text

_Loader: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_Dumper: type[yaml.SafeDumper] = getattr(yaml, "CSafeDumper", yaml.SafeDumper)

_CORE = "tag:yaml.org,2002:"
_INTEGER = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
_INFINITY = re.compile(r"[-+]?\.(?:inf|Inf|INF)")
_NOT_A_NUMBER = re.compile(r"\.(?:nan|NaN|NAN)")
_NULLS = ("", "~", "null", "Null", "NULL")
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}

_DEPTH_LIMIT = 50
_VALUE_LIMIT = 2_000_000
_FLOW_WIDTH = 100


def load_yaml(path: str | Path) -> object:
    """The plain data (dict, list, str, int, float, bool, None) of a YAML file.

    Raises:
        FileError: unreadable, no YAML, a duplicate key, a tag; with file, line and column, and a remedy.
    """
    return parse_yaml(read_text(path), file=path)


def parse_yaml(text: str, *, file: str | Path) -> object:
    """The plain data of a YAML text; `file` is only named in errors.

    Raises:
        FileError: no YAML, more than one document, a duplicate key, a tag, too deep or too large.
    """
    return _Construction(text, file).document()


def line_of(text: str, key_path: Sequence[str | int], *, file: str | Path) -> int | None:
    """The line (from 1) of the value at a key path, or of the deepest part of the path that exists."""
    construction = _Construction(text, file)
    construction.document()
    names = tuple(map(str, key_path))
    paths = (names[:n] for n in range(len(names), 0, -1))
    return next((construction.lines[path] for path in paths if path in construction.lines), None)


def dump_yaml(data: object) -> str:
    """YAML text of plain data, numpy values and arrays; floats come back exactly, keys keep their order.

    Short lists and mappings are written on one line. Text that YAML 1.1 readers would take for a number, a date or a
    truth value is quoted.

    Raises:
        TypeError: for a value that is not plain data.
    """
    return str(yaml.dump(_plain(data), Dumper=_ReadableDumper, sort_keys=False, allow_unicode=True, width=120, default_flow_style=False))


class _Construction:
    """Turns parser events into plain data.

    From events and not from PyYAML's nodes, because its composer recurses in C: deep brackets would kill the process.
    """

    def __init__(self, text: str, file: str | Path) -> None:
        self._text = text
        self._file = file
        self._anchors: dict[str, object] = {}
        self._n_values = 0
        self.lines: dict[tuple[str, ...], int] = {}
        """Line (from 1) of the value at every key path."""

    def document(self) -> object:
        try:
            return self._document(iter(yaml.parse(self._text, Loader=_Loader)))
        except yaml.MarkedYAMLError as error:
            raise self._syntax_error(error) from error
        except (yaml.YAMLError, UnicodeError) as error:
            raise FileError(f"is no YAML text ({error})", file=self._file, remedy="Save it as plain UTF-8 text.") from error

    def _document(self, events: Iterator[Any]) -> object:
        next(events)  # start of the stream
        if isinstance(next(events), yaml.StreamEndEvent):
            return None
        value = self._value(events, next(events), ())
        next(events)  # end of the document
        following = next(events)
        if not isinstance(following, yaml.StreamEndEvent):
            raise self._error(following, "a second document begins", "Keep one document only: remove the line `---`.")
        return value

    def _value(self, events: Iterator[Any], event: Any, path: tuple[str, ...]) -> object:
        self._count(event, len(path))
        self.lines[path] = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            return self._alias(event)
        if event.tag is not None:
            raise self._error(event, f"the tag {event.tag} is not allowed", "Remove the tag; spherecal reads plain values.")
        if isinstance(event, yaml.ScalarEvent):
            value: object = self._scalar(event)
        elif isinstance(event, yaml.SequenceStartEvent):
            value = self._list(events, path)
        else:
            value = self._mapping(events, path)
        if event.anchor is not None:
            self._anchors[event.anchor] = value
        return value

    def _list(self, events: Iterator[Any], path: tuple[str, ...]) -> list[object]:
        result: list[object] = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            result.append(self._value(events, event, (*path, str(len(result)))))
        return result

    def _mapping(self, events: Iterator[Any], path: tuple[str, ...]) -> dict[Hashable, object]:
        result: dict[Hashable, object] = {}
        while not isinstance(event := next(events), yaml.MappingEndEvent):
            key = self._value(events, event, (*path, "?"))
            if isinstance(key, list | dict):
                raise self._error(event, "a list or mapping stands where a key belongs", "Use a plain word as the key.")
            if key in result:
                raise self._error(event, f"the key {key!r} is given twice", "Keep one of the two.")
            result[key] = self._value(events, next(events), (*path, str(key)))
        return result

    def _scalar(self, event: Any) -> str | int | float | bool | None:
        if event.style:  # quoted or block text; plain is None or, from libyaml, empty
            return str(event.value)
        try:
            return _plain_scalar(str(event.value))
        except ValueError as error:
            raise self._error(event, "a number with too many digits", "Write it shorter.") from error

    def _alias(self, event: Any) -> object:
        if event.anchor not in self._anchors:
            raise self._error(event, f"the alias *{event.anchor} has no finished anchor before it", "Put text that begins with * in quotes.")
        return self._copy(event, self._anchors[event.anchor], 0)

    def _copy(self, event: Any, value: object, depth: int) -> object:
        self._count(event, depth)
        if isinstance(value, list):
            return [self._copy(event, item, depth + 1) for item in value]
        if isinstance(value, dict):
            return {key: self._copy(event, item, depth + 1) for key, item in value.items()}
        return value

    def _count(self, event: Any, depth: int) -> None:
        self._n_values += 1
        if depth > _DEPTH_LIMIT or self._n_values > _VALUE_LIMIT:
            raise self._error(event, "is nested too deeply or expands without bound", "Write the values out without aliases.")

    def _syntax_error(self, error: yaml.MarkedYAMLError) -> FileError:
        mark = error.problem_mark or error.context_mark
        where = None if mark is None else f"line {mark.line + 1}, column {mark.column + 1}"
        message = " ".join(part for part in (error.problem, error.context) if part)
        remedy = "Check brackets, quotes and indentation there (spaces, no tabs)."
        return FileError(f"broken YAML, {message}", file=self._file, where=where, remedy=remedy)

    def _error(self, event: Any, message: str, remedy: str) -> FileError:
        mark = event.start_mark
        return FileError(message, file=self._file, where=f"line {mark.line + 1}, column {mark.column + 1}", remedy=remedy)


def _plain_scalar(text: str) -> str | int | float | bool | None:
    if text in _NULLS:
        return None
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text):
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INFINITY.fullmatch(text):
        return -math.inf if text[0] == "-" else math.inf
    return math.nan if _NOT_A_NUMBER.fullmatch(text) else text


def _plain(data: object) -> object:
    if isinstance(data, np.ndarray | np.generic):
        return _plain(data.tolist())
    if isinstance(data, Mapping):
        return {_plain(key): _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(item) for item in data]
    if data is None or isinstance(data, str | bool | int | float):
        return data
    msg = f"{type(data).__name__} cannot be written as YAML"
    raise TypeError(msg)


class _ReadableDumper(_Dumper):  # type: ignore[valid-type, misc]
    """Short collections on one line; no anchors; quotes by the rules of YAML 1.1 and 1.2 together."""

    def ignore_aliases(self, data: object) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Sequence[object], flow_style: bool | None = None) -> yaml.SequenceNode:
        node = super().represent_sequence(tag, sequence, flow_style)
        numeric = all(isinstance(item, yaml.ScalarNode) and not item.tag.endswith(":str") for item in node.value)
        node.flow_style = numeric or _one_line_length(node) <= _FLOW_WIDTH
        return node  # type: ignore[no-any-return]

    def represent_mapping(self, tag: str, mapping: Mapping[object, object], flow_style: bool | None = None) -> yaml.MappingNode:
        node = super().represent_mapping(tag, mapping, flow_style)
        node.flow_style = _one_line_length(node) <= _FLOW_WIDTH
        return node  # type: ignore[no-any-return]

    def represent_scalar(self, tag: str, value: str, style: str | None = None) -> yaml.ScalarNode:
        block = "\n" in value and not any(line != line.rstrip() for line in value.split("\n"))
        return super().represent_scalar(tag, value, "|" if block else style)  # type: ignore[no-any-return]

    def represent(self, data: object) -> None:
        node = self.represent_data(data)
        if isinstance(node, yaml.CollectionNode):
            node.flow_style = not node.value
        self.serialize(node)


def _one_line_length(node: yaml.Node) -> float:
    """Characters on one line of a list of scalars or a mapping to such; infinite for anything deeper."""
    if isinstance(node, yaml.ScalarNode):
        return math.inf if "\n" in node.value else len(node.value) + 2
    if isinstance(node, yaml.SequenceNode):
        return math.inf if any(isinstance(item, yaml.CollectionNode) for item in node.value) else sum(map(_one_line_length, node.value)) + 2
    values = [value for _, value in node.value]
    if any(isinstance(value, yaml.MappingNode) for value in values):
        return math.inf
    return sum(len(key.value) + 2 for key, _ in node.value) + sum(map(_one_line_length, values)) + 2


for _first in "-+.0123456789":
    _ReadableDumper.add_implicit_resolver(_CORE + "float", re.compile(f"^(?:{_FLOAT.pattern})$"), [_first])
    _ReadableDumper.add_implicit_resolver(_CORE + "int", re.compile(f"^(?:{_INTEGER.pattern})$"), [_first])
