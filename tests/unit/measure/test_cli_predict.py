"""`spherecal predict`: a table for a person, one object for a program, nothing written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from calibrate.predict import predict_artefact
from measure.cli import app
from measure.cli_run import run_app
from measure.demo_cell import write_demo_cell


@pytest.fixture
def cell_path(tmp_path: Path) -> Path:
    return write_demo_cell(tmp_path, 0)


def test_predictions_are_told_and_nothing_is_written(cell_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    made: dict[str, Any] = {}

    def once(cell: Any, model: Any, artefact: Any, *more: Any, **settings: Any) -> Any:
        """The second run tells what the first one predicted: seconds saved."""
        if artefact.name not in made:
            made[artefact.name] = predict_artefact(cell, model, artefact, *more, **settings)
        return made[artefact.name]

    monkeypatch.setattr("calibrate.predict.predict_artefact", once)
    before = sorted(cell_path.parent.iterdir())
    arguments = ["predict", str(cell_path), "--spheres", "A,B", "-n", "10", "-n", "14"]
    assert run_app(app, [*arguments, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)["predicted"]
    assert run_app(app, arguments) == 0
    printed = capfd.readouterr().out
    for words in ("10 shots", "14 shots", "one sphere", "one bar", "five spheres", "this cell"):
        assert words in printed
    assert {entry["n_shots"] for entry in told} == {10, 14}
    own = [entry for entry in told if entry["artefact"] == "this cell"]
    assert [(entry["n_spheres"], entry["n_lengths"]) for entry in own] == [(2, 1), (2, 1)]
    assert all(entry["length_rms_mm"] > 0 for entry in told)
    assert sorted(cell_path.parent.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--spheres", "A,Q"], 1, "no sphere 'Q'"),
        (["-n", "many"], 2, "'many' is no number of shots"),
        (["-n", "0"], 2, "'0' is no number of shots"),
    ],
)
def test_what_cannot_be_predicted_is_told(arguments: list[str], code: int, words: str, cell_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run_app(app, ["predict", str(cell_path), *arguments]) == code
    assert words in capfd.readouterr().err


def test_a_missing_calibration_is_told(cell_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for verb in ("predict", "plan"):
        assert run_app(app, [verb, str(cell_path), "--calibration", str(cell_path.parent / "none.yaml")]) == 1
        assert "none.yaml" in capfd.readouterr().err
