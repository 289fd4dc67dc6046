"""`check`, `history`, `activate`, `rollback`, `diff` and the marks of `verify`, on files as a person has them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.plan import load_plan
from calibrate import Calibration
from calibrate.result_file import calibration_data
from measure.cli import app
from measure.cli_run import run_app
from measure.quick import planning
from tests.support.drifting import CheckedCell, after_two, check_shots, small_checked_cell, write_check_session

RULED_S = 180.0


@pytest.fixture(scope="module")
def checked() -> CheckedCell:
    return small_checked_cell()


@pytest.fixture
def folder(checked: CheckedCell, tmp_path: Path) -> Path:
    (tmp_path / "cell.yaml").write_text(checked.volume.text, encoding="utf-8")
    checked.calibration.save(tmp_path / "calibration.yaml")
    return tmp_path


def session(folder: Path, checked: CheckedCell, cause: str | None, seed: int) -> str:
    shots = check_shots(checked, cause, np.random.default_rng([61, seed]), size=2.0)
    return str(write_check_session(folder / f"session{seed}", checked, shots))


def told(capfd: pytest.CaptureFixture[str], *arguments: str, code: int | None = 0) -> dict[str, Any]:
    """The JSON of a command; None is for verdicts that the test is not about."""
    found_code = run_app(app, [*arguments, "--json"])
    assert code is None or found_code == code
    found: dict[str, Any] = json.loads(capfd.readouterr().out)
    return found


def test_an_unchanged_cell_conforms_and_nothing_is_kept_without_a_history(
    folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str]
) -> None:
    calibration = str(folder / "calibration.yaml")
    found = told(capfd, "check", calibration, session(folder, checked, None, 10))
    assert found["verdict"] == "conform"
    assert found["named"] == []
    assert found["history"] is None
    verification = {"n_shots", "centre_rms_mm", "centre_max_mm", "radial_rms_mm", "lengths", "spheres", "reasons"}
    assert verification <= set(found)
    assert (found["n_shots"], set(found["spheres"])) == (8, {"A"})
    assert not list(folder.glob("*.sqlite"))


def test_from_a_change_to_a_new_calibration_in_use_and_back(folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str]) -> None:
    cell, old, new = (str(folder / name) for name in ("cell.yaml", "calibration.yaml", "new.yaml"))
    assert "--init" in told(capfd, "history", cell, code=1)["error"]["remedy"]
    told(capfd, "history", cell, "--init", "--check-every", "24")
    told(capfd, "activate", old)
    found = told(capfd, "check", old, session(folder, checked, "axis 3", 1), "--resolve", "-o", new, code=3)
    assert (found["verdict"], found["named"]) == ("reject", ["axis 3"])
    assert found["history"]["recorded"]
    assert found["resolved"]["accepted"]
    assert Calibration.load(new).inputs["parent"] == checked.calibration.id == found["resolved"]["parent"]
    # what is measured with the old one afterwards carries the reason
    marked = told(capfd, "verify", old, session(folder, checked, "axis 3", 2), code=None)["marked"]
    assert any("quick check" in mark and "axis 3" in mark for mark in marked)
    table = folder / "chart.csv"
    listed = told(capfd, "history", cell, "--csv", str(table))
    assert {c["id"]: c["parent"] for c in listed["calibrations"]} == {checked.calibration.id: None, found["resolved"]["id"]: checked.calibration.id}
    assert [r["kind"] for r in listed["results"]].count("check") == 1
    assert (listed["active"], listed["check_every_h"]) == (checked.calibration.id, 24.0)
    assert "axis 3" in table.read_text(encoding="utf-8").splitlines()[1]
    told(capfd, "activate", found["resolved"]["id"][:10], "--history", str(folder / "history.sqlite"), "--why", "axis 3")
    assert told(capfd, "history", cell)["active"] == found["resolved"]["id"]
    active = folder / "active.yaml"
    assert told(capfd, "rollback", cell, "-o", str(active))["calibration"] == checked.calibration.id
    assert active.read_bytes() == Path(old).read_bytes()


def test_the_field_between_two_calibrations_shows_what_was_moved(folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str]) -> None:
    moved = replace(checked.calibration, flange_from_camera=checked.calibration.flange_from_camera @ shifted(0.3))
    moved = replace(moved, id=str(calibration_data(moved)["id"]))
    moved.save(folder / "moved.yaml")
    out, recording = folder / "field.csv", folder / "field.rrd"
    found = told(capfd, "diff", str(folder / "calibration.yaml"), str(folder / "moved.yaml"), "-o", str(out), "--rrd", str(recording))
    assert found["rms_mm"] == pytest.approx(0.3, abs=1e-6)
    assert found["max_mm"] == pytest.approx(0.3, abs=1e-6)
    assert found["hand_eye"]["shift_mm"] == pytest.approx(0.3, abs=1e-6)
    assert len(out.read_text(encoding="utf-8").splitlines()) == found["n_points"] + 1
    assert recording.stat().st_size > 10_000
    itself = told(capfd, "diff", str(folder / "calibration.yaml"), str(folder / "calibration.yaml"))
    assert itself["max_mm"] == 0.0
    assert itself["within_u"] == 1.0


def test_a_check_is_held_against_an_earlier_one_and_two_changes_are_not_solved_as_one(
    folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str]
) -> None:
    calibration, earlier = str(folder / "calibration.yaml"), session(folder, checked, None, 20)
    found = told(capfd, "check", calibration, session(folder, checked, None, 21), "--since", earlier)
    assert (found["verdict"], found["since"]["earlier"], found["since"]["n_matched"], found["since"]["changed"]) == ("conform", "session20", 8, False)
    found = told(capfd, "check", calibration, session(folder, checked, "axis 3", 22), "--since", earlier, code=3)
    assert (found["since"]["named"], found["together"]) == (["axis 3"], None)
    assert any(reason.startswith("changed since the check session20: axis 3") for reason in found["reasons"])
    shots = after_two(checked, ("axis 3", "sphere moved"), np.random.default_rng([61, 23]), size=4.0)
    both = str(write_check_session(folder / "both", checked, shots))
    found = told(capfd, "check", calibration, both, code=3)
    assert sorted(found["together"]["pairs"][0]["causes"]) == ["axis 3", "sphere moved"]
    assert "more than one thing" in found["reasons"][0]
    assert "more than one thing" in told(capfd, "check", calibration, both, "--resolve", code=1)["error"]["message"]


def shifted(by_mm: float) -> Any:
    transform = np.eye(4)
    transform[0, 3] = by_mm
    return transform


def test_a_check_is_planned_for_spheres_that_still_stand_and_takes_less_than_three_minutes(
    folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "_CANDIDATES", 40)
    cell, calibration, out = (str(folder / name) for name in ("cell.yaml", "calibration.yaml", "plan.yaml"))
    assert "--calibration" in told(capfd, "plan", cell, "--for", "check", code=1)["error"]["remedy"]
    asked = told(capfd, "plan", cell, "--for", "check", "--calibration", calibration, code=1)["error"]
    assert "which still stand" in asked["message"]
    found = told(capfd, "plan", cell, "--for", "check", "--calibration", calibration, "--sphere", "A", "-o", out)
    assert len(load_plan(out).poses) == len(found["poses"]) == 8
    assert set(found["predicted"]["separation_sigmas"]) == {"hand-eye", "axis 2", "axis 3", "axis 4", "axis 5", "camera"}
    joints = np.array([pose.joints_rad for pose in load_plan(out).poses])
    assert found["predicted"]["seconds"] == round(planning.seconds_of(checked.volume.cell, joints), 1)
    assert planning.seconds_of(checked.volume.cell, joints) < RULED_S


def test_training_shots_and_few_shots_prove_nothing(folder: Path, checked: CheckedCell, capfd: pytest.CaptureFixture[str]) -> None:
    calibration = str(folder / "calibration.yaml")
    shots = check_shots(checked, None, np.random.default_rng(61))
    few = str(write_check_session(folder / "few", checked, shots[:3]))
    assert told(capfd, "check", calibration, few)["verdict"] == "not_proven"
    assert "nothing to solve anew" in told(capfd, "check", calibration, few, "--resolve", code=1)["error"]["message"]
