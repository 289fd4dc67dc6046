"""The contract of every robot adapter, against the simulated IRC5 over TCP."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.contract.robot import RobotContract, RobotRig
from tests.support.abb import controller, rig


class TestAbbOverTcp(RobotContract):
    @pytest.fixture
    def rig(self) -> Iterator[RobotRig]:
        with controller() as made:
            yield rig(made)
