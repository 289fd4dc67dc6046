"""What `doctor` says of an ABB robot: nobody there, another robot, another model, a tool, a stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from drivers.abb.adapter import AbbRobot
from drivers.abb.settings import parse_settings
from drivers.models import load_robot_model
from drivers.simulated.controllers.abb import AbbController
from measure.doctor import Diagnosis, examine_robot
from tests.support.abb import TARGETS_DEG, controller, robot_over_tcp


@pytest.fixture
def made() -> Iterator[AbbController]:
    with controller() as started:
        started.program.cell.start_motion(np.radians(TARGETS_DEG[1]), speed_rad_s=3.0)
        started.program.cell.advance(10.0)
        yield started


def diagnosis_of(robot: AbbRobot, model: str = "abb_irb1410") -> Diagnosis:
    found = Diagnosis({}, {})
    examine_robot(robot, load_robot_model(model), found)
    return found


def test_a_healthy_robot_has_no_problem(made: AbbController) -> None:
    found = diagnosis_of(robot_over_tcp(made))
    assert found.problems == []
    assert found.robot["ok"] is True
    assert found.robot["serial"] == "SIMULATED-0001"


def test_a_model_that_does_not_fit_is_told_with_one_that_does(made: AbbController) -> None:
    """`irb1410_paper` is the same robot with other zero positions and without the parallelogram."""
    found = diagnosis_of(AbbRobot(parse_settings({"host": made.host, "port": made.port}), load_robot_model("irb1410_paper")), "irb1410_paper")
    (problem,) = (text for text in found.problems if "flange pose" in text)
    assert "abb_irb1410" in problem


TROUBLES: dict[str, tuple[Callable[[AbbController], None], str]] = {
    "nobody": (lambda made: made.fault("refuse"), "refused"),
    "silence": (lambda made: made.fault("silence"), "did not answer"),
    "garbage": (lambda made: made.fault("garbage"), "not the program of spherecal"),
    "tool": (lambda made: made.program.use(tool="gripper"), "gripper"),
    "stop": (lambda made: made.fault("emergency_stop"), "emergency stop"),
}


@pytest.mark.parametrize("name", TROUBLES)
def test_every_trouble_is_named_with_a_remedy(name: str, made: AbbController) -> None:
    cause, words = TROUBLES[name]
    cause(made)
    found = diagnosis_of(robot_over_tcp(made))
    assert found.robot["ok"] is False
    text = " ".join(found.problems)
    assert words in text.lower()
    assert len(text) > len(words) + 40


def test_another_robot_than_the_model_says_is_told(made: AbbController) -> None:
    made.program.use(kind="IRB 2600-20/1.65")
    robot = robot_over_tcp(made)
    info = robot.open()
    robot.close()
    assert any("IRB 2600" in note for note in info.notes)
