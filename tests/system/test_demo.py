"""The demo, small: all files, the figures it promises, and folders that it must not touch."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from drivers.files.ply import read_ply
from measure.demo import DemoSettings, run_demo
from tests.system.conftest import RESOLUTION_PX, Cli

FILES = {
    *("cell.yaml", "truth.yaml", "plan_calibration.yaml", "plan_verification.yaml", "plan_workpiece.yaml"),
    *("calibration", "verification", "workpiece", "calibration.yaml", "verification.json", "cloud.ply", "report.html", "report.json", "run.rrd"),
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    folder = tmp_path_factory.mktemp("demo")
    told: list[str] = []
    result = run_demo(folder, DemoSettings(n_calibration=36, n_verification=16, resolution_px=RESOLUTION_PX), told.append)
    assert len(told) == 7
    return folder, json.loads(json.dumps(result.to_json_dict(Path("elsewhere")), default=str))


def test_the_demo_writes_all_its_files(demo: tuple[Path, dict[str, object]]) -> None:
    folder, _ = demo
    assert {path.name for path in folder.iterdir()} == FILES
    assert len(read_ply(folder / "cloud.ply").points_mm) > 10_000


def test_calibrating_makes_the_unseen_lengths_several_times_better(demo: tuple[Path, dict[str, object]]) -> None:
    told = demo[1]
    assert {"calibrate", "verify", "stitch", "out"} <= set(told)
    verify = told["verify"]
    if not isinstance(verify, dict):
        pytest.fail("no verification")
    errors = [abs(length["error_mm"]) for length in verify["lengths"]]
    before = [abs(error) for error in verify["before"]["length_errors_mm"].values()]
    assert len(errors) == 6
    assert max(errors) < 0.2
    assert sum(errors) < 0.3 * sum(before)
    assert verify["centre_rms_mm"] < 0.2 * verify["before"]["centre_rms_mm"]
    assert verify["verdict"] != "reject"


def test_files_are_named_where_they_lie_in_the_end(demo: tuple[Path, dict[str, object]]) -> None:
    told = json.dumps(demo[1])
    assert "elsewhere/cloud.ply" in told
    assert str(demo[0]) not in told


def test_the_truth_is_in_its_own_file_only(demo: tuple[Path, dict[str, object]]) -> None:
    """Long numbers of the hidden truth, such as its hand-eye transform, appear in no session and no result."""
    folder, _ = demo
    secrets = re.findall(r"\d\.\d{11,}", (folder / "truth.yaml").read_text())
    assert len(set(secrets)) > 8
    texts = [path for path in folder.rglob("*") if path.suffix in (".yaml", ".jsonl", ".json", ".html") and path.name != "truth.yaml"]
    assert len(texts) > 10
    for path in texts:
        content = path.read_text(encoding="utf-8")
        assert not any(secret in content for secret in secrets)


def test_a_folder_with_other_things_is_refused(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    result = cli("demo", "--out", tmp_path, "--force", "--json")
    assert result.code == 1
    assert result.told["error"]["remedy"]
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_former_demo_is_replaced_by_force_only(tmp_path: Path, cli: Cli) -> None:
    for name in ("cell.yaml", "truth.yaml"):
        (tmp_path / name).write_text("")
    result = cli("demo", "--out", tmp_path)
    assert result.code == 1
    assert "--force" in result.err
    assert result.err.count("\n") == 1


def test_a_place_where_nothing_can_be_made_is_told_at_once(tmp_path: Path, cli: Cli) -> None:
    result = cli("demo", "--out", tmp_path / "no" / "where")
    assert result.code == 1
    assert result.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
