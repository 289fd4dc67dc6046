"""Recordings are written, read back and compared; strict mode makes rerun raise on bad data."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from drivers.errors import FileError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import Capsule
from measure.scene import Scene, SphereCloud, SphereMark, Step
from measure.viewer import TIMELINE, write_recording
from tests.support.synthetic import paper_robot

FloatArray = NDArray[np.float64]


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def scene(*, shape: tuple[Capsule, ...] = ()) -> Scene:
    rng = np.random.default_rng(0)
    centre = np.array([900.0, 100.0, 300.0])
    steps = []
    for i in range(4):
        links = mdh.chain(paper_robot(), rng.uniform(-0.5, 0.5, 6))
        cloud = centre + rng.normal(0, 5, (50, 3))
        cloud[0] = np.nan
        steps.append(Step(f"shot {i}", links, links[-1] @ se3.exp([60, 60, 85, 0, 0, 0]), cloud, cloud + 0.1, {"after": 0.1 * i, "missing": np.nan}))
    marks = SphereCloud(centre + rng.normal(0, 5, (30, 3)), rng.normal(0, 1, 30))
    spheres = (SphereMark("A 1", centre, 19.05, marks, marks), SphereMark("B", centre + 50, 19.05))
    return Scene("test", tuple(steps), spheres, {"summary": "# hello"}, shape=shape, stitched_in_base_mm=rng.normal(0, 5, (20, 3)))


def columns(path: Path) -> dict[str, list[object]]:
    """Values by `entity:column`, the rows of all chunks of an entity in order of the timeline."""
    rows: dict[str, list[object]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        for name in set(batch.schema.names) - {"log_time"}:
            rows.setdefault(f"{chunk.entity_path}:{name}", []).extend(batch.column(name).to_pylist())
    return rows


def test_what_was_logged_comes_back(tmp_path: Path) -> None:
    expected = scene()
    found = columns(write_recording(tmp_path / "run.rrd", expected))
    curve = dict(zip(found[f"/curves/after:{TIMELINE}"], found["/curves/after:Scalars:scalars"], strict=True))
    assert curve == {i: [pytest.approx(0.1 * i)] for i in range(4)}
    assert not any(key.startswith("/curves/missing:Scalars") for key in found)
    camera = found["/base/camera:Transform3D:translation"]
    np.testing.assert_allclose(np.array(camera)[:, 0], [step.base_from_camera[:3, 3] / 1000 for step in expected.steps], atol=1e-6)
    clouds = found["/base/shot/after:Points3D:positions"]
    np.testing.assert_allclose(np.array(clouds[2]), expected.steps[2].after_in_base_mm[1:] / 1000, atol=1e-6)
    assert "/base/all_shots/A_1/before:Points3D:positions" in found
    assert "/base/stitched:Points3D:positions" in found
    assert "/texts/summary:TextDocument:text" in found


def test_link_bodies_point_along_their_capsules(tmp_path: Path) -> None:
    ends = [(0.0, 0.0, 300.0), (0.0, 0.0, -300.0), (100.0, -50.0, 20.0), (0.0, 0.0, 0.0)]
    shape = tuple(Capsule(1, (0.0, 0.0, 0.0), end, 50.0) for end in ends)
    found = columns(write_recording(tmp_path / "run.rrd", scene(shape=shape)))
    quaternions = np.array(found["/base/robot/link1/body:Capsules3D:quaternions"][0], dtype=np.float64)
    lengths = np.array(found["/base/robot/link1/body:Capsules3D:lengths"][0])
    for (x, y, z, w), length, end in zip(quaternions, lengths, ends, strict=True):
        turned = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        np.testing.assert_allclose(turned * length * 1000, end, atol=1e-3)


def test_an_empty_run_still_opens(tmp_path: Path) -> None:
    assert columns(write_recording(tmp_path / "run.rrd", Scene("empty", ())))


def test_pose_only_steps_show_the_flange(tmp_path: Path) -> None:
    flange = se3.exp([[500.0, 0, 400, 0, 0, 0]])
    step = Step("shot 0", flange, flange[0], np.empty((0, 3)), np.empty((0, 3)))
    found = columns(write_recording(tmp_path / "run.rrd", Scene("pose only", (step,))))
    assert "/base/robot/link0:Transform3D:translation" in found


def test_a_missing_folder_is_told_and_nothing_stays(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="folder does not exist"):
        write_recording(tmp_path / "none" / "run.rrd", scene())
    broken = Scene("broken", (Step("x", np.zeros((1, 3, 3)), np.eye(4), np.empty((0, 3)), np.empty((0, 3))),))
    with pytest.raises(Exception, match=r".*"):
        write_recording(tmp_path / "run.rrd", broken)
    assert list(tmp_path.iterdir()) == []
