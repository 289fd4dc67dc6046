"""The runner: every good part once, every bad one told, whatever happens in between."""

from __future__ import annotations

import datetime
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibrate.result import Calibration
from drivers.errors import FileError
from drivers.files.ply import read_ply
from drivers.files.session import read_session
from measure.gauge.correlation import Correlation, Offset, save_correlation
from measure.history.store import History
from measure.jobs import outputs
from measure.jobs import runner as runner_module
from measure.jobs import work as work_module
from measure.jobs.failures import TOO_LARGE, UNFINISHED, failure_of
from measure.jobs.inspection import record_inspection
from measure.jobs.journal import Event, Journal, read_state
from measure.jobs.memory import estimated_mb
from measure.jobs.model import Files, Order, Outcome, Recipe
from measure.jobs.outputs import attempt_folder, clear_abandoned, commit
from measure.jobs.parts import MARKER
from measure.part import CLOUD_FILE
from measure.stitch import stitch
from tests.support.job_works import light, moody
from tests.support.jobs import DAMAGE, InPlace, Parts, draw_ball, make_parts, read_lines, run_jobs, without_joints

EXPECTED = {
    "truncated scan": "is cut off",
    "only NaN": "no point is left",
    "no joints": "no joints",
    "broken line": "broken JSON",
    "other camera": "the camera's serial number is CAM-2",
    "no shots": "no good scan",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Parts:
    return make_parts(tmp_path_factory.mktemp("jobs"), 8, len(DAMAGE), seed=4)


@pytest.fixture
def parts(made: Parts, tmp_path: Path) -> Parts:
    """A copy of all parts that a test may change."""
    folder = Path(shutil.copytree(made.folder, tmp_path / "parts"))
    return Parts(folder, made.calibration, made.good, made.spoiled)


@pytest.fixture
def good(made: Parts, tmp_path: Path) -> Parts:
    """The two good parts alone."""
    for name in made.good:
        shutil.copytree(made.folder / name, tmp_path / "good" / name)
    return Parts(tmp_path / "good", made.calibration, made.good, {})


def names(folder: Path) -> list[str]:
    return sorted(path.name.rpartition("-")[0] for path in folder.iterdir())


def test_good_parts_are_measured_once_and_spoiled_ones_told(parts: Parts, tmp_path: Path) -> None:
    out = tmp_path / "out"
    summary = run_jobs(parts, out)
    assert (summary.done, summary.failed, summary.skipped) == (2, 6, 0)
    assert names(out / "results") == sorted(parts.good)
    assert names(out / "dead_letters") == sorted(parts.spoiled)
    for letter in summary.dead_letters:
        assert EXPECTED[parts.spoiled[str(letter["part"])]] in str(letter["reason"])
        stored = json.loads((out / "dead_letters" / f"{letter['part']}-{letter['job']}.json").read_text(encoding="utf-8"))
        assert stored["attempts"] == 1
        assert stored["remedy"]
    executor = InPlace()
    again = run_jobs(parts, out, executor)
    assert (again.done, again.failed, again.skipped) == (0, 0, 8)
    assert again.dead_letters == summary.dead_letters
    assert executor.orders == []


def test_a_result_is_what_stitch_writes_and_names_its_calibration(good: Parts, tmp_path: Path) -> None:
    run_jobs(good, tmp_path / "out")
    calibration = Calibration.load(good.calibration)
    for folder in (tmp_path / "out" / "results").iterdir():
        part = folder.name.rpartition("-")[0]
        session = read_session(good.folder / part)
        stitch(calibration, session, tmp_path / "direct.ply")
        assert (folder / CLOUD_FILE).read_bytes() == (tmp_path / "direct.ply").read_bytes()
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        assert result["calibration"]["id"] == calibration.id
        assert result["inputs"]["digest"] == session.digest
        assert result["last_check"] is None
        assert result["marks"] == []


def test_a_failed_or_overdue_check_marks_the_result_that_names_it(good: Parts, tmp_path: Path) -> None:
    """One after the other in the same history: none yet, a good one, an overdue one, a failed one."""
    shutil.rmtree(good.folder / good.good[1])
    calibration = Calibration.load(good.calibration)
    place = str(tmp_path / "history.sqlite")

    def result(voxel_mm: float) -> tuple[dict[str, object] | None, str]:
        summary = run_jobs(good, tmp_path / "out", history=place, recipe=Recipe(calibration.id, voxel_mm))
        found = max((tmp_path / "out" / "results").glob("*/result.json"), key=lambda path: path.stat().st_mtime_ns)
        data = json.loads(found.read_text(encoding="utf-8"))
        assert summary.marked == (1 if data["marks"] else 0)
        return data["last_check"], " ".join(data["marks"])

    def checked(taken_utc: str, verdict: str) -> None:
        with History.open(place) as history:
            history.add_calibration(calibration, good.calibration)
            content = {"verdict": verdict, "taken": taken_utc}
            history.add_result("check", calibration, content, verdict=verdict, taken_utc=taken_utc, software="test")

    assert result(0.5) == (None, "")
    taken = str(read_lines(good.folder / good.good[0])[0]["time_utc"])
    old = (datetime.datetime.fromisoformat(taken) - datetime.timedelta(hours=30)).isoformat()
    checked(old, "conform")
    assert result(0.6) == ({"taken_utc": old, "verdict": "conform"}, "")
    with History.open(place) as history:
        history.set_check_every(calibration.cell_name, 24.0)
    assert "overdue" in result(0.7)[1]
    checked(taken, "reject")
    last, marks = result(0.8)
    assert last == {"taken_utc": taken, "verdict": "reject"}
    assert "failed" in marks


def test_a_repaired_part_is_found_anew_and_its_dead_letter_goes(parts: Parts, made: Parts, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_jobs(parts, out)
    for name, damage in parts.spoiled.items():
        if damage in ("no joints", "truncated scan"):  # other inputs, and the same inputs with another file
            shutil.rmtree(parts.folder / name)
            shutil.copytree(made.folder / parts.good[0], parts.folder / name)
    summary = run_jobs(parts, out)
    assert (summary.done, summary.failed, summary.skipped) == (2, 0, 6)
    assert len(summary.dead_letters) == 4
    assert len(names(out / "dead_letters")) == 4


def test_a_truncated_scan_that_is_restored_needs_no_flag(good: Parts, tmp_path: Path) -> None:
    scan = good.folder / good.good[0] / "scans" / "0000.ply"
    data = scan.read_bytes()
    scan.write_bytes(data[:-9])
    assert run_jobs(good, tmp_path / "out").failed == 1
    assert run_jobs(good, tmp_path / "out").failed == 0
    scan.write_bytes(data)
    assert run_jobs(good, tmp_path / "out").done == 1
    assert names(tmp_path / "out" / "dead_letters") == []


def test_another_setting_makes_other_jobs(good: Parts, tmp_path: Path) -> None:
    calibration_id = Calibration.load(good.calibration).id
    assert run_jobs(good, tmp_path / "out", InPlace(light)).done == 2
    assert run_jobs(good, tmp_path / "out", InPlace(light), recipe=Recipe(calibration_id, voxel_mm=1.0)).done == 2
    assert run_jobs(good, tmp_path / "out", InPlace(light)).done == 0
    assert len(names(tmp_path / "out" / "results")) == 4


def called(good: Parts, *words: str) -> Parts:
    """Parts whose names tell `moody` what to do."""
    for word in words:
        shutil.copytree(good.folder / good.good[0], good.folder / f"{word}-1")
    for name in good.good:
        shutil.rmtree(good.folder / name)
    return good


def test_what_may_pass_is_tried_again_and_then_given_up(good: Parts, tmp_path: Path) -> None:
    executor = InPlace(moody)
    summary = run_jobs(called(good, "passes", "fails", "fine"), tmp_path / "out", executor)
    assert (summary.done, summary.failed, summary.retried) == (2, 1, 2 + 3)
    attempts = [(order.job.part, order.attempt) for order in executor.orders]
    assert sorted(attempts) == [*[("fails-1", n) for n in (1, 2, 3, 4)], ("fine-1", 1), *[("passes-1", n) for n in (1, 2, 3)]]
    state = read_state(tmp_path / "out")
    assert state.retries["disk or network"] == 5
    assert run_jobs(good, tmp_path / "out", InPlace(moody), retry_dead=True).failed == 1


@pytest.mark.parametrize(
    ("error", "transient"),
    [
        (OSError(5, "Input/output error"), True),
        (OSError(2, "No such file or directory"), False),
        (MemoryError(), True),
        (FileError("cannot be written"), False),
        (LookupError("bug"), False),
    ],
)
def test_errors_are_judged_by_what_caused_them(error: Exception, transient: bool) -> None:
    assert failure_of(error).transient is transient
    wrapped = FileError("the scan cannot be read", file="scans/0001.ply", remedy="Look.")
    wrapped.__cause__ = error
    assert failure_of(wrapped).transient is transient


def test_jobs_in_flight_share_the_memory_and_a_larger_one_is_told(good: Parts, tmp_path: Path) -> None:
    one = estimated_mb([path.stat().st_size for path in (good.folder / good.good[0] / "scans").iterdir()], 1)
    for i in range(4):
        shutil.copytree(good.folder / good.good[0], good.folder / f"more{i}")
    executor = InPlace(light, n_workers=6)
    assert run_jobs(good, tmp_path / "two", executor, memory_mb=2.5 * one).done == 6
    assert executor.most_flying == 2
    summary = run_jobs(good, tmp_path / "none", InPlace(light), memory_mb=0.5 * one)
    assert {letter["category"] for letter in summary.dead_letters} == {TOO_LARGE}
    assert summary.failed == 6


def test_incomplete_parts_are_named_and_at_last_given_up(good: Parts, tmp_path: Path) -> None:
    shots = good.folder / good.good[0] / "shots.jsonl"
    shots.write_bytes(shots.read_bytes()[:-30])
    summary = run_jobs(good, tmp_path / "out", InPlace(light))
    assert (summary.done, [Path(str(part["source"])).name for part in summary.waiting]) == (1, [good.good[0]])
    late = run_jobs(good, tmp_path / "out", InPlace(light), give_up_after_s=0.0)
    assert [letter["category"] for letter in late.dead_letters] == [UNFINISHED]
    (good.folder / good.good[0] / MARKER).touch()
    assert run_jobs(good, tmp_path / "out", InPlace(light)).failed == 1  # now the job itself tells what is broken


class Killed(BaseException):
    """What kill -9 is to a test: nothing of the run goes on behind it."""


def killed_at(monkeypatch: pytest.MonkeyPatch, moment: int) -> None:
    """End the run at its `moment`th step that touches the disk, before the step or behind it in turn."""
    steps = 0

    def stepping(function: Callable[..., object]) -> Callable[..., object]:
        def step(*arguments: object, **options: object) -> object:
            nonlocal steps
            steps += 1
            if steps == moment:
                raise Killed
            result = function(*arguments, **options)
            steps += 1
            if steps == moment:
                raise Killed
            return result

        return step

    monkeypatch.setattr(Journal, "write", stepping(Journal.write))
    monkeypatch.setattr(runner_module, "write_dead_letter", stepping(outputs.write_dead_letter))
    monkeypatch.setattr(runner_module, "remove_dead_letter", stepping(outputs.remove_dead_letter))
    monkeypatch.setattr("tests.support.job_works.commit", stepping(commit))


@pytest.mark.parametrize("stride", [5, pytest.param(1, marks=pytest.mark.qualify)])
def test_killed_at_every_step_nothing_is_lost_or_done_twice(good: Parts, tmp_path: Path, stride: int) -> None:
    """Two good parts, one that fails for good, one that passes at the second attempt; the run ends at step 1, 1 + stride, ..."""
    without_joints(Path(shutil.copytree(good.folder / good.good[0], good.folder / "broken")))
    (good.folder / "broken" / "scans" / "0000.ply").write_bytes(b"")
    shutil.copytree(good.folder / good.good[0], good.folder / "passes")

    def work(order: Order) -> Outcome:
        return light(order) if order.job.part != "passes" or order.attempt > 1 else Outcome(0.0, "", failure_of(OSError(5, "I/O")))

    for moment in range(1, 200, stride):
        out = tmp_path / f"out{moment}"
        with pytest.MonkeyPatch.context() as patch:
            killed_at(patch, moment)
            try:
                run_jobs(good, out, InPlace(work))
                break
            except Killed:
                pass
        run_jobs(good, out, InPlace(work))
        check_whole(out, [*good.good, "passes"], ["broken"])
    assert moment > 40


@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.qualify)])
def test_killed_at_every_step_of_a_second_chance_the_dead_letter_goes(good: Parts, tmp_path: Path, stride: int) -> None:
    """A truncated scan is restored; the run that finds the part anew ends at step 1 + stride, 1 + 2 stride, ..."""
    shutil.rmtree(good.folder / good.good[1])
    scan = good.folder / good.good[0] / "scans" / "0000.ply"
    data, moment = scan.read_bytes(), 0
    while not (tmp_path / f"out{moment}" / "whole").exists():
        moment += stride
        out = tmp_path / f"out{moment}"
        scan.write_bytes(data[:-9])
        assert run_jobs(good, out, InPlace(light)).failed == 1
        scan.write_bytes(data)
        with pytest.MonkeyPatch.context() as patch:
            killed_at(patch, moment)
            try:
                run_jobs(good, out, InPlace(light))
                (out / "whole").touch()
            except Killed:
                run_jobs(good, out, InPlace(light))
        assert names(out / "results") == [good.good[0]]
        assert names(out / "dead_letters") == []
        assert [record.state for record in read_state(out).jobs.values()] == ["done"]
    assert moment > 8


