"""What suspends a run, what a person may answer, and that nobody's answer ends it with the error."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquire.capture import CaptureSettings
from acquire.capture_settings import WarmUpSettings
from acquire.capture_states import RunState
from acquire.capture_vigil import SphereMissing, TemperatureDrift
from acquire.events import (
    Append,
    Captured,
    Cause,
    Command,
    Continue,
    Event,
    Finish,
    Finished,
    Pause,
    Paused,
    PoseStarted,
    Redo,
    Skip,
    Stop,
    Suspended,
    WarmingUp,
)
from acquire.plan import PlannedPose
from drivers.errors import (
    CameraLost,
    CameraMisconfigured,
    CameraNotReached,
    CameraTimeout,
    MotionInterrupted,
    ProtectiveStop,
    RobotNotReached,
    SafetyStop,
    SpherecalError,
)
from drivers.files.session import read_scan, read_session
from drivers.protocols import CameraInfo, Safety
from tests.support.capture_bench import Answer, Bench, kinds, once, pose_ids
from tests.support.fake_devices import FakeRobot, fake_plan


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.writer.close()


def suspended(events: list[Event]) -> list[Suspended]:
    return [event for event in events if isinstance(event, Suspended)]


def trip_once(bench: Bench, at_read: int, safety: Safety = Safety.PROTECTIVE_STOP) -> None:
    """The controller stops the arm at one reading, and somebody clears it while the run waits."""

    def trip(robot: FakeRobot) -> None:
        if robot.n_reads == at_read:
            robot.stop()
            robot.safety = safety

    bench.robot.on_read = trip


def clearing(bench: Bench, *, holds: int = 0, then: Command | None = None) -> Answer:
    """Somebody says "wait" some times, puts everything right, and goes on."""
    left = holds

    def answer(event: Event) -> Command | None:
        nonlocal left
        if not isinstance(event, Suspended):
            return None
        assert not bench.robot.moving
        assert event.state is RunState.PAUSED
        left -= 1
        if left >= 0:
            return Pause()
        bench.robot.safety = Safety.NORMAL
        return then or Continue()

    return answer


@pytest.mark.parametrize("at_read", [2, 4, 9, 14])
def test_after_a_protective_stop_the_pose_in_hand_is_taken_up(bench: Bench, at_read: int) -> None:
    trip_once(bench, at_read)
    events = bench.run(fake_plan(3), clearing(bench, holds=3))
    assert [event.cause for event in suspended(events)] == [Cause.SAFETY] * 4
    assert isinstance(suspended(events)[0].error, ProtectiveStop)
    assert pose_ids(events) == ["p0", "p1", "p2"]
    assert events[-1] == Finished(3, 0, 0, stopped=False)


def test_a_continue_while_the_stop_is_still_active_moves_nothing(bench: Bench) -> None:
    trip_once(bench, 6)
    n = 0

    def answer(event: Event) -> Command | None:
        nonlocal n
        if isinstance(event, Suspended):
            n += 1
            return Continue() if n < 5 else Stop()
        return None

    visited = len(bench.robot.visited)
    events = bench.run(fake_plan(2), answer)
    assert len(suspended(events)) == 5
    assert len(bench.robot.visited) == visited + 1
    assert bench.robot.safety is Safety.PROTECTIVE_STOP, "nobody but a person clears a stop"
    assert isinstance(events[-1], Finished)
    assert events[-1].state is RunState.ABORTED


@pytest.mark.parametrize(("fault", "cause"), [(CameraNotReached("gone"), Cause.CAMERA), (RobotNotReached("cut"), Cause.ROBOT)])
def test_what_was_lost_is_opened_again_by_a_continue(bench: Bench, fault: SpherecalError, cause: Cause) -> None:
    opened: list[str] = []
    robot_open, camera_open = bench.robot.open, bench.camera.open
    bench.robot.open = lambda: (opened.append("robot"), robot_open())[1]  # type: ignore[method-assign,func-returns-value]
    bench.camera.open = lambda: (opened.append("camera"), camera_open())[1]  # type: ignore[method-assign,func-returns-value]
    bench.camera.faults = [None, fault]

    def answer(event: Event) -> Command | None:
        if isinstance(event, Suspended) and cause is Cause.CAMERA:
            bench.camera.sequence = 0  # a new connection counts anew
        return Continue() if isinstance(event, Suspended) else None

    events = bench.run(fake_plan(3), answer)
    assert [event.cause for event in suspended(events)] == [cause]
    assert opened == ["camera" if cause is Cause.CAMERA else "robot"]
    assert pose_ids(events) == ["p0", "p1", "p2"]


def test_a_camera_that_stays_away_suspends_again(bench: Bench) -> None:
    bench.camera.faults = [CameraNotReached("gone")] * 3
    events = bench.run(fake_plan(1), clearing(bench))
    assert len(suspended(events)) == 3
    assert pose_ids(events) == ["p0"]


def test_another_camera_than_the_one_that_was_lost_is_not_gone_on_with(bench: Bench) -> None:
    bench.camera.info = right = CameraInfo("fake", serial="c1", settings_digest="abc")
    bench.camera.faults = [None, CameraLost("cut")]
    others = [replace(right, serial="c2"), replace(right, settings_digest="def"), right]

    def answer(event: Event) -> Command | None:
        if isinstance(event, Suspended):
            bench.camera.info = others.pop(0)
            return Continue()
        return None

    with bench.devices:
        events = bench.run(fake_plan(3), answer)
    assert [event.cause for event in suspended(events)] == [Cause.CAMERA] * 3
    assert [type(event.error) for event in suspended(events)] == [CameraLost, CameraMisconfigured, CameraMisconfigured]
    assert pose_ids(events) == ["p0", "p1", "p2"]
    shots = read_session(bench.folder).shots
    assert [shot.pose_id for shot in shots] == ["p0", "p1", "p2"]


@pytest.mark.parametrize("allowed", [0, 1, 2])
def test_a_full_disk_suspends_and_the_shot_in_hand_is_taken_again(bench: Bench, allowed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is left of the shot that found no room, however far it came: its scan, the folder's entry, its line."""
    fsync, left = os.fsync, [100, allowed, 0]

    def full(descriptor: int) -> None:
        left[0] -= 1
        if left[0] < 0 and left[1] == 0 and left[2] == 0:
            raise OSError(28, "No space left on device")
        left[1] -= left[0] < 0 < left[1]
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", full)

    def answer(event: Event) -> Command | None:
        if isinstance(event, Captured) and event.pose_id == "p0":
            left[0] = 0
        if isinstance(event, Suspended):
            left[2] = 1  # somebody makes room
            return Continue()
        return None

    events = bench.run(fake_plan(3), answer)
    assert [(event.cause, event.pose_id) for event in suspended(events)] == [(Cause.DISK, "p1")]
    assert pose_ids(events) == ["p0", "p1", "p2"]
    session = read_session(bench.folder)
    assert [shot.pose_id for shot in session.shots] == ["p0", "p1", "p2"]
    for shot in session.shots:
        read_scan(session, shot)


