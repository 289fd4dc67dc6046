"""The capture run on fake devices: order of events, commands, faults, resume, and never a moving robot at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquire.capture import CaptureSettings, planned_seconds, run_capture, settings_of
from acquire.events import (
    Append,
    Captured,
    Command,
    Continue,
    Event,
    Failed,
    Finished,
    Moved,
    Moving,
    Pause,
    Paused,
    PoseStarted,
    Redo,
    Retried,
    RunStarted,
    Settled,
    Skip,
    Skipped,
    Stop,
)
from acquire.plan import Plan, PlannedPose
from drivers.errors import (
    CameraMisconfigured,
    CameraNotReached,
    CameraTimeout,
    ChannelTaken,
    MotionInterrupted,
    MotionRefused,
    MotorsOff,
    NotInRemoteControl,
    RobotNotReached,
    RobotTimeout,
    SafetyStop,
    SettingsError,
)
from drivers.files.session import read_scan, read_session
from drivers.protocols import Safety
from tests.support.capture_bench import Bench, kinds, once, pose_ids
from tests.support.fake_devices import CENTRE_MM, FakeRobot, fake_plan


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.writer.close()


ONE_POSE = ["PoseStarted", "Moved", "Settled", "Captured"]


def test_a_plain_run_tells_every_step_in_order(bench: Bench) -> None:
    events = bench.run(fake_plan(3))
    assert kinds(events) == ["RunStarted", *ONE_POSE * 3, "Finished"]
    assert events[0] == RunStarted(n_poses=3, n_done=0)
    assert events[-1] == Finished(3, 0, 0, stopped=False)
    assert [event.number for event in events if isinstance(event, PoseStarted)] == [1, 2, 3]
    assert not bench.robot.moving


def test_what_is_recorded_is_what_was_measured(bench: Bench) -> None:
    bench.robot.stops_short_rad = 1e-3
    events = bench.run(fake_plan(2))
    session = read_session(bench.folder)
    assert [shot.pose_id for shot in session.shots] == ["p0", "p1"]
    first, plan = session.shots[0], fake_plan(2)
    assert first.joints_rad is not None
    assert first.target_joints_rad is not None
    np.testing.assert_allclose(first.joints_rad, plan.poses[0].joints_rad - 1e-3)
    np.testing.assert_allclose(first.target_joints_rad, plan.poses[0].joints_rad)
    assert first.stillness_rad == pytest.approx(0.0, abs=1e-12)
    assert first.temperatures_c == {"housing": 31.5}
    assert [shot.approach for shot in session.shots] == [[1.0, 0.0], [1.0, -1.0]]
    np.testing.assert_array_equal(read_scan(session, first).xyz_mm, bench.camera.xyz_mm)
    captured = next(event for event in events if isinstance(event, Captured))
    assert captured.finding is not None
    assert captured.prediction_error_mm == pytest.approx(np.linalg.norm(CENTRE_MM - [8, -4, 333]), abs=0.05)


def test_time_is_the_robots_own(bench: Bench) -> None:
    # 0.2 rad at 0.5 rad/s and 0.3 s of settling a pose pass on the robot's clock, and next to none on ours
    bench.run(fake_plan(3))
    assert bench.robot.clock_s == pytest.approx(3 * (0.4 + 0.3), rel=0.25)
    assert planned_seconds(fake_plan(3).poses, settings_of(bench.cell), exposure_s=0.0) == pytest.approx(0.4 * 2 + 3 * 0.8)


@pytest.mark.parametrize("when", [PoseStarted, Moving, Moved, Settled])
def test_skip_leaves_out_the_pose_in_hand(bench: Bench, when: type[Event]) -> None:
    events = bench.run(fake_plan(2), once((when, Skip())))
    assert pose_ids(events) == ["p1"]
    assert [event.pose_id for event in events if isinstance(event, Skipped)] == ["p0"]
    assert events[-1] == Finished(1, 0, 1, stopped=False)
    assert [shot.status for shot in read_session(bench.folder).shots] == ["skipped", "ok"]


def test_redo_takes_the_pose_again_and_replaces_its_shot(bench: Bench) -> None:
    events = bench.run(fake_plan(2), once((Captured, Redo())))
    assert pose_ids(events) == ["p0", "p0", "p1"]
    session = read_session(bench.folder)
    assert [(shot.index, shot.replaces) for shot in session.all_shots] == [(0, None), (1, 0), (2, None)]
    assert [shot.index for shot in session.shots] == [1, 2]


def test_redo_twice_replaces_the_newer_shot(bench: Bench) -> None:
    bench.run(fake_plan(1), once((Captured, Redo()), (Captured, Redo())))
    assert [shot.index for shot in read_session(bench.folder).shots] == [2]


def test_a_failed_repetition_leaves_the_good_shot_in_place(bench: Bench) -> None:
    bench.camera.faults = [None, CameraTimeout("late"), CameraTimeout("late again")]
    events = bench.run(fake_plan(1), once((Captured, Redo()), (Failed, Redo())))
    assert kinds(events).count("Failed") == 1
    shots = read_session(bench.folder).all_shots
    assert [(shot.status, shot.replaces) for shot in shots] == [("ok", None), ("failed", None), ("ok", 0)]


def test_redo_before_any_shot_is_nothing(bench: Bench) -> None:
    assert pose_ids(bench.run(fake_plan(2), once((RunStarted, Redo()), (Moved, Redo())))) == ["p0", "p1"]


@pytest.mark.parametrize("when", [RunStarted, PoseStarted, Moving, Moved, Settled, Captured])
def test_pause_stops_the_robot_and_continue_takes_the_pose_up_again(bench: Bench, when: type[Event]) -> None:
    waited = 0

    def answer(event: Event) -> Command | None:
        nonlocal waited
        if isinstance(event, Paused):
            assert not bench.robot.moving
            waited += 1
            return Continue() if waited == 5 else None
        return Pause() if waited == 0 and isinstance(event, when) else None

    events = bench.run(fake_plan(2), answer)
    assert waited == 5
    assert pose_ids(events) == ["p0", "p1"]
    assert events[-1] == Finished(2, 0, 0, stopped=False)
    assert max(event.number for event in events if isinstance(event, PoseStarted)) == 2


@pytest.mark.parametrize("then", [Skip(), Stop()])
def test_a_pause_may_end_otherwise(bench: Bench, then: Command) -> None:
    events = bench.run(fake_plan(2), once((Moving, Pause()), (Paused, then)))
    assert pose_ids(events) == (["p1"] if isinstance(then, Skip) else [])


@pytest.mark.parametrize("when", [RunStarted, PoseStarted, Moving, Moved, Settled, Captured])
def test_stop_ends_the_run_with_a_standing_robot(bench: Bench, when: type[Event]) -> None:
    events = bench.run(fake_plan(3), once((when, Stop())))
    last = events[-1]
    assert isinstance(last, Finished)
    assert last.stopped
    assert not bench.robot.moving
    assert bench.robot.n_stops >= 1
    assert len(pose_ids(events)) == (1 if when is Captured else 0)


def test_appended_poses_come_last(bench: Bench) -> None:
    more = PlannedPose("more", None, np.array([0.1, 0.1]))
    events = bench.run(fake_plan(2), once((Captured, Append(more))))
    assert pose_ids(events) == ["p0", "p1", "more"]
    assert [event.n_poses for event in events if isinstance(event, PoseStarted)] == [2, 3, 3]


def test_a_resumed_run_leaves_out_what_is_done_and_retakes_what_failed(bench: Bench) -> None:
    bench.camera.faults = [None, CameraTimeout("late"), CameraTimeout("late again")]
    first = bench.run(fake_plan(4), once((Failed, Stop())))
    assert kinds(first)[-1] == "Finished"
    bench.resumed()
    events = bench.run(fake_plan(4))
    assert events[0] == RunStarted(n_poses=4, n_done=1)
    assert pose_ids(events) == ["p1", "p2", "p3"]
    shots = read_session(bench.folder).shots
    assert [shot.pose_id for shot in shots] == ["p0", "p1", "p2", "p3"]
    assert all(shot.status == "ok" for shot in shots)


def test_a_finished_session_needs_nothing_more(bench: Bench) -> None:
    bench.run(fake_plan(2))
    bench.resumed()
    assert kinds(bench.run(fake_plan(2))) == ["RunStarted", "Finished"]


def test_without_a_sphere_the_shot_is_kept_as_failed_with_its_scan(bench: Bench) -> None:
    bench.camera.xyz_mm = np.where(np.isfinite(bench.camera.xyz_mm), bench.camera.xyz_mm * [1, 1, 0] + [0, 0, 330], np.nan).astype(np.float32)
    events = bench.run(fake_plan(5), capture=CaptureSettings(most_missing_in_a_row=None))
    assert kinds(events).count("Failed") == 5
    session = read_session(bench.folder)
    assert {shot.status for shot in session.shots} == {"failed"}
    assert "no_sphere" in str(session.shots[0].reason)
    assert len(read_scan(session, session.shots[0]).xyz_mm) > 0


def test_a_camera_fault_is_retried_once(bench: Bench) -> None:
    bench.camera.faults = [CameraTimeout("late")]
    events = bench.run(fake_plan(1))
    assert kinds(events) == ["RunStarted", "PoseStarted", "Moved", "Settled", "Retried", "Captured", "Finished"]
    assert any(isinstance(event, Retried) and "late" in event.reason for event in events)


def test_a_stale_frame_is_not_taken(bench: Bench) -> None:
    bench.run(fake_plan(1))
    bench.resumed()

    def answer(event: Event) -> Command | None:
        if isinstance(event, Captured):
            bench.camera.sequence = 0
        return None

    events = bench.run(fake_plan(2), answer)
    assert kinds(events).count("Captured") == 1
    events = bench.run(fake_plan(4), answer)
    assert "Retried" in kinds(events)
    assert not any(shot.status == "ok" and shot.scan is None for shot in read_session(bench.folder).all_shots)


def test_a_camera_that_fails_at_every_pose_ends_the_run(bench: Bench) -> None:
    bench.camera.faults = [CameraTimeout("late")] * 100
    with pytest.raises(CameraTimeout):
        bench.run(fake_plan(10))
    assert [shot.status for shot in read_session(bench.folder).shots] == ["failed", "failed"]


@pytest.mark.parametrize("fault", [CameraNotReached("gone"), CameraMisconfigured("wrong unit"), OSError("no space"), KeyboardInterrupt()])
def test_other_faults_end_the_run_and_stop_the_robot(bench: Bench, fault: Exception) -> None:
    bench.camera.faults = [fault]
    with pytest.raises(type(fault)):
        bench.run(fake_plan(2))
    assert bench.robot.n_stops >= 1
    assert read_session(bench.folder).shots == ()


def test_a_refused_pose_is_left_out_and_told(bench: Bench) -> None:
    plan = fake_plan(3)
    bench.robot.refused = [plan.poses[1].joints_rad]
    events = bench.run(plan)
    assert pose_ids(events) == ["p0", "p2"]
    failed = next(event for event in events if isinstance(event, Failed))
    assert "declines" in failed.reason
    assert failed.shot.scan is None


def test_a_robot_that_refuses_everything_ends_the_run(bench: Bench) -> None:
    plan = fake_plan(5)
    bench.robot.refused = [pose.joints_rad for pose in plan.poses]
    with pytest.raises(MotionRefused):
        bench.run(plan)


@pytest.mark.parametrize("kind", [NotInRemoteControl, MotorsOff, ChannelTaken])
def test_a_robot_that_nobody_may_move_ends_the_run_at_once(bench: Bench, kind: type[MotionRefused]) -> None:
    """It is not the pose's fault: no pose is written off for it."""

    def refuse(joints_rad: object, *, speed_rad_s: float) -> None:
        del joints_rad, speed_rad_s
        raise kind("somebody else is the master")

    bench.robot.start_move = refuse  # type: ignore[method-assign]
    with pytest.raises(kind):
        bench.run(fake_plan(5))
    assert read_session(bench.folder).shots == ()


