"""External points at the command line: every command takes such sessions, or says why not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import parse_cell
from calibrate import Calibration
from calibrate.external_points import ExternalShot
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
    write_tracker_session(folder / "tracker", robot.shots(rng, 25), tracker_cell_data("abb_irb1410"))  # `_trained` draws the same
    cell = replace(paper_cell(), nominal=abb_robot(), true=with_table_1_errors(abb_robot()))
    write_session(folder / "mixed", cell, {"A": draw_shots(cell, rng, 12, n_points=120)}, flange_from_camera=None)
    add_tracker_lines(folder / "mixed", replace(robot, noise_mm=0.0).shots(rng, 3))
    write_session(folder / "unseen", cell, {"A": draw_shots(cell, rng, 6, n_points=120)}, flange_from_camera=None)
    add_tracker_lines(folder / "unseen", replace(robot, noise_mm=0.0).shots(rng, 4))
    return folder


def _trained() -> list[ExternalShot]:
    return tracked_robot(72).shots(np.random.default_rng(71), 25)


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
        (("verify", tmp_path / "c.yaml", sessions / "tracker"), "25 shots are those that the calibration was made from"),
        (("show", tmp_path / "c.yaml", sessions / "tracker", "-o", tmp_path / "run.rrd"), "no clouds to show"),
        (("stitch", tmp_path / "c.yaml", sessions / "tracker", "-o", tmp_path / "cloud.ply"), "no good scan"),
        (("stitch", tmp_path / "c.yaml", sessions / "mixed", "-o", tmp_path / "cloud.ply"), "robot alone"),
    ):
        code, data = told(capfd, *command)
        assert code == 1
        assert reason in json.dumps(data["error"])
    assert not (tmp_path / "run.rrd").exists()


def test_a_robot_alone_is_verified_on_unseen_points(sessions: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rng, robot = np.random.default_rng(73), tracked_robot(72)
    unseen = write_tracker_session(tmp_path / "unseen", robot.shots(rng, 24), tracker_cell_data("abb_irb1410"), purpose="verification")
    assert told(capfd, "calibrate", sessions / "tracker", "-o", tmp_path / "c.yaml")[0] == 0
    code, data = told(capfd, "verify", tmp_path / "c.yaml", unseen)
    assert (code, data["verdict"], data["used"], data["spheres"], data["radial_rms_mm"]) == (0, "conform", 24, {}, None)
    lengths = data["lengths"]
    assert isinstance(lengths, list)
    assert len(lengths) == 12
    assert all(abs(x["error_mm"]) < 2 * x["expanded_uncertainty_mm"] for x in lengths)
    before = data["before"]
    assert isinstance(before, dict)
    assert before["length_errors_mm"].keys() == {"-".join(x["between"]) for x in lengths}
    assert max(map(abs, before["length_errors_mm"].values())) > 3 * max(abs(x["error_mm"]) for x in lengths)
    assert told(capfd, "report", tmp_path / "c.yaml", unseen, "-o", tmp_path / "report.html", "--pdf", tmp_path / "report.pdf")[0] == 0
    assert "24 of 24 external reference points that the calibration never saw" in (tmp_path / "report.html").read_text()
    # the same stops measured again are the calibration's own poses, whatever the reading
    again = [replace(shot, point_in_reference_mm=shot.point_in_reference_mm + rng.normal(0, 0.05, 3)) for shot in _trained()]
    repeated = write_tracker_session(tmp_path / "repeated", again, tracker_cell_data("abb_irb1410"))
    code, data = told(capfd, "verify", tmp_path / "c.yaml", repeated)
    assert (code, "25 shots repeat robot poses" in json.dumps(data["error"])) == (1, True)
    code, data = told(capfd, "verify", tmp_path / "c.yaml", repeated, "--allow-training-data")
    assert (data["verdict"], data["held_out"]) == ("not_proven", False)


def test_mixed_sessions_are_verified_stitched_and_searched_on_their_scans(sessions: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, data = told(capfd, "calibrate", sessions / "mixed", "-o", tmp_path / "c.yaml", "--camera-error", "none")
    assert code in {0, 3}
    assert (data["n_shots"], data["used"]) == (15, 15)
    code, data = told(capfd, "verify", tmp_path / "c.yaml", sessions / "mixed", "--allow-training-data")
    assert code in {0, 3}
    assert (data["n_shots"], data["used"], data["held_out"]) == (15, 15, False)  # points of the calibration are told to be such
    assert "TRAINING DATA" in str(data["remark"])
    code, data = told(capfd, "verify", tmp_path / "c.yaml", sessions / "unseen")
    assert code in {0, 3}
    external = data["external"]
    assert isinstance(external, dict)
    assert (data["n_shots"], data["used"], data["rejected"], external["n_points"]) == (10, 10, [], 4)
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