def test_what_the_camera_tells_of_its_link_is_kept_with_the_shot(bench: Bench) -> None:
    bench.camera.diagnostics = {"packets_resent": 3, "file": "a.ply", "noise": float("nan")}
    bench.run(fake_plan(1))
    (line,) = (bench.folder / "shots.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["diagnostics"] == {"packets_resent": 3, "file": "a.ply"}


def test_errors_in_a_row_begin_anew_after_a_continue(bench: Bench) -> None:
    bench.camera.faults = [CameraTimeout("late")] * 8
    events = bench.run(fake_plan(5), clearing(bench))
    assert [event.cause for event in suspended(events)] == [Cause.CAMERA]
    assert kinds(events).count("Failed") == 3
    assert pose_ids(events) == ["p3", "p4"]


def without_sphere(bench: Bench) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    flat = bench.camera.xyz_mm * [1, 1, 0] + [0, 0, 330]
    return np.where(np.isfinite(bench.camera.xyz_mm), flat, np.nan).astype(np.float32)


def test_a_missing_sphere_suspends_and_its_poses_can_be_had_again(bench: Bench) -> None:
    whole, bench.camera.xyz_mm = bench.camera.xyz_mm, without_sphere(bench)

    def answer(event: Event) -> Command | None:
        if isinstance(event, Suspended):
            bench.camera.xyz_mm = whole
            return Redo()
        return None

    events = bench.run(fake_plan(5), answer)
    assert [event.cause for event in suspended(events)] == [Cause.SPHERE]
    assert kinds(events).count("Failed") == 3
    assert pose_ids(events) == ["p2", "p3", "p4"]


def test_a_missing_sphere_that_nobody_looks_at_ends_the_run(bench: Bench) -> None:
    bench.camera.xyz_mm = without_sphere(bench)
    with pytest.raises(SphereMissing, match="sphere A was not found in 2 shots"):
        bench.run(fake_plan(5), capture=CaptureSettings(most_missing_in_a_row=2))
    assert [shot.status for shot in read_session(bench.folder).shots] == ["failed", "failed"]


def test_a_camera_that_warms_up_under_way_suspends(bench: Bench) -> None:
    bench.camera.warms_k_per_frame = 2.0
    with pytest.raises(TemperatureDrift, match=r"\+6\.0 K"):
        bench.run(fake_plan(6))
    assert len(read_session(bench.folder).shots) == 4
    bench.resumed()
    events = bench.run(fake_plan(6), clearing(bench), CaptureSettings(largest_drift_k=1.0))
    assert pose_ids(events) == ["p4", "p5"]
    bench.resumed()
    assert suspended(bench.run(fake_plan(9), capture=CaptureSettings(largest_drift_k=None))) == []


@pytest.mark.parametrize(("then", "captured"), [(Skip(), ["p1"]), (Stop(), []), (Finish(), [])])
def test_a_suspended_run_may_end_otherwise(bench: Bench, then: Command, captured: list[str]) -> None:
    trip_once(bench, 5)
    events = bench.run(fake_plan(2), clearing(bench, then=then))
    assert pose_ids(events) == captured
    last = events[-1]
    assert isinstance(last, Finished)
    assert last.state is (RunState.ABORTED if isinstance(then, Stop) else RunState.DONE)
    assert last.n_left == (0 if isinstance(then, Skip) else 2)


def test_nobody_answers_and_the_error_is_told(bench: Bench) -> None:
    trip_once(bench, 5, Safety.SAFEGUARD_STOP)
    with pytest.raises(SafetyStop):
        bench.run(fake_plan(2))
    assert not bench.robot.moving
    bench.robot.safety, bench.robot.on_read, bench.robot.stops_short_rad = Safety.NORMAL, lambda _: None, 0.1
    with pytest.raises(MotionInterrupted):
        bench.run(fake_plan(2))


def test_finish_ends_after_the_pose_in_hand(bench: Bench) -> None:
    events = bench.run(fake_plan(4), once((PoseStarted, Finish())))
    assert pose_ids(events) == ["p0"]
    last = events[-1]
    assert isinstance(last, Finished)
    assert (last.state, last.n_left) == (RunState.DONE, 3)


def test_redo_at_the_start_of_a_pose_comes_before_it(bench: Bench) -> None:
    left = [None, Redo()]
    events = bench.run(fake_plan(3), lambda event: left.pop(0) if left and isinstance(event, PoseStarted) else None)
    assert pose_ids(events) == ["p0", "p0", "p1", "p2"]


def test_appended_poses_are_approached_slowly(bench: Bench) -> None:
    speeds: list[float] = []
    start = bench.robot.start_move

    def start_move(joints_rad: np.ndarray[tuple[int, ...], np.dtype[np.float64]], *, speed_rad_s: float) -> None:
        speeds.append(speed_rad_s)
        start(joints_rad, speed_rad_s=speed_rad_s)

    bench.robot.start_move = start_move  # type: ignore[method-assign]
    bench.run(fake_plan(1), once((PoseStarted, Append(PlannedPose("more", None, np.array([0.4, 0.1]))))))
    assert speeds == [0.5, 0.1]


WARM = WarmUpSettings(every_s=5, window_s=60, longest_s=1200)


def test_a_warm_up_ends_when_the_drift_does(bench: Bench) -> None:
    bench.camera.warms_k_per_frame = 1.0

    def cool() -> None:
        bench.camera.warms_k_per_frame *= 0.9

    bench.camera.before = cool
    events = bench.run(fake_plan(2), capture=CaptureSettings(warm_up=WARM))
    warming = [event for event in events if isinstance(event, WarmingUp)]
    assert [event.warm for event in warming].count(True) == 1
    assert warming[-1].warm
    assert warming[-1].drift_k_per_min is not None
    assert warming[-1].drift_k_per_min <= WARM.most_k_per_min
    # 1 K a frame that falls by a tenth each: 12 frames a minute, below 0.3 K/min when 10 x 0.9^k x (1 - 0.9^12) < 0.3
    assert 120 < warming[-1].seconds < 300
    assert pose_ids(events) == ["p0", "p1"]


def test_a_drift_of_distance_counts_too(bench: Bench) -> None:
    bench.camera.before = lambda: bench.camera.xyz_mm.__iadd__(np.float32(0.01))
    with pytest.raises(CameraTimeout, match="120 um/min"):
        bench.run(fake_plan(1), capture=CaptureSettings(warm_up=WARM))
    assert bench.robot.visited == []


def test_a_warm_up_can_be_paused_skipped_and_given_up(bench: Bench) -> None:
    bench.camera.warms_k_per_frame = 1.0
    settings = CaptureSettings(warm_up=WARM, largest_drift_k=None)
    events = bench.run(fake_plan(1), once((WarmingUp, Pause()), (Paused, Continue()), (WarmingUp, Skip())), settings)
    assert kinds(events)[:2] == ["RunStarted", "WarmingUp"]
    assert pose_ids(events) == ["p0"]
    bench.resumed()
    events = bench.run(fake_plan(2), clearing(bench), settings)
    assert [event.cause for event in suspended(events)] == [Cause.CAMERA]
    assert pose_ids(events) == ["p1"]


def test_a_camera_that_tells_nothing_cannot_be_warmed_up(bench: Bench) -> None:
    bench.camera.xyz_mm = np.full_like(bench.camera.xyz_mm, np.nan)
    bench.camera.tells_temperature = False
    with pytest.raises(CameraTimeout, match="nothing tells"):
        bench.run(fake_plan(1), capture=CaptureSettings(warm_up=WARM))
    assert bench.robot.clock_s < 200
