"""Cells with several equal spheres in view: which is which comes from all shots together."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, cell_of_session, robot_model_of
from calibrate.observations import Observations, gather_observations
from calibrate.second_look import look_again
from calibrate.solve import CalibrationSettings, calibrate
from calibrate.start_consensus import Candidates, consensus_hand_eye
from drivers.errors import DataError
from drivers.files.session import Session, read_session
from drivers.kinematics import mdh, se3
from drivers.kinematics.se3 import FloatArray
from tests.support.solving import draw_shots
from tests.support.synthetic import SyntheticCell, SyntheticShot, paper_cell, sample_cap
from tests.support.synthetic_session import write_session

CELL = paper_cell(coupled=True)
CLOSE = {"A": (900.0, 100.0, 300.0), "B": (960.0, 40.0, 320.0), "C": (870.0, 10.0, 290.0)}
"""So near each other that nearly every frame shows two or three."""
APART = {"A": (900.0, 100.0, 300.0), "B": (1010.0, 60.0, 330.0), "C": (880.0, -60.0, 280.0)}
PER_SPHERE = 8


def in_view(centre: FloatArray) -> bool:
    x, y, z = centre
    return bool(abs(x) < 0.52 * z and abs(y) < 0.34 * z and 220 < z < 480)


def drawn(places: Mapping[str, tuple[float, float, float]], seed: int, per_sphere: int = PER_SPHERE) -> dict[str, list[SyntheticShot]]:
    """Shots that aim at one sphere each and show all that are in view."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, place in places.items():
        shots = draw_shots(replace(CELL, centre_in_base_mm=np.array(place)), rng, per_sphere, n_points=2)
        found[name] = [replace(shot, points_in_camera_mm=cloud(shot, places, rng)) for shot in shots]
    return found


def cloud(shot: SyntheticShot, places: Mapping[str, tuple[float, float, float]], rng: np.random.Generator) -> FloatArray:
    caps = []
    for place in places.values():
        centre = se3.apply(se3.inverse(shot.true_base_from_camera), place)
        if in_view(centre):
            points = sample_cap(centre, CELL.radius_mm, 500, rng)
            points[:, 2] += CELL.camera_error_mm(points) + rng.normal(0, 0.05, len(points))
            caps.append(points)
    return np.concatenate(caps)


def looks(folder: Path) -> tuple[Session, Cell, Observations]:
    session = read_session(folder)
    cell = cell_of_session(session)
    return session, cell, gather_observations([session], cell=cell, model=robot_model_of(cell, session))


def again(session: Session, cell: Cell, first: Observations) -> Observations:
    return look_again([session], first, cell=cell, model=robot_model_of(cell, session))


def wrong(seen: Observations, shots: Mapping[str, Sequence[SyntheticShot]], places: Mapping[str, tuple[float, float, float]]) -> list[int]:
    """Indices of shots whose sphere is not the one that they name."""
    flat = [(name, shot) for name, members in shots.items() for shot in members]
    found = []
    for shot in seen.shots:
        name, drawn_shot = flat[shot.index]
        true = se3.apply(se3.inverse(drawn_shot.true_base_from_camera), places[name])
        if shot.centre_in_camera_mm is None or np.linalg.norm(shot.centre_in_camera_mm - true) > 5:
            found.append(shot.index)
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_nearly_all_shots_are_taken_back_without_any_guess(seed: int, tmp_path: Path) -> None:
    shots = drawn(APART, seed)
    session, cell, first = looks(write_session(tmp_path / "s", CELL, shots, flange_from_camera=None))
    assert 7 <= len(first.shots) <= 18
    second = again(session, cell, first)
    assert len(second.shots) == 3 * PER_SPHERE
    assert second.rejected == ()
    assert wrong(second, shots, APART) == []


def test_it_works_where_every_frame_is_ambiguous(tmp_path: Path) -> None:
    shots = drawn(CLOSE, 3)
    session, cell, first = looks(write_session(tmp_path / "s", CELL, shots, flange_from_camera=None))
    assert len(first.shots) <= 6
    unclear = replace(first, shots=())
    n = len(unclear.rejected)
    second = again(session, cell, unclear)
    assert len(second.shots) >= n - 1
    # where every frame shows all of them, only lengths or the cell's places could tell A from B: each name has one place
    named = [order for order in permutations(CLOSE.values()) if wrong(second, shots, dict(zip(CLOSE, order, strict=True))) == []]
    assert len(named) == 1


@pytest.mark.parametrize("off_mm", [(350.0, 0.0, 50.0), (80.0, 60.0, 0.0), (-60.0, 40.0, 30.0)])
def test_a_guess_that_is_far_off_takes_no_neighbour(off_mm: tuple[float, float, float], tmp_path: Path) -> None:
    shots = drawn(APART, 4)
    guess = CELL.flange_from_camera.copy()
    guess[:3, 3] += off_mm
    spheres = {name: {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001, "centre_in_base_mm": list(place)} for name, place in APART.items()}
    session, cell, first = looks(write_session(tmp_path / "s", CELL, shots, flange_from_camera=guess, extra_cell={"spheres": spheres}))
    second = again(session, cell, first)
    assert len(first.shots) - len(wrong(first, shots, APART)) < len(second.shots)
    assert len(second.shots) >= 3 * PER_SPHERE - 1
    assert wrong(second, shots, APART) == []


