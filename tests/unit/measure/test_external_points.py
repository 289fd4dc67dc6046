"""External points at the command line: every command takes such sessions, or says why not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import parse_cell
from calibrate import Calibration
from drivers.files.yaml import dump_yaml
from drivers.models import load_robot_model
from measure.cli import app
from measure.cli_run import run_app
from measure.doctor import cell_hints, cell_problems
from measure.report_facts import facts_of
from tests.support.solving import draw_shots
from tests.support.synthetic import abb_robot, paper_cell, with_table_1_errors
from tests.support.synthetic_session import write_session
from tests.support.tracker import add_tracker_lines, tracked_robot, tracker_cell_data, write_tracker_session


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with sessions `tracker`, `mixed` and `unseen`."""
    folder, rng = tmp_path_factory.mktemp("external"), np.random.default_rng(71)
    robot = tracked_robot(72)
    write_tracker_session(folder / "tracker", robot.shots(rng, 25), tracker_cell_data("abb_irb1410"))
    cell = replace(paper_cell(), nominal=abb_robot(), true=with_table_1_errors(abb_robot()))
    write_session(folder / "mixed", cell, {"A": draw_shots(cell, rng, 12, n_points=120)}, flange_from_camera=None)
    add_tracker_lines(folder / "mixed", replace(robot, noise_mm=0.0).shots(rng, 3))
    write_session(folder / "unseen", cell, {"A": draw_shots(cell, rng, 6, n_points=120)}, flange_from_camera=None)
    add_tracker_lines(folder / "unseen", replace(robot, noise_mm=0.0).shots(rng, 4))
    return folder


def told(capfd: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, object]]:
    code = run_app(app, [str(word) for word in words] + ["--json"])
    data = json.loads(capfd.readouterr().out)
    assert isinstance(data, dict)
    return code, data


def test_a_robot_alone_from_command_to_report(sessions: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, data = told(capfd, "calibrate", sessions / "tracker", "-o", tmp_path / "c.yaml")
    assert code == 0
    assert (data["method"], data["camera_error"], data["n_shots"], data["used"], data["rejected"]) == ("clouds", "none", 25, 25, [])
    assert (data["rank"], data["n_parameters"], data["verdict"], data["hand_eye"]) == (18, 36, "pass", "none")
    for key in ("train_rms_mm", "cross_validated_rms_mm", "seconds"):
        assert isinstance(data[key], float)
    code, data = told(capfd, "report", tmp_path / "c.yaml", sessions / "tracker", "-o", tmp_path / "report.html")
    assert code == 0
    page = (tmp_path / "report.html").read_text()
    assert "external reference tracker" in page
    assert "external target reflector" in page
    assert "nothing is known of it" in page
    rows = dict(facts_of(Calibration.load(tmp_path / "c.yaml")).identity)
    assert rows["external reference points"].startswith("25 used, missed by 0.0")


def test_commands_that_need_scans_say_so(sessions: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert told(capfd, "calibrate", sessions / "tracker", "-o", tmp_path / "c.yaml")[0] == 0
    for command, reason in (
        (("verify", tmp_path / "c.yaml", sessions / "tracker"), "external reference points alone"),
        (("show", tmp_path / "c.yaml", sessions / "tracker", "-o", tmp_path / "run.rrd"), "no clouds to show"),
        (("stitch", tmp_path / "c.yaml", sessions / "tracker", "-o", tmp_path / "cloud.ply"), "no good scan"),
        (("stitch", tmp_path / "c.yaml", sessions / "mixed", "-o", tmp_path / "cloud.ply"), "robot alone"),
    ):
        code, data = told(capfd, *command)
        assert code == 1
        assert reason in json.dumps(data["error"])
    assert not (tmp_path / "run.rrd").exists()


def test_mixed_sessions_are_verified_stitched_and_searched_on_their_scans(sessions: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, data = told(capfd, "calibrate", sessions / "mixed", "-o", tmp_path / "c.yaml", "--camera-error", "none")
    assert code in {0, 3}
    assert (data["n_shots"], data["used"]) == (15, 15)
    code, data = told(capfd, "verify", tmp_path / "c.yaml", sessions / "mixed", "--allow-training-data")
    assert code in {0, 3}
    assert (data["n_shots"], data["external"]) == (15, None)  # three of them rejected: the calibration was made from them
    code, data = told(capfd, "verify", tmp_path / "c.yaml", sessions / "unseen")
    assert code in {0, 3}
    external = data["external"]
    assert isinstance(external, dict)
    assert (data["n_shots"], data["used"], data["rejected"], external["n_points"]) == (10, 6, [], 4)
    assert [(p["session"], p["index"], p["target"]) for p in external["points"]] == [("unseen", i, "reflector") for i in range(6, 10)]
    code, _ = told(capfd, "report", tmp_path / "c.yaml", sessions / "unseen", "-o", tmp_path / "report.html")
    assert code == 0
    assert "unseen, shot 9" in (tmp_path / "report.html").read_text()
    code, data = told(capfd, "centres", sessions / "mixed", "-o", tmp_path / "centres.csv")
    assert (code, data["n_shots"], data["used"]) == (0, 12, 12)
    code, data = told(capfd, "stitch", tmp_path / "c.yaml", sessions / "mixed", "-o", tmp_path / "cloud.ply")
    assert (code, data["n_scans"]) == (0, 12)
    code, data = told(capfd, "calibrate", sessions / "mixed", "-o", tmp_path / "s.yaml", "--method", "centres", "--camera-error", "none")
    assert code in {0, 3}
    rejected = data["rejected"]
    assert isinstance(rejected, list)
    assert [r["index"] for r in rejected] == [12, 13, 14]
    assert all("takes no external reference points" in r["reason"] for r in rejected)


def test_doctor_takes_a_cell_without_spheres(tmp_path: Path) -> None:
    cell = parse_cell(dump_yaml(tracker_cell_data("abb_irb1410")).encode(), path=tmp_path / "cell.yaml")
    model = load_robot_model("abb_irb1410")
    assert cell_problems(cell, model) == []
    assert any("laser tracker" in hint for hint in cell_hints(cell, model))
    assert any("there is none" in problem for problem in cell_problems(cell, None))