def test_a_stuck_motion_is_stopped_at_its_deadline(bench: Bench) -> None:
    bench.robot.stuck = True
    with pytest.raises(RobotTimeout):
        bench.run(fake_plan(1))
    assert not bench.robot.moving
    assert bench.robot.n_stops >= 1
    assert bench.robot.clock_s < 10


def test_a_clock_that_stands_still_is_no_endless_wait(bench: Bench) -> None:
    bench.robot.stuck = True
    bench.robot.wait = lambda seconds: None  # type: ignore[method-assign]
    with pytest.raises(RobotTimeout):
        bench.run(fake_plan(1))


def test_a_robot_that_stands_elsewhere_is_told(bench: Bench) -> None:
    bench.robot.stops_short_rad = 0.05
    with pytest.raises(MotionInterrupted, match="from its target"):
        bench.run(fake_plan(1))


def test_an_unsettled_robot_gives_no_shot(bench: Bench) -> None:
    bench.robot.tremble_rad = 2e-4
    with pytest.raises(RobotTimeout, match="rest"):
        bench.run(fake_plan(5))
    shots = read_session(bench.folder).shots
    assert [shot.status for shot in shots] == ["failed", "failed"]
    assert all(shot.scan is None for shot in shots)


def test_a_robot_that_moves_during_the_exposure_gives_no_shot(bench: Bench) -> None:
    def push() -> None:
        bench.robot.target = bench.robot.target + 5e-4

    bench.camera.before = push
    events = bench.run(fake_plan(1))
    failed = next(event for event in events if isinstance(event, Failed))
    assert "during the exposure" in failed.reason
    assert failed.shot.scan is not None


