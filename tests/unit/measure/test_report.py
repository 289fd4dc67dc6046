"""The report: self-contained, escaped, complete in all its variants, and true to the figures it is given."""

from __future__ import annotations

import datetime
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, Limits
from calibrate.result import Calibration
from drivers.errors import FileError
from drivers.files.session import Session
from measure.report import write_page, write_report
from measure.report_facts import facts_of
from measure.report_text import next_steps_of, remarks_of
from measure.verify import verify
from measure.verify_result import VerifyResult
from tests.support.recorded import TrueSystem, nominal_calibration, record_session, write_cell
from tests.support.synthetic import paper_cell

VOID = {"meta", "br", "img", "link", "hr", "input"}


class Reader(HTMLParser):
    """Collects the text, and complains about tags that do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text.append(data)


def read(path: Path) -> tuple[str, set[str]]:
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    reader.close()
    assert reader.open == []
    return re.sub(r"\s+", " ", " ".join(reader.text)), reader.tags


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return write_cell(tmp_path_factory.mktemp("cell"))


@pytest.fixture(scope="module")
def session(cell: Cell) -> Session:
    return record_session(cell.folder / "calib", cell, np.random.default_rng(1), shots_per_sphere=4, purpose="calibration")


@pytest.fixture(scope="module")
def calibration(cell: Cell, session: Session) -> Calibration:
    return nominal_calibration(cell, [session])


@pytest.fixture(scope="module")
def verification(cell: Cell) -> VerifyResult:
    unseen = record_session(cell.folder / "verif", cell, np.random.default_rng(2), shots_per_sphere=5)
    return verify(TrueSystem(paper_cell()), [unseen])


def test_the_page_needs_nothing_but_itself(calibration: Calibration, verification: VerifyResult, cell: Cell, tmp_path: Path) -> None:
    path = write_report(tmp_path / "report.html", calibration, verification, cell=cell)
    html = path.read_text(encoding="utf-8")
    _, tags = read(path)
    assert not {"script", "link", "img", "iframe", "object"} & tags
    links = re.findall(r'(?:href|src)="([^"]*)"', html) + re.findall(r"url\(([^)]*)\)", html)
    assert all(link.startswith(("#", "data:")) for link in links)
    assert html.count("<svg") == 11


def test_the_same_goes_to_machines_and_other_calibrations_stand_beside(
    calibration: Calibration, verification: VerifyResult, cell: Cell, tmp_path: Path
) -> None:
    path = write_report(tmp_path / "report.html", calibration, verification, cell=cell, others=[("by <hand>", verification)])
    data = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert data["format"] == "spherecal-report/1"
    assert data["verification"]["verdict"] == verification.verdict
    assert len(data["calibration"]["shots"]) == len(calibration.shots)
    assert list(data["others"]) == ["by <hand>"]
    text, _ = read(path)
    assert "by <hand>" in text
    assert "Every shot of the calibration" in text


def test_it_says_what_was_found(calibration: Calibration, verification: VerifyResult, cell: Cell, session: Session, tmp_path: Path) -> None:
    text, _ = read(write_report(tmp_path / "report.html", calibration, verification, cell=cell, session_names={session.digest: "calib"}))
    figures = verification.figures
    assert figures.centre_rms_mm is not None
    assert verification.before is not None
    assert verification.before.centre_rms_mm is not None
    for value in (figures.centre_rms_mm, verification.before.centre_rms_mm, figures.radial_rms_mm):
        assert f"{value:.3f} mm" in text
    length = verification.lengths[0]
    for shown in (f"{length.measured_mm:.3f}", f"{length.error_mm:+.3f}", f"{length.expanded_uncertainty_mm:.3f}"):
        assert shown in text
    assert calibration.id in text
    assert session.digest in text
    assert all(reason in text for reason in verification.reasons)
    assert "calib 99 coverage: the cap <is> too small" in text
    assert "none 0.200, pillow 0.060" in text


def test_training_data_are_told_on_every_sheet_of_paper(calibration: Calibration, verification: VerifyResult, tmp_path: Path) -> None:
    """The head of a table that holds the whole page stands on each; without training data there is none."""
    pages = [
        write_report(tmp_path / f"{held_out}.html", calibration, replace(verification, held_out=held_out)).read_text() for held_out in (True, False)
    ]
    body = [page[page.index("<body>") :] for page in pages]
    assert [page.count('<div class="marked"><p class="every-page">TRAINING DATA USED') for page in body] == [0, 1]
    assert "table-header-group; break-inside: avoid" in pages[1]


def test_a_page_is_no_larger_than_its_pictures_need(calibration: Calibration, verification: VerifyResult, tmp_path: Path) -> None:
    """Maps of thousands of fields are pictures: as drawn fields they were two thirds of a page of a megabyte."""
    text = write_report(tmp_path / "report.html", calibration, verification).read_text()
    figures = re.findall(r"<figure.*?</figure>", text, re.DOTALL)
    assert len(figures) >= 8
    assert max(len(figure) for figure in figures) < 120_000
    form = next(figure for figure in figures if "Form of the spheres" in figure)
    assert "<image" in form
    assert form.count("<path") < 100


def test_text_from_files_cannot_become_markup(calibration: Calibration, cell: Cell, tmp_path: Path) -> None:
    evil = replace(without_pictures(calibration), cell_name="<script>alert(1)</script>")
    path = write_report(tmp_path / "report.html", evil, cell=cell)
    assert "<script" not in path.read_text(encoding="utf-8")
    assert "<script>alert(1)</script>" in read(path)[0]


@pytest.mark.parametrize(("verdict", "headline"), [("pass", "not yet verified"), ("marginal", "marginal"), ("fail", "failed")])
def test_a_calibration_alone_is_never_called_conform(calibration: Calibration, verdict: str, headline: str, tmp_path: Path) -> None:
    text, _ = read(write_report(tmp_path / "report.html", replace(without_pictures(calibration), verdict=verdict)))
    assert headline in text
    assert "Conform" not in text
    assert "No verification was given" in text


def test_drivers_without_a_signed_hardware_log_are_remarked_without_any_cell(calibration: Calibration, tmp_path: Path) -> None:
    """The calibration's own file names them, so a report of it alone says so too."""
    of_abb = replace(without_pictures(calibration), inputs={**calibration.inputs, "drivers": {"robot": "abb_socket", "camera": "recorded"}})
    page = write_report(tmp_path / "report.html", of_abb)
    sentence = "The driver abb_socket has never run on hardware"
    assert sentence in read(page)[0]
    (remark,) = json.loads(page.with_suffix(".json").read_text())["remarks"]
    assert remark.startswith(sentence)


