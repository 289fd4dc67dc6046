"""The self-test of a cell: its files, then, on demand, the robot and the camera. Nothing is moved.

`problems` must be solved before the cell can work; `hints` are what a good cell has and this one lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from acquire.cell import Cell, devices_of, robot_model_of
from drivers.errors import SpherecalError
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.models import load_robot_model, shipped_models
from drivers.protocols import Camera3D, Mode, Robot, RobotState
from drivers.registry import hardware_remark, untried_drivers
from measure.doctor_camera import camera_hints, frame_facts, health_facts, identity_problems, info_facts

Facts: TypeAlias = dict[str, object]

FACTORY_CALIBRATED_MM = 20.0
FACTORY_CALIBRATED_RAD = 0.0175
FRAME_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the self-test found; `ok` of a device is None where it was not asked."""

    robot: Facts
    camera: Facts
    problems: list[str] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)

    def to_json_dict(self) -> Mapping[str, object]:
        """What `spherecal doctor --json` prints."""
        return {"robot": self.robot, "camera": self.camera, "problems": self.problems, "hints": self.hints}


def examine(cell: Cell, *, offline: bool) -> Diagnosis:
    """Examine a cell: its files always, robot and camera unless `offline`.

    Raises:
        FileError: the robot model of the cell is missing or broken.
    """
    model = robot_model_of(cell)
    diagnosis = Diagnosis(
        robot={"ok": None, "driver": cell.robot.driver, "model": cell.robot.model, "joints_rad": None, "base_from_flange": None},
        camera={"ok": None, "driver": cell.camera.driver, "kind": cell.camera.kind},
    )
    diagnosis.problems.extend(cell_problems(cell, model))
    diagnosis.hints.extend(cell_hints(cell, model))
    try:
        devices = devices_of(cell)
    except SpherecalError as error:
        diagnosis.problems.append(str(error))
        return diagnosis
    if not offline:
        examine_robot(devices.robot, model, diagnosis)
        examine_camera(devices.camera, cell, diagnosis)
    return diagnosis


def cell_problems(cell: Cell, model: RobotModel | None) -> list[str]:
    """What makes a plan or a calibration impossible."""
    problems = []
    if not cell.spheres and model is None:
        problems.append(f"{cell.path}, spheres: there is none. Add the certified diameter of at least one sphere.")
    if cell.spheres and model is not None and cell.flange_from_camera is None:
        problems.append(f"{cell.path}, flange_from_camera: no first guess, so no poses can be planned. A drawing's figures will do.")
    return problems


def cell_hints(cell: Cell, model: RobotModel | None) -> list[str]:
    """What a good cell has and this one lacks."""
    hints = []
    if not cell.spheres and model is not None:
        hints.append("spheres: there is none, so the robot alone can be calibrated, on external reference points (a laser tracker)")
    if cell.limits is None:
        hints.append("limits: none given, so no verdict can be better than marginal")
    if cell.spheres and not cell.lengths:
        hints.append("lengths: no certified length, so the scale hangs on the sphere's radius alone; one ball bar cuts the error by more than half")
    if model is None:
        hints.append("robot.model: none, so flange poses are taken as the robot reports them and its own errors stay")
    without = [name for name, sphere in cell.spheres.items() if sphere.centre_in_base_mm is None]
    if without and model is not None:
        hints.append(f"spheres {', '.join(without)}: no centre_in_base_mm, so no poses are planned around them")
    return [*hints, *map(hardware_remark, untried_drivers(cell.robot.driver, cell.camera.driver))]


def examine_robot(robot: Robot, model: RobotModel | None, diagnosis: Diagnosis) -> None:
    """Read the robot once and compare what it says with the model."""
    try:
        try:
            info = robot.open()
            state = robot.read_state()
        finally:
            robot.close()
    except SpherecalError as error:
        diagnosis.robot["ok"] = False
        diagnosis.problems.append(f"robot: {error}")
        return
    problems = robot_problems(state, model)
    diagnosis.robot.update(
        ok=not problems,
        joints_rad=state.joints_rad,
        base_from_flange=state.base_from_flange,
        serial=info.serial,
        controller=info.controller,
        mode=state.mode,
        safety=state.safety.value,
        moving=state.moving,
        motors_on=state.motors_on,
        active_tool=state.active_tool,
        active_work_object=state.active_work_object,
        age_s=state.age_s,
        notes=list(info.notes),
    )
    diagnosis.problems.extend(f"robot: {problem}" for problem in problems)
    diagnosis.hints.extend(f"robot: {hint}" for hint in (*info.notes, *robot_hints(state)))


