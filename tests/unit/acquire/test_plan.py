"""Plans: exact round trips; an edited plan is checked again."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire.cell import Cell, load_cell
from acquire.plan import Plan, PlannedPose, load_plan, parse_plan, plan_text, write_plan
from drivers.errors import FileError
from drivers.models import load_robot_model
from tests.support.sessions import CELL

MODEL = load_robot_model("ur5e")


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    path = tmp_path / "cell.yaml"
    path.write_text(CELL, encoding="utf-8")
    return load_cell(path)


def _plan(cell: Cell) -> Plan:
    rng = np.random.default_rng(3)
    poses = tuple(PlannedPose(f"p{i}", "A" if i else None, rng.uniform(-3, 3, 6), (rng.uniform(-3, 3, 6),) * (i % 3)) for i in range(5))
    return Plan(cell.sha256, "calibration", poses, {"centre_rms_mm": 0.03})


def test_a_plan_comes_back_exactly(tmp_path: Path, cell: Cell, caplog: pytest.LogCaptureFixture) -> None:
    plan = _plan(cell)
    write_plan(plan, tmp_path / "plan.yaml")
    with caplog.at_level(logging.WARNING):
        found = load_plan(tmp_path / "plan.yaml", cell, MODEL)
    assert not caplog.records
    assert (found.cell_sha256, found.purpose, found.predicted) == (cell.sha256, "calibration", {"centre_rms_mm": 0.03})
    for a, b in zip(plan.poses, found.poses, strict=True):
        assert (a.id, a.sphere, len(a.via_rad)) == (b.id, b.sphere, len(b.via_rad))
        assert np.array_equal(a.joints_rad, b.joints_rad)
        assert all(np.array_equal(x, y) for x, y in zip(a.via_rad, b.via_rad, strict=True))


def test_numbers_as_ids_are_taken_and_a_changed_cell_is_told(tmp_path: Path, cell: Cell, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(plan_text(replace(_plan(cell), cell_sha256="0" * 64)).replace("id: p1", "id: 17"), encoding="utf-8")
    with caplog.at_level(logging.WARNING):
        assert load_plan(path, cell, MODEL).poses[1].id == "17"
    assert "another state" in caplog.text


def _edited(cell: Cell, **changes: object) -> str:
    plan = _plan(cell)
    pose = replace(plan.poses[2], **changes)  # type: ignore[arg-type]
    return plan_text(replace(plan, poses=(*plan.poses[:2], pose, *plan.poses[3:])))


@pytest.mark.parametrize(
    ("changes", "where", "word"),
    [
        ({"sphere": "Z"}, "poses.2.sphere", "'Z'"),
        ({"id": "p0"}, "poses.2.id", "twice"),
        ({"joints_rad": np.zeros(5)}, "poses.2.joints_rad", "5 axes"),
        ({"joints_rad": np.array([0, 0, 7.0, 0, 0, 0])}, "poses.2.joints_rad", "axis 3"),
        ({"joints_rad": np.array([0, -90.0, 90.0, 0, 0, 0])}, "poses.2.joints_rad", "degrees"),
        ({"via_rad": (np.array([7.0, 0, 0, 0, 0, 0]),)}, "poses.2.via_rad.0", "axis 1"),
        ({"joints_rad": np.array([np.nan] * 6)}, "poses.2.joints_rad.0", "nan"),
    ],
)
def test_an_edited_plan_is_checked_again(changes: dict[str, object], where: str, word: str, tmp_path: Path, cell: Cell) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(_edited(cell, **changes), encoding="utf-8")
    with pytest.raises(FileError, match=word) as caught:
        load_plan(path, cell, MODEL)
    assert caught.value.where is not None
    assert caught.value.where.startswith(where)
    assert caught.value.remedy


def test_limits_between_axes_are_kept(tmp_path: Path, cell: Cell) -> None:
    model = load_robot_model("abb_irb1410")
    path = tmp_path / "plan.yaml"
    path.write_text(_edited(cell, joints_rad=np.zeros(6)), encoding="utf-8")
    plan = replace(_plan(cell), poses=(PlannedPose("x", None, np.array([0, -1.1, 1.1, 0, 0, 0])),))
    write_plan(plan, path)
    with pytest.raises(FileError, match="limit between axes"):
        load_plan(path, cell, model)


def test_without_a_model_all_poses_must_agree(tmp_path: Path, cell: Cell) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(_edited(cell, joints_rad=np.zeros(5)), encoding="utf-8")
    with pytest.raises(FileError, match="the first pose has 6"):
        load_plan(path)


@given(st.integers(0, 500), st.integers(0, 10), st.sampled_from(["[", "}", ": ", "\n", "x", "-", ".nan", "null", "1e99", "\n- ", "id: 1"]))
def test_random_edits_give_a_plan_or_a_file_error(start: int, length: int, new: str) -> None:
    plan = Plan("0" * 64, "calibration", tuple(PlannedPose(f"p{i}", "A", np.full(6, 0.5), (np.zeros(6),)) for i in range(3)))
    text = plan_text(plan)
    with suppress(FileError):
        assert isinstance(parse_plan(text[:start] + new + text[start + length :], file="plan.yaml", model=MODEL), Plan)