@pytest.mark.parametrize("safety", [Safety.PROTECTIVE_STOP, Safety.EMERGENCY_STOP])
@pytest.mark.parametrize("reads", [1, 4, 12])
def test_a_safety_stop_ends_the_run(bench: Bench, safety: Safety, reads: int) -> None:
    def trip(robot: FakeRobot) -> None:
        if robot.n_reads >= reads:
            robot.safety = safety

    bench.robot.on_read = trip
    with pytest.raises(SafetyStop, match="stop"):
        bench.run(fake_plan(2))
    assert bench.robot.n_stops >= 1


def test_the_first_error_stays_when_the_robot_cannot_be_stopped(bench: Bench) -> None:
    """Once in the run and once more where the devices are let go: the operator reads the cause and, once, that it may move."""

    def lost() -> None:
        raise RobotNotReached("the link is gone")

    bench.robot.stop = lost  # type: ignore[method-assign]
    bench.camera.faults = [CameraNotReached("unplugged")]
    with pytest.raises(CameraNotReached) as caught, bench.devices:
        bench.run(fake_plan(1))
    assert str(caught.value).count("could not be told to stop (the link is gone): press the emergency stop") == 1


def test_ctrl_c_is_no_reason_to_hide_that_the_robot_may_move(bench: Bench) -> None:
    def lost() -> None:
        raise RobotNotReached("the link is gone")

    bench.robot.stop = lost  # type: ignore[method-assign]
    with pytest.raises(RobotNotReached, match="link is gone"), bench.devices:
        raise KeyboardInterrupt


