"""Where commands keep what they did, and what a history says beside later measurements."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import FileError
from measure.history.chart import chart_csv, chart_page, points_of
from measure.history.marks import marks_in, marks_of
from measure.history.recording import place_of, record_result
from measure.history.store import History, now_utc
from tests.support.history import CELL, file_of, named

DAYS = [f"2030-01-{day:02d}T08:00:00Z" for day in range(1, 29)]


@pytest.fixture
def history(tmp_path: Path) -> History:
    opened = History.open(str(tmp_path / "h.sqlite"))
    for number in (1, 2):
        opened.add_calibration(named(number), file_of(tmp_path, number))
    return opened


def checked(history: History, day: int, verdict: str, *causes: str) -> None:
    content = {"verdict": verdict, "named": list(causes), "chi_square": 30.0 + day, "freedom": 24, "p_value": 0.5, "rms_mm": 0.09}
    amplitudes = {"axis3_rad": {"value": 2e-4, "standard_uncertainty": 3e-5}}
    bump = {"rho_x_mm": {"value": 0.3, "standard_uncertainty": 0.02}, "rho_y_mm": {"value": 0.4, "standard_uncertainty": 0.02}}
    content |= {"causes": [{"cause": "axis 3", "amplitudes": amplitudes}, {"cause": "hand-eye", "amplitudes": bump}]}
    history.add_result("check", named(1), content, verdict=verdict, taken_utc=DAYS[day], software="tests")


def test_nothing_known_marks_nothing(history: History) -> None:
    assert marks_in(history, named(1), DAYS[3]) == []
    assert marks_of(None, named(1)) == []


def test_a_failed_check_marks_what_is_measured_after_it_until_one_passes(history: History) -> None:
    checked(history, 2, "conform")
    checked(history, 5, "reject", "axis 3")
    checked(history, 8, "conform")
    assert marks_in(history, named(1), DAYS[1]) == []
    # measured before the failed check, after the last good one: nobody knows when it changed
    assert marks_in(history, named(1), DAYS[3]) == [f"the first quick check after it failed ({DAYS[5][:16]}Z, axis 3)"]
    assert marks_in(history, named(1), DAYS[6]) == [f"the last quick check before it failed ({DAYS[5][:16]}Z, axis 3)"]
    assert marks_in(history, named(1), DAYS[9]) == []
    # a check that proves nothing clears nothing, and another calibration's check says nothing of this one
    checked(history, 11, "reject", "camera")
    checked(history, 12, "not_proven")
    assert len(marks_in(history, named(1), DAYS[13])) == 1
    assert marks_in(history, named(2), DAYS[13]) == []


def test_an_overdue_check_marks(history: History) -> None:
    history.set_check_every(CELL, 48.0)
    checked(history, 2, "conform")
    assert marks_in(history, named(1), DAYS[4]) == []
    assert marks_in(history, named(1), DAYS[5]) == ["the quick check is overdue: the last passed quick check is 72 h old, every 48 h is the rule"]
    (never,) = marks_in(history, named(2), DAYS[5])
    assert "never checked since" in never
    history.set_check_every(CELL, None)
    assert marks_in(history, named(2), DAYS[5]) == []


def test_another_calibration_than_the_one_in_use_marks(history: History) -> None:
    history.activate(named(2).id, why="")
    (mark,) = marks_in(history, named(1), now_utc())
    assert named(2).id[:12] in mark
    assert marks_in(history, named(2), now_utc()) == []
    assert marks_in(history, named(1), "2020-01-01T00:00:00Z") == []


def test_a_rejected_verification_marks(history: History) -> None:
    history.add_result("verification", named(1), {"verdict": "reject"}, verdict="reject", taken_utc=DAYS[1], software="tests")
    assert "was rejected" in marks_in(history, named(1), DAYS[2])[0]


def test_a_history_that_cannot_be_read_is_a_mark(tmp_path: Path) -> None:
    (tmp_path / "h.sqlite").write_text("no database at all, but some text\n" * 40)
    (mark,) = marks_of(str(tmp_path / "h.sqlite"), named(1))
    assert mark.startswith("the history could not be read")


def test_where_commands_look_for_a_history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPHERECAL_HISTORY", raising=False)
    beside = tmp_path / "calibration.yaml"
    assert place_of(None, beside) is None
    History.open(str(tmp_path / "history.sqlite"))
    assert place_of(None, beside) == str(tmp_path / "history.sqlite")
    assert place_of("none", beside) is None
    monkeypatch.setenv("SPHERECAL_HISTORY", "postgresql://host/db")
    assert place_of(None, beside) == "postgresql://host/db"
    assert place_of("other.sqlite", beside) == "other.sqlite"


def test_a_history_that_cannot_be_written_spoils_no_result(tmp_path: Path) -> None:
    told: list[str] = []
    kept = record_result(str(tmp_path / "no" / "h.sqlite"), "check", named(1), file_of(tmp_path, 1), {"verdict": "conform"}, told.append)
    assert kept is not None
    assert kept["recorded"] is False
    assert told[0].startswith("warning: not kept in the history")
    with pytest.raises(FileError):
        History.open(str(tmp_path / "no" / "h.sqlite"))


def test_two_causes_changes_since_and_training_data_are_told_in_the_rows(history: History) -> None:
    pairs = [{"causes": ["axis 3", "sphere moved"], "probability": 0.8}]
    contents: list[dict[str, object]] = [
        {"named": ["axis 3"], "together": {"log_odds": 9.0, "pairs": pairs}},
        {"named": [], "together": None, "since": {"earlier": "check_0001", "named": ["axis 5"], "together": None}},
        {"named": [], "remark": "TRAINING DATA USED"},
    ]
    for day, content in enumerate(contents):
        history.add_result("check", named(1), content, verdict="reject", taken_utc=DAYS[day], software="tests")
    rows = history.results(CELL, "check")
    assert [row.changed for row in rows] == ["axis 3 and sphere moved", "axis 5 since check_0001", ""]
    assert [row.remark for row in rows] == ["", "", "TRAINING DATA USED"]
    assert [point.named for point in points_of(rows)] == [row.changed for row in rows]


def test_the_chart_tells_every_check(history: History) -> None:
    checked(history, 2, "conform")
    checked(history, 5, "reject", "axis 3")
    points = points_of(history.results(CELL, "check"))
    head, first, second = chart_csv(points).splitlines()
    assert head.split(",")[-4:] == ["axis 3 mrad", "axis 3 u mrad", "hand-eye mm", "hand-eye u mm"]
    assert first.split(",")[:4] == [DAYS[2], named(1).id, "conform", ""]
    # 3-4-5: the amount of a bump is its length
    assert second.split(",")[-4:] == ["0.2", "0.03", "0.5", "0.02"]
    page = chart_page(CELL, points, history.calibrations(CELL), history.activations(CELL), 24.0, "tests")
    assert "<svg" in page
    assert page.count("<td>reject</td>") == 1
    assert not any(asks in page for asks in ('src="', "<link", 'href="http'))
    assert "No quick check yet" in chart_page(CELL, [], (), (), None, "tests")
