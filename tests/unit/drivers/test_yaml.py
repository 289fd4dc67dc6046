"""YAML: the 1.2 core schema, errors with places, exact round trips, no way to hang or to blow up."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import FileError
from drivers.files.yaml import dump_yaml, line_of, load_yaml, parse_yaml

# YAML 1.2.2, section 10.3.2
CORE_SCALARS = [
    ("1e-3", 0.001),
    ("1E+3", 1000.0),
    (".5", 0.5),
    ("-2.", -2.0),
    ("12", 12),
    ("-7", -7),
    ("+7", 7),
    ("007", 7),
    ("0o17", 15),
    ("0x1F", 31),
    ("null", None),
    ("~", None),
    ("", None),
    ("true", True),
    ("FALSE", False),
    (".inf", math.inf),
    ("-.INF", -math.inf),
    ("no", "no"),
    ("yes", "yes"),
    ("on", "on"),
    ("12:30", "12:30"),
    ("2026-01-01", "2026-01-01"),
    ("1_000", "1_000"),
    ("'1'", "1"),
    ('"null"', "null"),
    ("1e", "1e"),
    ("-0o17", "-0o17"),
]


@pytest.mark.parametrize(("text", "value"), CORE_SCALARS)
def test_scalars_follow_the_core_schema(text: str, value: object) -> None:
    parsed = parse_yaml(f"key: {text}\n", file="x.yaml")
    assert isinstance(parsed, dict)
    assert parsed["key"] == value
    assert type(parsed["key"]) is type(value)


BROKEN = [
    ("a: 1\nb: 2\na: 3\n", "line 3, column 1", "twice"),
    ("a: {b: 1, b: 2}\n", "line 1, column 11", "twice"),
    ("1: a\n0x1: b\n", "line 2", "twice"),
    ("a: [1, 2\n", "line 2", "broken YAML"),
    ("a: !!python/object/apply:os.system [ls]\n", "line 1", "tag"),
    ("a: !mine 1\n", "line 1", "tag"),
    ("a: *nobody\n", "line 1", "alias"),
    ("a: 1\n---\nb: 2\n", "line 2", "document"),
    ("a: &x [*x]\n", "line 1", "alias"),
    ("[1]: 2\n", "line 1", "key"),
    (f"a: {'9' * 5000}\n", "line 1", "digits"),
    ("a:\n\t- 1\n", "line 2", "broken YAML"),
    ("[" * 100_000, None, ""),
    ("- " * 3000, None, ""),
]


@pytest.mark.parametrize(("text", "where", "word"), BROKEN)
def test_broken_text_is_a_file_error_with_place_and_remedy(text: str, where: str | None, word: str) -> None:
    with pytest.raises(FileError) as caught:
        parse_yaml(text, file="x.yaml")
    error = caught.value
    assert error.file == "x.yaml"
    assert error.remedy
    assert word in error.message
    if where:
        assert error.where is not None
        assert error.where.startswith(where)


def test_aliases_are_expanded_but_a_bomb_is_refused() -> None:
    assert parse_yaml("a: &m [1, 2]\nb: *m\n", file="x") == {"a": [1, 2], "b": [1, 2]}
    levels = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 20)}]" for i in range(1, 12)]
    with pytest.raises(FileError, match="without bound"):
        parse_yaml("a0: &a0 [1]\n" + "\n".join(levels), file="x")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no such file"):
        load_yaml(tmp_path / "missing.yaml")
    with pytest.raises(FileError, match="folder"):
        load_yaml(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"a: 1\nb: \xe9\n")
    with pytest.raises(FileError, match="line 2: byte 0xe9 is not UTF-8"):
        load_yaml(tmp_path / "latin.yaml")
    (tmp_path / "bom.yaml").write_bytes(b"\xef\xbb\xbfa: \xc3\xa9\r\n")
    assert load_yaml(tmp_path / "bom.yaml") == {"a": "é"}


def test_line_of_a_key_path() -> None:
    text = "a:\n  b:\n  - 1\n  - {c: 2}\n"
    assert line_of(text, ["a", "b", 1, "c"], file="x") == 4
    assert line_of(text, ["a", "b", 7], file="x") == 3
    assert line_of(text, ["missing"], file="x") is None
    assert line_of("", ["a"], file="x") is None


def _trees(scalars: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    grow: Callable[[st.SearchStrategy[object]], st.SearchStrategy[object]] = lambda child: (  # noqa: E731
        st.lists(child, max_size=6) | st.dictionaries(st.text(max_size=12), child, max_size=6)
    )
    return st.recursive(scalars, grow, max_leaves=30)


@given(_trees(st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()))
def test_what_is_dumped_is_parsed_back_exactly(data: object) -> None:
    parsed = parse_yaml(dump_yaml(data), file="x")
    assert repr(parsed) == repr(data)  # repr tells 1 from 1.0 and 0.0 from -0.0


@given(st.floats(), st.floats())
def test_floats_come_back_bit_for_bit(a: float, b: float) -> None:
    parsed = parse_yaml(dump_yaml({"a": a, "b": [b]}), file="x")
    assert np.array_equal(np.array([a, b]), np.array([parsed["a"], parsed["b"][0]]), equal_nan=True)  # type: ignore[index]


def test_arrays_and_matrices_stay_readable() -> None:
    text = dump_yaml({"format": "x/1", "m": np.eye(2), "n": np.float64(1e-5), "lengths": [{"between": ("A", "B"), "length_mm": 500.0}], "empty": {}})
    assert text.splitlines() == [
        "format: x/1",
        "m:",
        "- [1.0, 0.0]",
        "- [0.0, 1.0]",
        "n: 1.0e-05",
        "lengths:",
        "- {between: [A, B], length_mm: 500.0}",
        "empty: {}",
    ]
    assert dump_yaml({"t": "a\nb\n"}) == "t: |\n  a\n  b\n"
    with pytest.raises(TypeError):
        dump_yaml({"a": Path("x")})


@pytest.mark.parametrize("text", ["1e-3", "no", "12:30", "0o17", "2026-01-01", "null", "", "*a", "&a", "- a", "a: b", "# c", " x"])
def test_text_that_looks_like_something_else_stays_text(text: str) -> None:
    assert parse_yaml(dump_yaml({"a": text}), file="x") == {"a": text}


@given(st.text(alphabet=st.sampled_from("ab:-[]{}&*!|>'\"#%@`,? \n\t01.e~\\")))
def test_any_text_is_data_or_a_file_error(text: str) -> None:
    with suppress(FileError):
        parse_yaml(text, file="x")