def robot_hints(state: RobotState) -> list[str]:
    """What would keep a healthy robot from moving, or is worth knowing of it."""
    hints = []
    if state.motors_on is False:
        hints.append("the motors are off, so motions will be refused. Switch them on at the pendant")
    if state.mode == Mode.LOCAL:
        hints.append("it is in local mode, so motions will be refused; hand guiding works")
    if state.mode == Mode.MANUAL:
        hints.append("it is in manual mode: motions are slow, and need somebody who holds the enabling switch")
    if state.active_tool not in (None, "tool0"):
        hints.append(f"the active tool is {state.active_tool}; axis angles do not depend on it")
    return hints


def robot_problems(state: RobotState, model: RobotModel | None) -> list[str]:
    """What is wrong with one reading of a robot."""
    problems = []
    if state.safety.stops_motion:
        said = "" if state.reason is None else f" ({state.reason})"
        problems.append(f"{state.safety.value.replace('_', ' ')} is active{said}. Clear it at the robot.")
    if model is None:
        return problems if state.base_from_flange is not None else [*problems, "gives no flange pose, and the cell names no robot model"]
    if state.joints_rad is None:
        return [*problems, "gives no axis angles. Set model: null to work with its flange poses."]
    if state.joints_rad.shape != (model.n_joints,):
        return [*problems, f"gives {state.joints_rad.size} axes, the model {model.name} has {model.n_joints}. Choose the right model."]
    if not bool(mdh.within_limits(model, state.joints_rad)):
        problems.append(f"stands outside the axis limits of {model.name}. Wrong model, or degrees for radians?")
    if state.base_from_flange is not None:
        problems.extend(_pose_problems(state.base_from_flange, state.joints_rad, model))
    return problems


def _pose_problems(reported: se3.FloatArray, joints_rad: se3.FloatArray, model: RobotModel) -> list[str]:
    off_mm, off_rad = _apart(reported, mdh.base_from_flange(model, joints_rad))
    if _fits(reported, joints_rad, model):
        return []
    causes = _likely_cause(reported, joints_rad, model)
    return [f"its flange pose is {off_mm:.1f} mm and {np.degrees(off_rad):.2f} degrees from the model's: {causes}"]


def _likely_cause(reported: se3.FloatArray, joints_rad: se3.FloatArray, model: RobotModel) -> str:
    in_mm = reported.copy()
    in_mm[:3, 3] *= 1000
    if _fits(in_mm, joints_rad, model):
        return "it is in metres. The adapter must convert it to mm"
    for name in shipped_models():
        other = load_robot_model(name)
        if other.n_joints == joints_rad.size and _fits(reported, joints_rad, other):
            return f"another model. It fits {name}: set `model: {name}` in the cell file"
    return "wrong model, axis order or coupling, or a tool or work object that is active. Compare model, tool and work object with the pendant"


def _fits(reported: se3.FloatArray, joints_rad: se3.FloatArray, model: RobotModel) -> bool:
    off_mm, off_rad = _apart(reported, mdh.base_from_flange(model, joints_rad))
    return off_mm <= FACTORY_CALIBRATED_MM and off_rad <= FACTORY_CALIBRATED_RAD


def _apart(first: se3.FloatArray, second: se3.FloatArray) -> tuple[float, float]:
    """Distance in mm and angle in rad of two flange poses (4, 4)."""
    turn = se3.log_so3(first[:3, :3].T @ second[:3, :3])
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])), float(np.linalg.norm(turn))


def examine_camera(camera: Camera3D, cell: Cell, diagnosis: Diagnosis) -> None:
    """Take one frame and look at its figures."""
    try:
        try:
            info = camera.open()
            try:
                frame = camera.capture(timeout_s=FRAME_TIMEOUT_S)
            finally:
                diagnosis.camera.update(health_facts(camera))
        finally:
            camera.close()
    except SpherecalError as error:
        diagnosis.camera["ok"] = False
        diagnosis.problems.append(f"camera: {error}")
        return
    facts, problems = frame_facts(frame, cell.camera.working_range_mm)
    problems = [*identity_problems(info, cell.identity, cell.camera.kind), *problems]
    diagnosis.camera.update(info_facts(info) | facts, ok=not problems)
    diagnosis.problems.extend(f"camera: {problem}" for problem in problems)
    diagnosis.hints.extend(f"camera: {hint}" for hint in camera_hints(info, frame))
