"""A run ends when enough is known, goes on while it is not, and never waits for a solver or a viewer."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquire.cell import load_cell, robot_model_of
from acquire.events import Append, Captured, Event, Finish, Moving, PoseStarted, Skipped
from acquire.plan import PlannedPose
from drivers.files.shots import Shot
from drivers.kinematics.mdh import base_from_flange
from measure.demo_cell import write_demo_cell
from measure.running_advice import Advice, Wanted
from measure.running_solve import FEWEST_SHOTS, Question, Solved, SolveWorker
from measure.running_view import Feed, View, scene_of_run
from tests.support.fake_devices import fake_plan

PLAN = fake_plan(3)
MORE = (PlannedPose("extra003a", "A", np.array([0.5, 0.5])), PlannedPose("extra003b", "A", np.array([0.6, 0.5])))


class Fake:
    """A solver with its answers ready."""

    def __init__(self, *answers: Solved | None) -> None:
        self.answers = list(answers)
        self.asked: list[Question] = []

    @property
    def is_idle(self) -> bool:
        return not self.answers

    def ask(self, question: Question) -> None:
        self.asked.append(question)

    def poll(self, wait_s: float = 0.0) -> Solved | None:
        del wait_s
        return self.answers.pop(0) if self.answers else None


def solved(length_u_mm: float | None = None, *, n: int = FEWEST_SHOTS, **more: Any) -> Solved:
    return Solved(n, 0.1, length_u_mm=length_u_mm, **more)


def events_of(plan_poses: tuple[PlannedPose, ...] = PLAN.poses) -> list[Event]:
    events: list[Event] = []
    for i, pose in enumerate(plan_poses):
        shot = Shot(index=i, sphere="A", joints_rad=None, base_from_flange=None, scan=None, sha256=None, time_utc="", status="skipped")
        events += [PoseStarted(pose, i + 1, len(plan_poses)), Skipped(pose.id, shot)]
    return events


@pytest.mark.parametrize(
    ("answer", "enough"),
    [
        (solved(0.05), True),
        (solved(0.06), False),
        (solved(None), False),
        (solved(0.05, n=FEWEST_SHOTS - 1), False),
        (solved(0.05, trouble="no solution"), False),
        (solved(0.05, left_out_rms_mm=0.19, predicted_centre_rms_mm=0.1), True),
        (solved(0.05, left_out_rms_mm=0.21, predicted_centre_rms_mm=0.1), False),
    ],
)
def test_enough_is_an_uncertainty_that_left_out_shots_bear_out(answer: Solved, enough: bool) -> None:
    advice = Advice(Fake(answer), Path("s"), PLAN, Wanted(0.05), lambda _: None)
    assert advice.command_at(events_of()[0]) == (Finish() if enough else None)
    assert all(len(line) <= 80 for line in answer.lines(0.05))


def test_beyond_the_plan_as_far_as_was_allowed_and_not_where_it_has_been() -> None:
    fake = Fake()
    advice = Advice(fake, Path("s"), PLAN, Wanted(0.05, most_further=1), lambda _: None)
    commands = []
    for event in events_of():
        if isinstance(event, Skipped):
            fake.answers = [None, solved(0.1, further=MORE)]
        commands.append(advice.command_at(event))
    assert commands[:-1] == [None] * 5
    last = commands[-1]
    assert isinstance(last, Append)
    assert last.pose.id == "extra003a"
    assert [question.end_rad is not None for question in fake.asked] == [False, False, True]
    assert fake.asked[0].waiting == PLAN.poses[1:]
    assert [advice.command_at(event) for event in events_of(MORE[:1])] == [None, None]


def test_without_a_target_nothing_is_commanded() -> None:
    shown: list[tuple[str, ...]] = []
    advice = Advice(Fake(solved(0.01, best="p2")), Path("s"), PLAN, Wanted(), shown.append)
    assert [advice.command_at(event) for event in events_of()] == [None] * 6
    assert "pose p2 would tell most" in shown[0][1]


def test_the_solver_answers_and_its_death_is_told_once(tmp_path: Path) -> None:
    with SolveWorker() as worker:
        worker.ask(Question(tmp_path, ()))
        worker.ask(Question(tmp_path / "newer", ()))
        assert not worker.is_idle
        answers = [worker.poll(30.0), worker.poll(30.0)]
        assert all(answer is not None and answer.trouble for answer in answers)
        assert worker.is_idle
        os.kill(worker._process.pid or 0, signal.SIGKILL)
        dead = worker.poll(5.0)
        assert dead is not None
        assert "died" in str(dead.trouble)
        worker.ask(Question(tmp_path, ()))
        assert worker.poll(0.0) is None
        assert worker.is_idle


def hang(_items: object) -> None:
    """A viewer that takes nothing."""
    time.sleep(60)


def test_a_viewer_that_hangs_delays_nothing() -> None:
    cloud = np.zeros((8000, 3))
    with Feed(hang) as feed:
        began = time.monotonic()
        slowest = 0.0
        for _ in range(300):
            before = time.monotonic()
            feed.offer(cloud)
            slowest = max(slowest, time.monotonic() - before)
        assert feed.n_dropped >= 200
        # generous bounds for a busy machine; a call that waited for the viewer would wait for a minute
        assert slowest < 1.0
        assert time.monotonic() - began < 10.0
        before = time.monotonic()
    assert time.monotonic() - before < 10.0


def test_a_view_shows_the_nominal_robot_and_what_its_camera_sees(tmp_path: Path) -> None:
    cell = load_cell(write_demo_cell(tmp_path, 1))
    model = robot_model_of(cell)
    assert model is not None
    shown: list[Any] = []

    class Kept(Feed):
        def offer(self, item: object) -> None:
            shown.append(item)

    view = View(Kept(hang), cell, model)
    joints = np.array([0.1, 0.2, 0.1, 0.0, 0.5, 0.0])
    view.show(Moving("p0", joints, 0.1))
    view.show(Moving("p0", joints, 0.1))
    shot = Shot(index=0, sphere="A", joints_rad=joints, base_from_flange=None, scan=None, sha256=None, time_utc="")
    xyz = np.full((3, 4, 3), np.nan, dtype=np.float32)
    xyz[1, 2] = (1, 2, 300)
    view.show(Captured("p0", shot, xyz, None, 1.5))
    assert [glimpse.is_new for glimpse in shown] == [False, True], "readings that come too fast are left out"
    step = shown[1].step
    base_from_camera = base_from_flange(model, joints) @ np.asarray(cell.flange_from_camera)
    np.testing.assert_allclose(step.before_in_base_mm, [base_from_camera[:3, :3] @ [1, 2, 300] + base_from_camera[:3, 3]], atol=1e-4)
    assert step.curves == {"distance from the predicted place": 1.5}
    assert {mark.name for mark in scene_of_run(cell, model).spheres} == set(cell.spheres)
