"""House rules on the sources that no linter holds for us."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests.support.source import LAYERS, ROOT, all_modules, dotted_name

SPLIT_FROM = 300
LIMIT = 400
HELD_BY_RUFF = {"D", "F", "B", "T20", "S101", "SLF", "TID", "PL", "RUF"}
# Where a person is spoken to, and nowhere else.
PRINTING = {"measure/cli*.py", "measure/demo.py"}


def settings() -> dict[str, dict[str, object]]:
    """The tool tables of pyproject.toml."""
    tools: dict[str, dict[str, object]] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    return tools


@pytest.mark.parametrize("path", all_modules(), ids=dotted_name)
def test_a_file_is_short_enough_to_read(path: Path) -> None:
    n_lines = len(path.read_text(encoding="utf-8").splitlines())
    assert n_lines <= LIMIT, f"{dotted_name(path)} has {n_lines} lines; split it by meaning (a file grows to about {SPLIT_FROM})"


@pytest.mark.parametrize("path", all_modules(), ids=dotted_name)
def test_a_silenced_check_says_which(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"#\s*noqa(?!:)", text)
    assert not re.search(r"#\s*type:\s*ignore(?!\[)", text)
    assert not re.search(r"#\s*mypy:", text)
    assert not re.search(r"#\s*ruff:", text)


def test_no_check_is_switched_off_for_a_package() -> None:
    lint = settings()["ruff"]["lint"]
    assert isinstance(lint, dict)
    assert set(lint["select"]) >= HELD_BY_RUFF
    silenced = {place: set(rules) for place, rules in lint["per-file-ignores"].items() if not place.startswith("tests")}
    assert {place for place, rules in silenced.items() if "T20" in rules} <= PRINTING
    assert all(rules == {"T20"} for rules in silenced.values())


def test_mypy_is_strict_everywhere() -> None:
    mypy = settings()["mypy"]
    assert mypy["strict"] is True
    files, overrides = mypy["files"], mypy["overrides"]
    assert isinstance(files, list)
    assert isinstance(overrides, list)
    assert {*LAYERS, "tests"} <= set(files)
    own = {*LAYERS, "tests", "*"}
    for override in overrides:
        assert not {name.split(".")[0] for name in override["module"]} & own


def test_warnings_are_errors() -> None:
    options = settings()["pytest"]["ini_options"]
    assert isinstance(options, dict)
    assert options["filterwarnings"][0] == "error"
    assert "--strict-markers" in options["addopts"]
