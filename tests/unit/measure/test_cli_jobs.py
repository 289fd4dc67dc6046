"""`spherecal jobs`: what it prints, its exit codes, and what it refuses before anything is begun."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

import measure.cli_jobs
from measure.cli import app
from measure.cli_run import run_app
from measure.jobs.model import Order, Outcome
from tests.support.job_works import light
from tests.support.jobs import InPlace, Parts, make_parts


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return make_parts(tmp_path_factory.mktemp("jobs"), 3, 1, seed=5)


@pytest.fixture(autouse=True)
def in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs are done in this process; worker processes have tests of their own."""
    monkeypatch.setattr(measure.cli_jobs, "_executor", lambda *_arguments: InPlace(light))


def run(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, object]]:
    capfd.readouterr()
    code = run_app(app, ["jobs", *map(str, arguments), "--json"])
    printed: dict[str, object] = json.loads(capfd.readouterr().out)
    return code, printed


def error_of(printed: dict[str, object]) -> str:
    error = printed["error"]
    assert isinstance(error, dict)
    return f"{error['where']}: {error['message']}. {error['remedy']}"


def test_run_then_status(parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["run", parts.folder, "--calibration", parts.calibration, "-o", out, "--once", "--settle", 0, "--poll", 0.05]
    code, printed = run(capfd, *arguments)
    assert code == 3
    assert (printed["done"], printed["failed"], printed["skipped"]) == (2, 1, 0)
    assert {"dead_letters", "waiting", "seconds", "interrupted"} <= set(printed)
    code, again = run(capfd, *arguments)
    assert code == 3, "a part that is given up stands until somebody repairs it"
    assert (again["done"], again["failed"], again["skipped"]) == (0, 0, 3)
    code, printed = run(capfd, "status", out)
    assert code == 0
    assert (printed["n_done"], printed["n_dead"], printed["is_running"]) == (2, 1, False)
    assert "2 parts measured, 1 given up" in (out / "throughput.html").read_text(encoding="utf-8")


def test_a_list_ends_when_its_parts_are_settled(parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text(f"{parts.folder / parts.good[0]}\n", encoding="utf-8")
    code, printed = run(capfd, "run", listed, "--calibration", parts.calibration, "-o", tmp_path / "out", "--settle", 0)
    assert (code, printed["done"]) == (0, 1)


def test_stopped_by_a_signal_it_tells_what_is_done_and_left(
    parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopping(order: Order) -> Outcome:
        signal.raise_signal(signal.SIGTERM)
        return light(order)

    monkeypatch.setattr(measure.cli_jobs, "_executor", lambda *_arguments: InPlace(stopping))
    code, printed = run(capfd, "run", parts.folder, "--calibration", parts.calibration, "-o", tmp_path / "out", "--settle", 0)
    assert code == 130
    assert printed["interrupted"] is True
    assert int(str(printed["done"])) + int(str(printed["failed"])) == 1
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"parts": "nothing here"}, "no such folder or list"),
        ({"--calibration": "missing.yaml"}, "no such file"),
        ({"--voxel": "0"}, "not a positive number"),
        ({"--spec": "inspection.yaml"}, "a specification without a mesh"),
        ({"--cell": "missing.yaml"}, "no such file"),
    ],
)
def test_what_cannot_be_is_told_before_anything_begins(
    parts: Parts, tmp_path: Path, capfd: pytest.CaptureFixture[str], changed: dict[str, str], told: str
) -> None:
    options = {"--calibration": str(parts.calibration), "-o": str(tmp_path / "out"), **changed}
    place = options.pop("parts", str(parts.folder))
    code, printed = run(capfd, "run", place, "--once", *(word for pair in options.items() for word in pair))
    assert code == 1
    assert told in error_of(printed)
    assert not (tmp_path / "out" / "journal.jsonl").exists()


def test_status_of_nothing_is_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(capfd, "status", tmp_path)[0] == 1


@pytest.mark.parametrize("verb", ["run", "status"])
def test_help_fits(verb: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run_app(app, ["jobs", verb, "--help"]) == 0
    out = capfd.readouterr().out
    assert all(flag in out for flag in ("--json", "--debug", "--quiet"))
    assert max(len(line) for line in out.splitlines()) <= 80