def test_letting_go_of_the_run_stops_the_robot(bench: Bench) -> None:
    steps = run_capture(bench.devices, bench.cell, fake_plan(3), bench.writer)
    while not isinstance(next(steps), Moving):
        pass
    assert bench.robot.moving
    steps.close()
    assert not bench.robot.moving


def test_several_frames_become_their_mean_and_are_kept(bench: Bench) -> None:
    scans = [bench.camera.xyz_mm + np.float32(shift) for shift in (-0.01, 0.0, 0.01)]
    scans[1][40, 60] += 50.0
    order = iter(scans)

    def expose() -> None:
        bench.camera.xyz_mm = next(order)

    bench.camera.before = expose
    bench.run(fake_plan(1), capture=CaptureSettings(frames=3))
    session = read_session(bench.folder)
    assert len(session.shots[0].frames) == 3
    mean = read_scan(session, session.shots[0]).xyz_mm
    assert np.isnan(mean[40, 60]).all()
    seen = np.isfinite(mean)
    np.testing.assert_allclose(mean[seen], scans[1][seen], atol=1e-3)


def test_a_plan_with_via_points_is_walked_along(bench: Bench) -> None:
    plan = fake_plan(4, vias=True)
    bench.run(plan, once((Captured, Redo()), (PoseStarted, Continue()), (PoseStarted, Skip())))
    way = [point for pose in plan.poses for point in (*pose.via_rad, pose.joints_rad)]
    steps = [next(i for i, point in enumerate(way) if np.allclose(point, visited)) for visited in bench.robot.visited]
    # never more than one point further along the way, nor back, whatever was skipped or taken again
    assert max(abs(b - a) for a, b in pairwise(steps)) <= 1
    assert steps[0] == 0
    assert steps[-1] == len(way) - 1


