"""A session against its cell and robot: unknown spheres, wrong axes, degrees."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.cell import cell_of_session, robot_model_of
from acquire.check import beyond_limits_rad, check_session
from drivers.errors import FileError
from drivers.files.session import read_session
from drivers.models import load_robot_model
from tests.support.sessions import CELL, write_session

Change = Callable[[list[dict[str, Any]]], None]


def _check(folder: Path, change: Change | None = None, cell: str = CELL) -> None:
    write_session(folder, 3, change)
    (folder / "cell.yaml").write_text(cell, encoding="utf-8")
    session = read_session(folder)
    found = cell_of_session(session)
    check_session(session, found, robot_model_of(found, session))


def _degrees(shots: list[dict[str, Any]]) -> None:
    for shot in shots:
        shot["joints_rad"] = np.degrees(shot["joints_rad"]).tolist()


def _five(shots: list[dict[str, Any]]) -> None:
    for shot in shots:
        shot["joints_rad"].pop()


NO_MODEL = CELL.replace("ur5e", "null")

WRONG: dict[str, tuple[Change, str, str, str]] = {
    "unknown sphere": (lambda shots: shots[1].update(sphere="Z"), CELL, "line 2", "'Z'"),
    "five axes": (_five, CELL, "line 1", "ur5e has 6"),
    "degrees": (_degrees, CELL, "line", "degrees"),
    "far outside": (lambda shots: shots[2]["joints_rad"].__setitem__(3, 50.0), CELL, "line 3", "axis 4"),
    "no model": (lambda shots: shots[1].update(base_from_flange=None), NO_MODEL, "line 2", "no robot model"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_told(name: str, tmp_path: Path) -> None:
    change, cell, where, word = WRONG[name]
    with pytest.raises(FileError) as caught:
        _check(tmp_path / "s", change, cell)
    assert caught.value.file == str(tmp_path / "s" / "shots.jsonl")
    assert caught.value.where is not None
    assert caught.value.where.startswith(where)
    assert word in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize("cell", [CELL, NO_MODEL])
def test_what_fits_passes(cell: str, tmp_path: Path) -> None:
    _check(tmp_path / "s", None, cell)
    _check(tmp_path / "w", lambda shots: shots[0].update(sphere=None), cell)
    _check(tmp_path / "e", lambda shots: shots[0].update(base_from_flange=None, joints_rad=None, scan=None, sha256=None, status="failed"), cell)


def test_a_slight_overtravel_is_no_error(tmp_path: Path) -> None:
    limit = load_robot_model("ur5e").joint_limits_rad[0, 1]
    _check(tmp_path / "s", lambda shots: shots[0]["joints_rad"].__setitem__(0, float(limit) + 0.01))


def test_beyond_limits_is_zero_inside_and_the_distance_outside() -> None:
    model = load_robot_model("abb_irb1410")
    lower, upper = model.joint_limits_rad.T
    assert not beyond_limits_rad(model, np.stack([lower, upper])).any()
    assert np.allclose(beyond_limits_rad(model, np.stack([lower - 0.25, upper + 0.5])), [[0.25] * 6, [0.5] * 6])
