"""What `spherecal study` writes: complete files, one self-contained page, a folder that is never replaced by mistake."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

import calibrate.study
import measure.study_page
from calibrate.study import QUICK, Progress, Study, StudySettings
from measure.cli import app
from measure.cli_run import run_app
from measure.study_page import PAGE, is_study, write_study
from measure.study_text import SECTIONS
from tests.support.once import once_a_run
from tests.support.study import tiny_study


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return tiny_study(tmp_path_factory)


@pytest.fixture(scope="module")
def folder(study: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return once_a_run(tmp_path_factory, "study_page", lambda made: write_study(study, made).parent)


class Reader(HTMLParser):
    """Collects links and text, and complains about tags that do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag not in {"script", "link", "iframe"}
        self.sources += [value or "" for name, value in attrs if name in {"src", "href"}]
        if tag not in {"meta", "img", "br"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def test_the_page_is_whole_and_self_contained(folder: Path, study: Study) -> None:
    reader = Reader()
    reader.feed((folder / PAGE).read_text(encoding="utf-8"))
    reader.close()
    assert not reader.open
    assert len(reader.sources) == len(study.figures)
    assert all(source.startswith("data:image/png;base64,") for source in reader.sources)
    text = re.sub(r"\s+", " ", " ".join(reader.text))
    for printed in ("0.263", "134.8", "0.123", "1.350", "Can agree.", "Cannot agree.", "Table 2: not compared"):
        assert printed in text


def test_every_table_and_figure_is_on_the_page(study: Study) -> None:
    assert {name for section in SECTIONS for name in section.tables} == {table.name for table in study.tables}
    assert {name for section in SECTIONS for name in section.figures} == {figure.name for figure in study.figures}


def test_tables_and_curves_are_written_with_full_precision(folder: Path, study: Study) -> None:
    for table in study.tables:
        with (folder / f"{table.name}.csv").open(newline="", encoding="utf-8") as stream:
            head, *rows = list(csv.reader(stream))
        assert tuple(head) == table.columns
        assert len(rows) == len(table.rows)
        for cells, row in zip(rows, table.rows, strict=True):
            for text, cell in zip(cells, row, strict=True):
                assert float(text) == cell if isinstance(cell, float) else text == ("" if cell is None else str(cell))
    for figure in study.figures:
        assert (folder / f"{figure.name}.png").read_bytes().startswith(b"\x89PNG")
        lines = (folder / f"{figure.name}_curves.csv").read_text(encoding="utf-8").splitlines()
        assert len(lines) == 1 + sum(len(curve.x) for panel in figure.panels for curve in panel.curves)


def test_the_command_writes_tells_and_replaces_only_a_former_study(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    asked: list[StudySettings] = []

    def run(settings: StudySettings, progress: Progress) -> Study:
        asked.append(settings)
        progress(1, 1)
        return study

    monkeypatch.setattr(calibrate.study, "run_study", run)
    monkeypatch.setattr(measure.study_page, "figure_png", lambda figure: figure.name.encode())
    out = tmp_path / "s"
    assert run_app(app, ["study", "--quick", "--seed", "7", "--out", str(out), "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["seed"], told["quick"], told["out"]) == (7, True, str(out))
    assert len(told["tables"]["table3"]) == 6
    assert told["tables"]["table3"][0]["paper_e_mean_mm"] == 0.2629
    assert is_study(out)
    assert run_app(app, ["study", "--out", str(out)]) == 0
    assert "Table 3" in capfd.readouterr().out
    assert asked == [replace(QUICK, seed=7), StudySettings()]
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("precious")
    assert run_app(app, ["study", "--quick", "--out", str(other)]) == 1
    assert "no former study" in capfd.readouterr().err
    assert (other / "mine.txt").read_text() == "precious"
    assert run_app(app, ["study", "--quick", "--out", str(tmp_path / "no" / "such")]) == 1
    assert len(asked) == 2