def test_a_resumed_plan_with_via_points_starts_at_its_beginning(bench: Bench) -> None:
    plan = fake_plan(3, vias=True)
    bench.run(plan, once((Captured, Continue()), (Captured, Stop())))
    bench.resumed()
    bench.robot.visited.clear()
    bench.robot.target = np.array([-1.0, 1.0])
    bench.run(plan)
    assert len(bench.robot.visited) == 6


def test_an_unknown_sphere_is_refused_before_anything_moves(bench: Bench) -> None:
    with pytest.raises(SettingsError, match="sphere 'B'"):
        bench.run(fake_plan(1, sphere="B"))
    assert bench.robot.visited == []


COMMANDS: list[Command | None] = [None, Continue(), Skip(), Redo(), Pause(), Stop(), Append(PlannedPose("x", "A", np.array([0.3, 0.3])))]


@settings(max_examples=60)
@given(data=st.data())
def test_any_commands_at_any_time_leave_a_readable_session_and_a_standing_robot(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        try:
            n_events = data.draw(st.integers(0, 60))
            bench.camera.faults = data.draw(st.lists(st.sampled_from([None, CameraTimeout("late"), CameraNotReached("gone")]), max_size=3))
            commands = data.draw(st.lists(st.sampled_from(COMMANDS), max_size=40))
            last = at_random(bench, fake_plan(3, vias=data.draw(st.booleans())), commands, n_events)
        finally:
            bench.writer.close()
        assert not bench.robot.moving
        shots = read_session(bench.folder).shots
        ids = [shot.pose_id for shot in shots]
        good = [shot.pose_id for shot in shots if shot.status == "ok"]
        assert len(set(good)) == len(good), "a pose taken again must replace its earlier shot"
        assert all(shot.scan is not None and shot.joints_rad is not None for shot in shots if shot.status == "ok")
        if isinstance(last, Finished) and not last.stopped:
            assert {"p0", "p1", "p2"} <= set(ids)


def at_random(bench: Bench, plan: Plan, commands: list[Command | None], n_events: int) -> Event:
    """Let a run go for some events under these commands, then let go of it; the last event."""
    left = iter(commands)
    steps = run_capture(bench.devices, bench.cell, plan, bench.writer)
    event: Event = next(steps)
    with suppress(StopIteration, CameraNotReached, CameraTimeout):
        for _ in range(n_events):
            assert isinstance(event, Moving) or not bench.robot.moving
            event = steps.send(next(left, Stop() if isinstance(event, Paused) else None))
    steps.close()
    return event