def test_certified_lengths_tell_which_place_is_which(tmp_path: Path) -> None:
    """Shots that all name another sphere than they aim at: A, B and C go round, and only the lengths know."""
    shots = drawn(CLOSE, 5)
    renamed = {"A": shots["B"], "B": shots["C"], "C": shots["A"]}
    pairs = (("A", "B"), ("B", "C"), ("A", "C"))
    lengths = [(a, b, float(np.linalg.norm(np.subtract(CLOSE[a], CLOSE[b]))), 0.005) for a, b in pairs]
    session, cell, first = looks(write_session(tmp_path / "s", CELL, renamed, flange_from_camera=None, lengths=lengths))
    second = again(session, cell, replace(first, shots=()))
    assert len(second.shots) > 12
    assert wrong(second, renamed, CLOSE) == []


def test_clear_shots_are_left_as_they_are(tmp_path: Path) -> None:
    far = {"A": CLOSE["A"], "B": (820.0, -450.0, 380.0)}
    session, cell, first = looks(write_session(tmp_path / "s", CELL, drawn(far, 6), flange_from_camera=None))
    assert again(session, cell, first) is first


def test_shots_without_agreement_are_left_as_they_are(tmp_path: Path) -> None:
    shots = drawn(APART, 7, per_sphere=6)
    folder = write_session(tmp_path / "s", CELL, shots, flange_from_camera=None)
    lines = [json.loads(line) for line in (folder / "shots.jsonl").read_text().splitlines()]
    order = np.random.default_rng(8).permutation(len(lines))
    mixed = [line | {"joints_rad": lines[i]["joints_rad"]} for line, i in zip(lines, order, strict=True)]
    (folder / "shots.jsonl").write_text("\n".join(json.dumps(line) for line in mixed) + "\n")
    session, cell, first = looks(folder)
    assert again(session, cell, first) is first


def test_a_cell_with_equal_spheres_calibrates_from_nothing(tmp_path: Path) -> None:
    session = read_session(write_session(tmp_path / "s", CELL, drawn(APART, 9), flange_from_camera=None))
    result = calibrate([session], CalibrationSettings(camera_error="pillow"))
    assert (result.statistics.n_shots, result.statistics.used) == (3 * PER_SPHERE, 3 * PER_SPHERE)
    found = result.sphere_centres_in_base_mm
    for name, place in APART.items():
        assert np.linalg.norm(found[name] - place) < 3.0


def candidates_of(cell: SyntheticCell, seed: int, n: int, false_per_shot: int) -> Candidates:
    """Shots of one sphere, each with some candidates that mean nothing."""
    rng = np.random.default_rng(seed)
    rows = []
    for k, shot in enumerate(draw_shots(cell, rng, n, n_points=2)):
        pose = mdh.base_from_flange(cell.nominal, shot.joints_rad)
        true = se3.apply(se3.inverse(shot.true_base_from_camera), cell.centre_in_base_mm)
        rows += [(k, pose, true)] + [(k, pose, rng.uniform([-100, -60, 250], [100, 60, 400])) for _ in range(false_per_shot)]
    order = rng.permutation(len(rows))
    shot_of, poses, centres = (np.array([rows[i][part] for i in order]) for part in range(3))
    return Candidates(shot_of.astype(np.int64), np.zeros(len(rows), dtype=np.int64), poses, centres)


@pytest.mark.parametrize(("n", "false_per_shot"), [(8, 0), (12, 1), (20, 2)])
def test_the_consensus_finds_the_hand_eye_transform(n: int, false_per_shot: int) -> None:
    for seed in range(3):
        found = consensus_hand_eye(candidates_of(CELL, seed, n, false_per_shot), np.random.default_rng(seed))
        assert found is not None
        np.testing.assert_allclose(found[:3, 3], CELL.flange_from_camera[:3, 3], atol=8.0)
        np.testing.assert_allclose(found[:3, :3], CELL.flange_from_camera[:3, :3], atol=0.02)


def test_there_is_no_consensus_without_agreement() -> None:
    candidates = candidates_of(CELL, 1, 20, 1)
    nonsense = replace(candidates, centre_in_camera_mm=np.random.default_rng(2).permutation(candidates.centre_in_camera_mm))
    assert consensus_hand_eye(nonsense, np.random.default_rng(3)) is None
    few = candidates_of(CELL, 1, 5, 0)
    assert consensus_hand_eye(few, np.random.default_rng(3)) is None


def test_ambiguous_shots_alone_that_agree_on_nothing_end_in_an_error(tmp_path: Path) -> None:
    shots = drawn(CLOSE, 11, per_sphere=1)
    with pytest.raises(DataError):
        calibrate([read_session(write_session(tmp_path / "s", CELL, shots, flange_from_camera=None))], CalibrationSettings(camera_error="none"))
