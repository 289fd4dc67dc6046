"""A camera in another process sees from where the controller's robot truly stands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import CameraNotReached, SettingsError
from drivers.models import load_robot_model
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.controllers.bench import BenchClient, BenchServer, axes_from_text, axes_text, bench_address
from drivers.simulated.draws import random_truth
from drivers.simulated.truth import Truth
from tests.support.simulated import JOINTS_RAD, paper_model, truth_with_sphere

HOST = "127.0.0.1"


def errors_of_every_kind() -> Truth:
    drawn = random_truth(paper_model(), np.random.default_rng(5)).robot
    return truth_with_sphere(robot=replace(drawn, axis_repeatability_rad=(1e-4,) * 6))


@pytest.fixture
def served() -> Iterator[tuple[SimulatedCell, BenchClient]]:
    cell = SimulatedCell(errors_of_every_kind(), paper_model())
    server = BenchServer(HOST, 0, lambda line: axes_text(cell.axes()) if line == "axes" else _refuse(line))
    server.start()
    yield cell, BenchClient(HOST, server.port)
    server.close()


def _refuse(line: str) -> str:
    msg = f"unknown {line}"
    raise ValueError(msg)


@pytest.mark.parametrize("seconds", [0.0, 0.4, 60.0])
def test_a_follower_sees_what_the_cell_itself_would_show(served: tuple[SimulatedCell, BenchClient], seconds: float) -> None:
    """Before, during and after a motion: same true pose, same clock, same noise of the same frame."""
    cell, client = served
    other = SimulatedCell(errors_of_every_kind(), paper_model())
    cell.start_motion(JOINTS_RAD - 0.2, speed_rad_s=1.0)
    cell.advance(30.0)
    cell.start_motion(JOINTS_RAD, speed_rad_s=1.0)
    cell.advance(seconds)
    other.take_axes(client.axes())
    np.testing.assert_array_equal(other.true_base_from_flange(), cell.true_base_from_flange())
    camera = SimulatedCamera(other, lambda follower: follower.take_axes(client.axes()))
    camera.open()
    theirs = camera.capture(timeout_s=5)
    own = SimulatedCamera(cell)
    own.open()
    np.testing.assert_array_equal(theirs.xyz_mm, own.capture(timeout_s=5).xyz_mm)
    assert np.isfinite(theirs.xyz_mm).any() or seconds < 1


def test_a_stop_keeps_the_noise_of_the_motion_it_ended(served: tuple[SimulatedCell, BenchClient]) -> None:
    cell, client = served
    cell.start_motion(JOINTS_RAD, speed_rad_s=1.0)
    cell.advance(0.3)
    cell.stop_motion()
    other = SimulatedCell(errors_of_every_kind(), paper_model())
    other.take_axes(client.axes())
    np.testing.assert_array_equal(other.true_base_from_flange(), cell.true_base_from_flange())


def test_a_controller_that_is_gone_or_refuses_is_told(served: tuple[SimulatedCell, BenchClient]) -> None:
    _, client = served
    with pytest.raises(SettingsError, match="unknown dance"):
        client.ask("dance")
    with pytest.raises(CameraNotReached, match="simulate-controller"):
        BenchClient("127.0.0.250", 29987).axes()


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6))
def test_axes_keep_every_bit(values: list[float]) -> None:
    cell = SimulatedCell(Truth(), load_robot_model("ur5e"))
    axes = replace(cell.axes(), target_rad=tuple(values), clock_s=values[0])
    assert axes_from_text(axes_text(axes)) == axes


@given(st.text())
def test_other_text_is_no_axes(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        axes_from_text(text)


@pytest.mark.parametrize("text", ["", ":1", "host:", "host:x"])
def test_addresses(text: str) -> None:
    assert bench_address("127.0.0.2:5") == ("127.0.0.2", 5)
    if text != "host:":
        with pytest.raises(SettingsError):
            bench_address(text)
