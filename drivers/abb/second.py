"""The second program, `spherecal_state.mod`: it tells motors and stops while the first one is held and says nothing."""

from __future__ import annotations

from drivers.abb.line import LineClient
from drivers.abb.protocol import Verb, parse_state
from drivers.abb.replies import robot_state
from drivers.errors import RobotError
from drivers.protocols import RobotState
from drivers.transport import Link


class SecondProgram:
    """Asked when the first program is silent; a cell without it has `link` None, and nothing is known then."""

    def __init__(self, link: Link | None) -> None:
        self._client = None if link is None else LineClient(link)

    @property
    def is_there(self) -> bool:
        """Whether the cell file names it."""
        return self._client is not None

    def state(self, timeout_s: float) -> RobotState | None:
        """What it tells, or None: it is not there, or does not answer within `timeout_s`."""
        if self._client is None:
            return None
        try:
            if not self._client.is_open:
                self._client.open(timeout_s / 2)
            reply = self._client.ask(Verb.STATE, timeout_s=timeout_s / 2)
            return robot_state(parse_state(reply.line), reply, None, None)
        except RobotError:
            self.close()
            return None

    def hold(self, timeout_s: float) -> RobotState | None:
        """What it tells, if a stop or motors off hold the robot; else None."""
        state = self.state(timeout_s)
        return state if state is not None and (state.safety.stops_motion or state.motors_on is False) else None

    def close(self) -> None:
        """Let go of the link."""
        if self._client is not None:
            self._client.close()
