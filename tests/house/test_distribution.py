"""The distribution owns its four names, ships its data, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest

from tests.support.dependencies import canonical, direct_names, third_party_text
from tests.support.source import LAYERS, ROOT

NOT_SHIPPED = {".pyc"}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_top_level_name_is_ours_alone(layer: str) -> None:
    """Two wheels that own one `drivers/` install without complaint and overwrite each other (facts/style.md 7)."""
    assert set(packages_distributions().get(layer, ["spherecal"])) == {"spherecal"}


def test_the_command_is_declared() -> None:
    scripts = distribution("spherecal").entry_points.select(group="console_scripts")
    assert [(script.name, script.value) for script in scripts] == [("spherecal", "measure.cli:main")]


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names in a wheel built from this tree."""
    folder = tmp_path_factory.mktemp("wheel")
    code = f"import hatchling.build; print(hatchling.build.build_wheel({str(folder)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(folder / done.stdout.split()[-1]) as wheel:
        return set(wheel.namelist())


def test_the_wheel_holds_every_file_of_the_packages(wheel_names: set[str]) -> None:
    files = [path for layer in LAYERS for path in (ROOT / layer).rglob("*") if path.is_file()]
    ours = {str(path.relative_to(ROOT)) for path in files if "__pycache__" not in path.parts and path.suffix not in NOT_SHIPPED}
    assert "drivers/models/abb_irb1410.yaml" in ours
    assert ours <= wheel_names


def test_the_wheel_holds_nothing_else(wheel_names: set[str]) -> None:
    tops = {Path(name).parts[0] for name in wheel_names}
    assert {top for top in tops if not top.endswith(".dist-info")} == set(LAYERS)
    licences = {Path(name).name for name in wheel_names if "/licenses/" in name}
    assert licences == {"LICENSE", "THIRD_PARTY.md"}


def test_third_party_names_what_we_ask_for() -> None:
    text = canonical(third_party_text())
    assert not [name for name in direct_names("dev") if name not in text]