def check_whole(out: Path, done: list[str], dead: list[str]) -> None:
    assert names(out / "results") == sorted(done)
    assert names(out / "dead_letters") == sorted(dead)
    assert list((out / "work").iterdir()) == []
    events: list[Event] = [json.loads(line) for line in (out / "journal.jsonl").read_text(encoding="utf-8").splitlines()]
    jobs = {str(event["job"]): str(event["part"]) for event in events if event["event"] == "found"}
    assert sorted(jobs[str(event["job"])] for event in events if event["event"] == "done") == sorted(done)
    assert sorted(jobs[str(event["job"])] for event in events if event["event"] == "dead") == sorted(dead)


def test_of_two_attempts_the_first_to_end_counts_and_the_living_are_not_cleared(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "results").mkdir()
    final = tmp_path / "results" / "p-1"
    with attempt_folder(tmp_path, "p-1") as first, attempt_folder(tmp_path, "p-1") as second:
        (first / "result.json").write_text("first", encoding="utf-8")
        (second / "result.json").write_text("second", encoding="utf-8")
        assert clear_abandoned(tmp_path) == 0
        assert commit(first, final)
        assert not commit(second, final)
    assert (final / "result.json").read_text(encoding="utf-8") == "first"
    (tmp_path / "work" / "p-2.left.tmp").mkdir()
    assert clear_abandoned(tmp_path) == 1
    assert list((tmp_path / "work").iterdir()) == []


