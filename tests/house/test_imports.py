"""What may import what, beyond the contracts of import-linter (what `spherecal --help` loads: tests/unit/measure/test_cli_help.py)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.source import all_modules, dotted_name, imported_names, modules_of, string_constants

WEIGHTY = ("open3d", "rerun", "matplotlib", "trimesh", "numba")


def loaded_by(code: str) -> set[str]:
    """Names in sys.modules of a fresh interpreter after the code ran."""
    report = "import sys, json; sys.stdout = open('/dev/null', 'w')\n"
    report += code + "\njson.dump(sorted(sys.modules), sys.__stdout__)"
    done = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def test_the_probe_sees_a_heavy_import() -> None:
    assert "scipy.optimize" in loaded_by("import scipy.optimize")


def test_no_module_loads_a_weighty_library_by_being_imported() -> None:
    """Kernels and the door to numba excepted: those are imported inside the functions that call them."""
    names = [dotted_name(path) for path in all_modules() if "kernels" not in path.stem and path.stem != "compiled"]
    loaded = loaded_by(f"import importlib\nfor name in {names!r}: importlib.import_module(name)")
    assert set(names) <= loaded
    assert not loaded & set(WEIGHTY)


@pytest.mark.parametrize("path", all_modules(), ids=dotted_name)
def test_only_the_viewer_imports_rerun_and_nobody_imports_tests(path: Path) -> None:
    tops = {name.split(".")[0] for name in imported_names(path)}
    assert not tops & {"tests", "fixtures", "tools"}
    if not dotted_name(path).startswith("measure.viewer"):
        assert "rerun" not in tops


@pytest.mark.parametrize("path", [*modules_of("acquire"), *modules_of("calibrate")], ids=dotted_name)
def test_acquire_and_calibrate_cannot_reach_the_simulated_truth_by_name(path: Path) -> None:
    """Import-linter sees import statements; this sees import by string and a truth file opened by name."""
    assert not [name for name in imported_names(path) if name.startswith("drivers.simulated")]
    assert not [text for text in string_constants(path) if "simulated" in text.replace("/", ".") or "truth" in text.lower()]
    assert not [name for name in imported_names(path) if name.startswith("importlib") and not name.startswith("importlib.metadata")]
