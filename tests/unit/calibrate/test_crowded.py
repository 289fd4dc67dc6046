"""Whole sessions of a crowded scene, from frames to rejected shots: one small cell; the counts are in tests/qualify."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.support.crowded import SPOILS, CrowdedResult, CrowdedSession, solve_crowded, write_crowded_session
from tests.support.once import once_a_run

SEED = 4


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[CrowdedSession, CrowdedResult]:
    return once_a_run(tmp_path_factory, "crowded", write_and_solve)


def write_and_solve(folder: Path) -> tuple[CrowdedSession, CrowdedResult]:
    session = write_crowded_session(folder / "s", SEED, n_shots=54, resolution_px=(240, 150))
    return session, solve_crowded(session, ("auto", "pillow"), SEED, n_tests=30)


@pytest.fixture(scope="module")
def session(both: tuple[CrowdedSession, CrowdedResult]) -> CrowdedSession:
    return both[0]


@pytest.fixture(scope="module")
def result(both: tuple[CrowdedSession, CrowdedResult]) -> CrowdedResult:
    return both[1]


def test_every_spoiled_shot_is_rejected_with_a_reason_and_hardly_another(session: CrowdedSession, result: CrowdedResult) -> None:
    assert set(session.spoiled.values()) == set(SPOILS)
    assert result.missed == ()
    assert result.lost <= 2
    assert all("mm" in reason for reason in result.reasons.values())


def test_used_and_rejected_shots_are_all_there_are(result: CrowdedResult) -> None:
    assert len(result.solved["auto"].assembled.shots) + len(result.reasons) == 54


def test_a_field_follows_a_camera_that_is_no_pillow(result: CrowdedResult) -> None:
    assert result.solved["auto"].assembled.problem.camera_error.name == "field"
    # 0.6 is the median with 90 shots; 50 leave more open
    assert result.rms_mm["auto"] < 0.9 * result.rms_mm["pillow"]
    assert np.isfinite(result.solved["auto"].held_out.centre_error_mm).all()
