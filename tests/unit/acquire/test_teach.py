"""Teaching: what is kept is where the arm stands, and it is held whenever the person does not lead it; always at the end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from acquire.cell import Cell, load_cell
from acquire.motion import MotionSettings
from acquire.plan import PlannedPose
from acquire.teach import Lesson, TeachSettings, aimed_sphere, run_teach
from acquire.teach_events import Finish, Guide, Jog, Looked, NextSphere, Record, Recorded, Taught, TeachCommand, TeachEvent, Told, Undo, Via
from drivers.errors import CameraTimeout, MotionRefused, RobotNotReached, SettingsError
from drivers.kinematics import mdh
from drivers.models import load_robot_model
from drivers.protocols import Camera3D, Devices, FloatArray, Frame3D, Robot, RobotState, Safety
from tests.support.fake_devices import CELL_YAML, FakeCamera, FakeRobot, fake_cell

HELD = TeachSettings(guided=False)


class SoftRobot(FakeRobot):
    """Can be led by hand: every reading while it is soft moves it along a script."""

    def __init__(self, script: FloatArray | None = None) -> None:
        super().__init__()
        self.soft = False
        self.script = list(np.zeros((0, 2)) if script is None else script)
        self.n_soft = 0
        self.refuses = False
        self.when_soft: Callable[[], None] = lambda: None
        self.when_held: Callable[[], None] = lambda: None

    def start_freedrive(self) -> None:
        if self.refuses:
            raise MotionRefused("the pendant is the master", remedy="Switch to remote control.")
        self.soft = True
        self.n_soft += 1
        self.when_soft()

    def end_freedrive(self) -> None:
        self.when_held()
        self.soft = False

    def read_state(self) -> RobotState:
        if self.soft and self.script:
            self.target = np.array(self.script.pop(0))
        return super().read_state()


def devices_of(robot: FakeRobot, camera: FakeCamera | None = None) -> Devices:
    as_robot: Robot = robot
    as_camera: Camera3D = camera or FakeCamera()
    return Devices(as_robot, as_camera)


def drive(lesson: Lesson, *commands: TeachCommand | None) -> list[TeachEvent]:
    """Give one command at each look; every event."""
    events: list[TeachEvent] = [next(lesson)]
    for command in commands:
        event = lesson.send(command)
        events.append(event)
        if not isinstance(event, Looked | Taught):
            events.append(next(lesson))
    return events


def poses_in(events: list[TeachEvent]) -> tuple[PlannedPose, ...]:
    looks = [event for event in events if isinstance(event, Looked)]
    return looks[-1].poses


def told(events: list[TeachEvent]) -> list[str]:
    return [event.text for event in events if isinstance(event, Told)]


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return fake_cell(tmp_path)


def test_poses_are_kept_where_the_hand_left_the_arm(cell: Cell) -> None:
    robot = SoftRobot(np.linspace([0.1, 0.2], [0.5, -0.4], 6))
    camera = FakeCamera()
    soft_at_picture: list[bool] = []
    camera.before = lambda: soft_at_picture.append(robot.soft)
    events = drive(run_teach(devices_of(robot, camera), cell, TeachSettings()), None, None, Record(), None, Record(), Finish())
    first, second = poses_in(events)
    np.testing.assert_allclose(first.joints_rad, np.linspace([0.1, 0.2], [0.5, -0.4], 6)[2], atol=1e-6)
    np.testing.assert_allclose(second.joints_rad, np.linspace([0.1, 0.2], [0.5, -0.4], 6)[4], atol=1e-6)
    assert [pose.id for pose in (first, second)] == ["t001", "t002"]
    assert (first.sphere, first.via_rad) == ("A", ())
    # soft while looking, held for the two pictures that count
    assert soft_at_picture == [True, True, True, False, True, True, False, True]
    assert isinstance(events[-1], Taught)
    assert events[-1].poses == (first, second)


@pytest.mark.parametrize(("where", "k"), [*(("read", k) for k in range(1, 36, 2)), *(("picture", k) for k in range(1, 12))])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RobotNotReached])
def test_the_arm_is_held_whatever_ends_the_lesson_and_wherever(cell: Cell, where: str, k: int, error: type[BaseException]) -> None:
    robot, camera = SoftRobot(), FakeCamera()
    n_calls = 0

    def bite(*_: object) -> None:
        nonlocal n_calls
        n_calls += 1
        if n_calls == k:
            raise error("now")

    if where == "read":
        robot.on_read = bite
    else:
        camera.before = bite
    lesson = run_teach(devices_of(robot, camera), cell, TeachSettings())
    try:
        drive(lesson, Record(), Via(), None, Record(), Undo(), None, Guide(False), Guide(True))
    except error:
        pass
    else:
        lesson.close()
    assert not robot.soft
    assert robot.n_soft >= 1


def test_the_arm_is_held_when_the_caller_lets_go_or_forgets(cell: Cell) -> None:
    for end in ("close", "throw"):
        robot = SoftRobot()
        lesson = run_teach(devices_of(robot), cell, TeachSettings())
        next(lesson)
        assert robot.soft
        if end == "close":
            lesson.close()
        else:
            with pytest.raises(KeyboardInterrupt):
                lesson.throw(KeyboardInterrupt())
        assert not robot.soft


def test_an_interrupt_while_the_arm_goes_soft_or_stiff_leaves_it_held(cell: Cell) -> None:
    robot = SoftRobot()

    def once() -> None:
        robot.when_soft = robot.when_held = lambda: None
        raise KeyboardInterrupt

    robot.when_soft = once
    with pytest.raises(KeyboardInterrupt):
        next(run_teach(devices_of(robot), cell, TeachSettings()))
    assert not robot.soft
    lesson = run_teach(devices_of(robot), cell, TeachSettings())
    next(lesson)
    robot.when_held = once
    with pytest.raises(KeyboardInterrupt):
        lesson.send(Record())
    assert not robot.soft


def test_a_pose_without_a_sphere_is_kept_only_on_purpose(cell: Cell) -> None:
    camera = FakeCamera()
    camera.xyz_mm = np.full_like(camera.xyz_mm, 400.0)
    events = drive(run_teach(devices_of(FakeRobot(), camera), cell, HELD), Record(), Record(anyway=True))
    first, refused = events[0], told(events)[0]
    assert isinstance(first, Looked)
    assert first.finding is None
    assert first.reason
    assert refused.startswith(f"not kept: {first.reason}")
    (kept,) = [event for event in events if isinstance(event, Recorded)]
    assert kept.finding is None
    assert poses_in(events) == (kept.pose,)


def test_a_trembling_arm_is_not_kept(cell: Cell) -> None:
    robot = FakeRobot()
    robot.tremble_rad = 1e-3
    events = drive(run_teach(devices_of(robot), cell, TeachSettings(guided=False, motion=MotionSettings(settle_timeout_s=1.0))), Record())
    assert told(events) == ["not kept: the arm still moves by 0.002 rad"]


def test_ways_and_undoing(cell: Cell) -> None:
    robot = SoftRobot(np.linspace([0.0, 0.0], [0.9, 0.9], 10))
    lesson = run_teach(devices_of(robot), cell, TeachSettings())
    events = drive(lesson, Record(), Via(), Via(), Undo(), Record(), Via(), Undo(), Undo(), Record(), Undo(), Undo(), Undo(), Undo(), None)
    kept = [event.pose for event in events if isinstance(event, Recorded)]
    assert [len(pose.via_rad) for pose in kept] == [0, 1, 1]
    assert [pose.id for pose in kept] == ["t001", "t002", "t002"]
    assert told(events)[-4:] == [
        "pose t002 is forgotten",
        "the last point of the way is forgotten",
        "pose t001 is forgotten",
        "there is nothing to undo",
    ]
    assert poses_in(events) == ()


def test_a_stop_is_told_and_the_arm_can_be_led_again_after_it(cell: Cell) -> None:
    robot = SoftRobot()
    lesson = run_teach(devices_of(robot), cell, TeachSettings())
    assert isinstance(next(lesson), Looked)
    robot.safety = Safety.PROTECTIVE_STOP
    stopped = lesson.send(None)
    assert isinstance(stopped, Looked)
    assert stopped.reason is not None
    assert "stopped" in stopped.reason
    assert not stopped.guided
    robot.safety = Safety.NORMAL
    assert not robot.soft
    events = drive(lesson, Guide(True))
    assert told(events) == ["the arm can be led by hand"]
    assert robot.soft
    robot.refuses = True
    assert told(drive(lesson, Guide(True))) == ["the pendant is the master. Switch to remote control."]
    assert not robot.soft


def test_a_camera_that_is_late_is_told(cell: Cell) -> None:
    events = drive(run_teach(devices_of(FakeRobot(), FakeCamera([CameraTimeout("no frame", remedy="Wait.")])), cell, HELD), None)
    first, second = events
    assert isinstance(first, Looked)
    assert isinstance(second, Looked)
    assert (first.reason, second.reason) == ("no picture: no frame", None)


def test_jogging_moves_one_axis_and_an_interrupt_stops_it(cell: Cell) -> None:
    robot = FakeRobot()
    lesson = run_teach(devices_of(robot), cell, HELD)
    events = drive(lesson, Jog(1, 0.1), Jog(1, 0.1), Jog(0, -0.05), Jog(7, 0.1))
    np.testing.assert_allclose(robot.joints, [-0.05, 0.2], atol=1e-9)
    assert told(events)[-1] == "the robot has no axis 8 that can be moved"
    robot.refused = [np.array([0.05, 0.2])]
    assert told(drive(lesson, Jog(0, 0.1))) == ["the controller declines. Ask it why."]
    stops = robot.n_stops

    def bite(robot: FakeRobot) -> None:
        if robot.moving:
            raise KeyboardInterrupt

    robot.on_read = bite
    with pytest.raises(KeyboardInterrupt):
        lesson.send(Jog(0, -0.5))
    # the second reading of halt() bites too: the stop itself came first
    assert robot.n_stops > stops


def test_jogging_keeps_the_limits_and_clear_of_what_the_cell_knows(tmp_path: Path) -> None:
    text = CELL_YAML.replace("model: null", "model: ur5e")
    text += "obstacles: [{name: wall, kind: box, size_mm: [20, 4000, 4000], centre_in_base_mm: [-500, 0, 0]}]\n"
    cell = fake_cell(tmp_path, text)
    model = load_robot_model("ur5e")
    robot = FakeRobot()
    # stretched out to the side, with the wall in front
    robot.start = robot.target = np.array([np.pi / 2, -0.3, 0.3, 0.0, 0.5, 0.0])
    assert abs(mdh.base_from_flange(model, robot.target)[0, 3]) < 400
    lesson = run_teach(devices_of(robot), cell, HELD)
    events = drive(lesson, Jog(5, 20.0), Jog(0, -1.5), Record(anyway=True), Jog(0, 0.2), Record(anyway=True))
    assert told(events)[0] == "axis 6 would leave the limits of ur5e"
    assert "something would touch" in told(events)[1]
    kept = [event for event in events if isinstance(event, Recorded)]
    assert [event.touches for event in kept] == [False, False]
    # beyond the wall's far side the other way round: the straight way back sweeps through it
    robot.start = robot.target = np.array([-np.pi / 2, -0.3, 0.3, 0.0, 0.5, 0.0])
    events = drive(lesson, Record(anyway=True))
    (kept_beyond,) = [event for event in events if isinstance(event, Recorded)]
    assert kept_beyond.touches


def test_what_cannot_be_taught(cell: Cell) -> None:
    with pytest.raises(SettingsError, match="cannot be led by hand"):
        next(run_teach(devices_of(FakeRobot()), cell, TeachSettings()))
    with pytest.raises(SettingsError, match="no sphere 'X'"):
        next(run_teach(devices_of(FakeRobot()), cell, TeachSettings(guided=False, sphere_name="X")))


def test_the_sphere_is_the_one_that_the_camera_is_aimed_at(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    more = "  B: {diameter_mm: 38.1, expanded_uncertainty_mm: 0.001, centre_in_base_mm: [300, 0, 300]}\nmotion:"
    path.write_text(CELL_YAML.replace("motion:", more), encoding="utf-8")
    cell = load_cell(path)
    shifted = np.eye(4)
    shifted[0, 3] = 300
    assert [aimed_sphere(cell, pose) for pose in (np.eye(4), shifted, None)] == ["A", "B", "A"]
    events = drive(run_teach(devices_of(FakeRobot()), cell, HELD), NextSphere(), NextSphere(), NextSphere())
    assert told(events) == ["looking for sphere A", "looking for sphere B", "looking for sphere A"]


def test_frames_must_be_new(cell: Cell) -> None:
    class Stale(FakeCamera):
        def capture(self, *, timeout_s: float) -> Frame3D:
            frame = super().capture(timeout_s=timeout_s)
            self.sequence = 0
            return frame

    _, second = drive(run_teach(devices_of(FakeRobot(), Stale()), cell, HELD), None)
    assert isinstance(second, Looked)
    assert second.finding is None
    assert "not newer" in str(second.reason)
