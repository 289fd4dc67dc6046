"""The project's own sources, for tests of the house rules."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LAYERS = ("drivers", "acquire", "calibrate", "measure")


def modules_of(layer: str) -> list[Path]:
    """Every Python file of one of the four packages."""
    return sorted(path for path in (ROOT / layer).rglob("*.py") if "__pycache__" not in path.parts)


def all_modules() -> list[Path]:
    """Every Python file of the four packages."""
    return [path for layer in LAYERS for path in modules_of(layer)]


def dotted_name(path: Path) -> str:
    """`drivers/files/yaml.py` -> `drivers.files.yaml`; a package's `__init__` is the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_names(path: Path) -> Iterator[str]:
    """Dotted names that a file imports anywhere in it, inside functions included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def string_constants(path: Path) -> Iterator[str]:
    """Strings of the code of a file, docstrings (and other strings that stand alone) left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
            yield node.value