def test_simulated_cells_and_training_data_are_remarked(calibration: Calibration, verification: VerifyResult, tmp_path: Path) -> None:
    assert remarks_of(facts_of(calibration), verification) == ()
    (untried,) = remarks_of(replace(facts_of(calibration), untried_drivers=("abb_socket",)), verification)
    assert "abb_socket has never run on hardware" in untried
    simulated = replace(calibration, identity={"camera_serial": "simulated"})
    remarks = remarks_of(facts_of(simulated), replace(verification, held_out=False))
    assert "never from hardware" in remarks[0]
    assert "figures flatter" in remarks[1]
    assert "never from hardware" in read(write_report(tmp_path / "report.html", without_pictures(simulated)))[0]


def without_pictures(calibration: Calibration) -> Calibration:
    """Drawing takes most of the time, and not every test looks at it."""
    return replace(calibration, shots=(), camera_mm=np.zeros(0))


def test_bare_facts_make_a_page_too(calibration: Calibration, verification: VerifyResult, tmp_path: Path) -> None:
    """No limits, no first guess, no lengths, no camera model, no shots."""
    facts = replace(facts_of(calibration), limits=None, shots=(), camera_field=None, seen_mm=None, cross_validated_rms_mm=None, rejected=())
    bare = replace(verification, before=None, lengths=(), before_length_errors_mm={}, limits=None, judgements=(), verdict="not_proven", reasons=())
    text, _ = read(write_page(tmp_path / "report.html", facts, bare))
    assert "Not proven" in text
    assert "no uncalibrated system to compare with" in text
    assert "none" in text


def test_a_robot_without_a_camera_is_not_sent_to_verify(calibration: Calibration, tmp_path: Path) -> None:
    """Of external points alone there is nothing that `verify` could look through, and no picture."""
    facts = replace(facts_of(calibration), verdict="pass", shots=(), camera_field=None, seen_mm=None, error_budget=None, robot_alone=True)
    text, _ = read(write_page(tmp_path / "report.html", facts, None))
    assert "Export the corrected robot" in text
    assert "spherecal verify" not in text
    assert "Pictures" not in text


def test_limits_are_asked_for_only_where_there_are_none(calibration: Calibration, verification: VerifyResult) -> None:
    given = replace(verification, verdict="not_proven", limits=Limits(centre_rms_mm=0.2, length_error_mm=0.2, diameter_error_mm=0.1, form_mm=0.3))
    assert not any("limits" in step for step in next_steps_of(facts_of(calibration), given))
    assert any("limits" in step for step in next_steps_of(facts_of(calibration), replace(given, limits=None)))


def test_models_that_could_not_be_compared_are_named_alone(calibration: Calibration) -> None:
    statistics = replace(calibration.statistics, compared={"none": None, "pillow": 0.06})  # type: ignore[dict-item]
    assert "none, pillow 0.060" in facts_of(replace(calibration, statistics=statistics)).camera_error


def test_the_same_facts_give_the_same_bytes(calibration: Calibration, tmp_path: Path) -> None:
    moment = datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC)
    one, two = (write_page(tmp_path / name, facts_of(calibration), now=moment).read_bytes() for name in ("a.html", "b.html"))
    assert one == two
    assert b"2026-01-02 00:00 UTC" in one


def test_line_profiles_show_radial_figures(calibration: Calibration, tmp_path: Path) -> None:
    arcs = tuple(replace(shot, centre_in_base_mm=None, predicted_error_mm=None) for shot in calibration.shots)
    text, _ = read(write_report(tmp_path / "report.html", replace(calibration, shots=arcs)))
    assert "radial rms, mm" in text


def test_a_missing_folder_is_told(calibration: Calibration, tmp_path: Path) -> None:
    with pytest.raises(FileError):
        write_report(tmp_path / "none" / "report.html", calibration)