def test_an_input_that_changes_under_the_work_is_looked_at_again(good: Parts, tmp_path: Path) -> None:
    changed: list[str] = []

    def work(order: Order) -> Outcome:
        if not changed and order.job.part == good.good[0]:
            changed.append(order.job.part)
            shots = order.job.source / "shots.jsonl"
            shots.write_bytes(shots.read_bytes().splitlines(keepends=True)[0])
        return work_module.measure_part(order)

    summary = run_jobs(good, tmp_path / "out", InPlace(work))
    assert (summary.done, summary.dead_letters) == (2, [])
    assert len(names(tmp_path / "out" / "results")) == 2


def test_told_to_stop_it_ends_after_the_jobs_at_work(good: Parts, tmp_path: Path) -> None:
    runners: list[runner_module.Runner] = []

    def stopping(order: Order) -> Outcome:
        runners[0].stop()
        return light(order)

    summary = run_jobs(good, tmp_path / "out", InPlace(stopping), on_made=runners.append)
    assert summary.interrupted
    assert (summary.done, len(summary.waiting)) == (1, 1)
    assert run_jobs(good, tmp_path / "out", InPlace(light)).done == 1


def test_scans_with_poses_are_measured_like_the_session_they_came_from(good: Parts, tmp_path: Path) -> None:
    session = read_session(good.folder / good.good[0])
    folder = good.folder / "loose"
    shutil.copytree(session.folder / "scans", folder / "clouds")
    lines = ["file,j1,j2,j3,j4,j5,j6"]
    lines += [
        ",".join([Path(str(shot.scan)).name, *(f"{angle:.12f}" for angle in np.degrees(np.asarray(shot.joints_rad)))]) for shot in session.shots
    ]
    (folder / "poses.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    calibration = Calibration.load(good.calibration)
    files = Files(good.calibration, cell=session.cell_path)
    summary = run_jobs(good, tmp_path / "out", recipe=Recipe(calibration.id, cell_sha256="c" * 64), files=files)
    assert (summary.done, summary.dead_letters) == (3, [])
    clouds = [read_ply(next((tmp_path / "out" / "results").glob(f"{name}-*")) / CLOUD_FILE) for name in ("loose", good.good[0])]
    np.testing.assert_allclose(clouds[0].points_mm, clouds[1].points_mm, atol=1e-4)
    # without a cell file nobody can tell which robot it was
    assert "scans and poses without a session" in str(run_jobs(good, tmp_path / "none").dead_letters)


def test_with_a_mesh_a_part_is_inspected_and_kept_in_the_history(good: Parts, tmp_path: Path) -> None:
    shutil.rmtree(good.folder / good.good[1])
    mesh, spec = draw_ball(tmp_path)
    offset = Offset(-0.5, 0.01, 0.01, 5, 1.0, slope_is_one=True)
    save_correlation(Correlation({"ball": offset}), tmp_path / "correlation.yaml")
    calibration = Calibration.load(good.calibration)
    files = Files(good.calibration, nominal=mesh, spec=spec, correlation=tmp_path / "correlation.yaml", judge_corrected=True)
    place = str(tmp_path / "history.sqlite")

    def keep(folder: Path) -> None:
        record_inspection(place, calibration, good.calibration, folder)

    recipe = Recipe(calibration.id, nominal_sha256="m" * 64)
    summary = run_jobs(good, tmp_path / "out", recipe=recipe, files=files, history=place, recorder=keep)
    assert (summary.done, summary.dead_letters) == (1, [])
    verdicts = {}
    for folder in (tmp_path / "out" / "results").iterdir():
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        written = json.loads((folder / "inspection" / "inspection.json").read_text(encoding="utf-8"))
        assert result["verdict"] == written["verdict"] == result["inspection"]["verdict"]
        assert (folder / "inspection" / "inspection.html").is_file()
        (check,) = written["checks"]
        assert (check["judged"], check["corrected"]["value_mm"]) == ("corrected", pytest.approx(check["measured"] - 0.5))
        stitched = stitch(calibration, read_session(good.folder / good.good[0]), tmp_path / "alone.ply")
        assert (folder / CLOUD_FILE).read_bytes() == (tmp_path / "alone.ply").read_bytes()
        assert (result["stitch"]["n_points"], result["stitch"]["n_scans"]) == (stitched.n_points, stitched.n_scans)
        verdicts[result["part"]] = result["verdict"]
        keep(folder)  # as after a kill: told twice, kept once
    with History.open(place) as history:
        kept = {str(row.data["part"]): row.verdict for row in history.results(calibration.cell_name, "inspection")}
        assert len(history.results(calibration.cell_name, "inspection")) == 1
    assert kept == verdicts
