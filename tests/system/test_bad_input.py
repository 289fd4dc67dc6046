"""Bad input ends in exit 1 with one line that names file, place and remedy; nothing is left behind (issue 2)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.support.damage import DAMAGES
from tests.system.conftest import Cli, SmallCell


@pytest.fixture
def spoilt(small: SmallCell, tmp_path: Path) -> Path:
    """A copy of the calibration session, to be spoilt."""
    session = tmp_path / "spoilt"
    shutil.copytree(small.calibration_session, session)
    return session


@pytest.mark.parametrize("name", DAMAGES)
def test_a_spoilt_session_is_told_in_one_line(name: str, spoilt: Path, tmp_path: Path, cli: Cli) -> None:
    damage = DAMAGES[name]
    damage.spoil(spoilt)
    before = sorted(path for path in tmp_path.rglob("*"))
    result = cli("calibrate", spoilt, "-o", tmp_path / "calibration.yaml", "--json")
    assert result.code == 1, result
    assert result.err.count("\n") == 1, result.err
    line = result.err.lower()
    assert any(word in line for word in damage.words), result.err
    error = result.told["error"]
    assert set(error) == {"type", "message", "file", "where", "remedy"}
    assert error["file"].endswith(damage.file), error
    assert damage.where in (error["where"] or ""), error
    assert error["remedy"]
    assert error["remedy"] in result.err
    assert sorted(path for path in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("verb", ["calibrate", "verify", "stitch", "centres", "report"])
def test_a_missing_session_is_told_by_every_verb(verb: str, tmp_path: Path, cli: Cli, calibration: Path) -> None:
    before = sorted(tmp_path.rglob("*"))
    first = [calibration] if verb in ("verify", "stitch", "report") else []
    options = [] if verb == "verify" else ["-o", tmp_path / "out"]
    result = cli(verb, *first, tmp_path / "nowhere", *options, "--json")
    assert result.code == 1
    assert result.err.count("\n") == 1
    assert result.told["error"]["file"] == str(tmp_path / "nowhere")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("content", ["", "format: spherecal-cell/1\n", "format: spherecal-calibration/1\n", "]: [", "\x00"])
def test_a_file_that_is_no_calibration_is_told(content: str, small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(content)
    result = cli("verify", path, small.verification_session, "--json")
    assert result.code == 1
    assert result.err.count("\n") == 1
    assert result.told["error"]["file"] == str(path)
    assert result.told["error"]["remedy"]


def test_a_calibration_that_was_edited_is_told(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    text = calibration.read_text()
    changed = text.replace("verdict: ", "verdict: un", 1)
    assert changed != text
    path = tmp_path / "c.yaml"
    path.write_text(changed)
    result = cli("verify", path, small.verification_session, "--json")
    assert result.code == 1
    assert result.err.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("driver: simulated, model", "driver: nonsense, model", "driver"),
        ("truth: truth.yaml", "truht: truth.yaml", "truht"),
        ("expanded_uncertainty_mm: 0.001", "expanded_uncertainty_mm: -1", "spheres"),
        ("[A, B]", "[A, Q]", "lengths"),
        ("model: irb1410_paper", "model: irb1411", ""),
    ],
)
def test_a_spoilt_cell_cannot_be_captured_with(old: str, new: str, where: str, small: SmallCell, tmp_path: Path, cli: Cli) -> None:
    shutil.copytree(small.folder, tmp_path / "c", ignore=shutil.ignore_patterns("calibration", "verification", "workpiece"))
    cell = tmp_path / "c" / "cell.yaml"
    text = cell.read_text()
    assert old in text
    cell.write_text(text.replace(old, new, 1))
    before = sorted(tmp_path.rglob("*"))
    result = cli("capture", cell, tmp_path / "c" / "workpiece_plan.yaml", "-o", tmp_path / "s", "--yes", "--json")
    assert result.code == 1
    error = result.told["error"]
    assert where in f"{error['where']} {error['message']}"
    assert error["remedy"]
    assert sorted(tmp_path.rglob("*")) == before


def test_an_output_that_cannot_be_written_leaves_nothing(small: SmallCell, calibration: Path, tmp_path: Path, cli: Cli) -> None:
    for verb, first in (("calibrate", [small.calibration_session]), ("stitch", [calibration, small.workpiece_session])):
        result = cli(verb, *first, "-o", tmp_path / "no" / "where", "--json")
        assert result.code == 1
        assert result.err.count("\n") == 1
        assert json.loads(result.out)["error"]["remedy"]
    assert list(tmp_path.iterdir()) == []
