"""`spherecal export`: files and stdout, targets, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from calibrate import Calibration
from calibrate.export import FORMATS, HAND_EYE_FORMATS, TARGET_FORMATS, export_text
from measure.cli import app
from measure.cli_export import ExportFormat
from measure.cli_run import run_app
from tests.support.exporting import calibration_of, shipped_calibration

TARGETS = "joint1_deg,joint2_deg,joint3_deg,joint4_deg,joint5_deg,joint6_deg\n10,5,20,30,-40,10\n-100,5,20,30,-40,10\n"


@pytest.fixture(scope="module")
def calibration_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "calibration.yaml"
    shipped_calibration("ur5e").save(path)
    return path


@pytest.fixture
def targets_file(tmp_path: Path) -> Path:
    path = tmp_path / "targets.csv"
    path.write_text(TARGETS, encoding="utf-8")
    return path


def run_json(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any, str]:
    code = run_app(app, ["export", *map(str, arguments), "--json"])
    out, err = capfd.readouterr()
    assert out.count("\n") == 1
    return code, json.loads(out), err


def test_the_choices_are_the_formats() -> None:
    assert tuple(choice.value for choice in ExportFormat) == FORMATS


@pytest.mark.parametrize("file_format", FORMATS)
def test_every_format_is_written(file_format: str, calibration_file: Path, targets_file: Path, tmp_path: Path, capfd: Any) -> None:
    calibration = Calibration.load(calibration_file)
    wants_targets = ["--targets", targets_file] if file_format in TARGET_FORMATS else []
    out = tmp_path / "exported"
    code, result, _ = run_json(capfd, calibration_file, "--format", file_format, "-o", out, *wants_targets)
    assert code == 0
    text = out.read_text(encoding="ascii")
    assert calibration.id in text
    assert (result["format"], result["calibration"], result["out"]) == (file_format, calibration.id, str(out))
    if file_format not in TARGET_FORMATS:
        assert text == export_text(calibration, file_format).text
    assert (result["residual"] is None) == (file_format in {**HAND_EYE_FORMATS, **TARGET_FORMATS})
    assert not list(tmp_path.glob("*.tmp"))


def test_without_a_file_the_text_is_the_result(calibration_file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = export_text(Calibration.load(calibration_file), "ur-pose").text
    assert run_app(app, ["export", str(calibration_file), "-f", "ur-pose"]) == 0
    assert capfd.readouterr().out == text
    assert run_json(capfd, calibration_file, "-f", "ur-pose")[1]["text"] == text


def test_targets_out_of_what_was_seen_are_told(calibration_file: Path, targets_file: Path, tmp_path: Path, capfd: Any) -> None:
    out = tmp_path / "t.mod"
    code, result, err = run_json(capfd, calibration_file, "-f", "targets-rapid", "--targets", targets_file, "-o", out)
    assert (code, result["n_targets"], result["outside_seen_range"]) == (0, 2, ["target_2"])
    assert result["uncorrected_max_mm"] > 0
    assert "target_2 is outside the axis ranges" in err


def test_a_failed_calibration_is_exported_with_a_warning_and_exit_code_3(tmp_path: Path, capfd: Any) -> None:
    path, out = tmp_path / "failed.yaml", tmp_path / "hand_eye.yaml"
    replace(shipped_calibration("ur5e"), verdict="fail").save(path)
    code, result, err = run_json(capfd, path, "-f", "hand-eye-yaml", "-o", out)
    assert (code, result["verdict"]) == (3, "fail")
    assert "do not move a robot by it" in err
    assert "verdict fail" in out.read_text(encoding="ascii")


@pytest.mark.parametrize("arguments", [["-f", "urdf"], ["-f", "targets-csv", "--targets", "TARGETS"]])
def test_a_pose_only_calibration_tells_what_it_can_give(arguments: list[str], tmp_path: Path, targets_file: Path, capfd: Any) -> None:
    path, out = tmp_path / "poses.yaml", tmp_path / "out"
    calibration_of(None).save(path)
    code, result, _ = run_json(capfd, path, *[targets_file if a == "TARGETS" else a for a in arguments], "-o", out)
    assert (code, result["error"]["type"]) == (1, "SettingsError")
    assert "hand-eye" in result["error"]["remedy"]
    assert not out.exists()


def test_nothing_is_written_over_what_it_is_made_from(calibration_file: Path, targets_file: Path, capfd: Any) -> None:
    before = calibration_file.read_bytes(), targets_file.read_bytes()
    for out in (calibration_file, targets_file):
        code, result, _ = run_json(capfd, calibration_file, "-f", "targets-csv", "--targets", targets_file, "-o", out)
        assert (code, result["error"]["file"]) == (1, str(out))
    assert (calibration_file.read_bytes(), targets_file.read_bytes()) == before


def test_broken_targets_leave_the_former_file(calibration_file: Path, tmp_path: Path, capfd: Any) -> None:
    targets, out = tmp_path / "targets.csv", tmp_path / "out.csv"
    targets.write_text("x,y\n1,2\n", encoding="utf-8")
    out.write_text("former", encoding="utf-8")
    code, result, _ = run_json(capfd, calibration_file, "-f", "targets-csv", "--targets", targets, "-o", out)
    assert (code, result["error"]["type"], result["error"]["file"]) == (1, "FileError", str(targets))
    assert out.read_text(encoding="utf-8") == "former"


def test_targets_and_formats_must_fit(calibration_file: Path, targets_file: Path, capfd: Any) -> None:
    assert "needs targets" in run_json(capfd, calibration_file, "-f", "targets-csv")[1]["error"]["message"]
    assert "takes no targets" in run_json(capfd, calibration_file, "-f", "urdf", "--targets", targets_file)[1]["error"]["message"]
    assert run_json(capfd, calibration_file, "-f", "dxf")[0] == 2
