"""The simulated cell: a robot and a 3D camera that share one hidden truth, for tests, demos and rehearsals.

It is physics, not a replay of the calibrator's own models: the true robot has MDH errors, axis tilts, gravity droop,
backlash, gear harmonics, drift and repeatability; the true camera has a stereo, pillow or smooth field error, range
noise, flying pixels and incidence drop-out; spheres are intersected exactly. What the controller reports is only the
nominal model. Each module says what it does not model.

Only the registry (by name), the CLI's demo and tests may reach this package; acquire and calibrate never do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.protocols import Camera3D, Robot
    from drivers.registry import DriverContext


def make_robot(context: DriverContext) -> Robot:
    """The simulated robot of a cell file; settings as in `drivers.simulated.setup.SETTINGS`.

    Raises:
        SettingsError: no robot model, no truth named, an unknown setting.
        FileError: the truth file is missing or broken.
    """
    from drivers.simulated.robot import SimulatedRobot
    from drivers.simulated.setup import shared_cell

    return SimulatedRobot(shared_cell(context))


def make_camera(context: DriverContext) -> Camera3D:
    """The simulated camera of a cell file, on the same truth as its robot; raises as `make_robot`.

    With the setting `controller` it looks from where a robot of `spherecal simulate-controller` stands.
    """
    from drivers.simulated.camera import SimulatedCamera
    from drivers.simulated.setup import follower, shared_cell

    return SimulatedCamera(shared_cell(context), follower(context))
