"""From a cell file's driver settings to the one SimulatedCell that robot and camera share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.errors import SettingsError
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.truth_file import load_truth

if TYPE_CHECKING:
    from drivers.registry import DriverContext

_SHARED = "simulated_cell"

SETTINGS = {
    "truth": "the truth file, relative to the cell file; with the robot, the camera may repeat it",
    "instant": "true (default): a clock of its own, nothing sleeps; false: real time",
    "run": "a whole number: another one gives other noise with the same errors (default 0)",
    "controller": "camera only: address HOST or HOST:PORT of the `simulate-controller` whose robot carries it",
    "clock_start_s": "first reading of the cell's clock, by which it drifts (default 0)",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Made:
    cell: SimulatedCell
    settings: Mapping[str, object]


def shared_cell(context: DriverContext) -> SimulatedCell:
    """The cell of this context, made at the first call.

    Raises:
        SettingsError: an unknown or wrong setting, no truth named, settings that differ, no robot model.
        FileError: the truth file is missing or broken.
    """
    settings = _checked(context.settings)
    known = context.shared.get(_SHARED)
    if isinstance(known, _Made):
        _check_same(settings, known.settings)
        return known.cell
    made = _Made(_make(context, settings), settings)
    context.shared[_SHARED] = made
    return made.cell


def follower(context: DriverContext) -> Callable[[SimulatedCell], None] | None:
    """What brings a camera's cell to where a simulated controller's robot stands, None without the setting `controller`.

    Raises:
        SettingsError: the address cannot be read.
    """
    address = context.settings.get("controller")
    if not isinstance(address, str):
        return None
    from drivers.simulated.controllers.bench import BenchClient, bench_address

    client = BenchClient(*bench_address(address))

    def follow(cell: SimulatedCell) -> None:
        cell.take_axes(client.axes())

    return follow


def _check_same(settings: Mapping[str, object], first: Mapping[str, object]) -> None:
    for key, value in settings.items():
        if first.get(key) != value:
            raise SettingsError(
                f"robot and camera share one cell and differ: {first.get(key)!r} and {value!r}", where=key, remedy="Set it once, with the robot."
            )


def _make(context: DriverContext, settings: Mapping[str, object]) -> SimulatedCell:
    truth_name = settings.get("truth")
    if not isinstance(truth_name, str):
        raise SettingsError("the simulated cell names no truth file", where="truth", remedy="Add `truth: truth.yaml` to the driver's settings.")
    if context.robot_model is None:
        raise SettingsError("a simulated robot needs a robot model", where="model", remedy="Name a shipped model, e.g. irb1410_paper.")
    path = context.folder / truth_name
    run, start = settings.get("run", 0), settings.get("clock_start_s", 0.0)
    return SimulatedCell(
        load_truth(path),
        context.robot_model,
        folder=path.parent,
        instant=settings.get("instant", True) is True,
        run=run if isinstance(run, int) else 0,
        clock_start_s=float(start) if isinstance(start, int | float) else 0.0,
    )


def _checked(settings: Mapping[str, object]) -> Mapping[str, object]:
    kinds: dict[str, type | tuple[type, ...]] = {"truth": str, "instant": bool, "run": int, "clock_start_s": (int, float), "controller": str}
    for key, value in settings.items():
        if key not in SETTINGS:
            raise SettingsError(f"unknown setting {key!r} of the simulated driver", where=key, remedy=f"Allowed: {', '.join(SETTINGS)}.")
        wrong_number = key == "run" and (isinstance(value, bool) or (isinstance(value, int) and value < 0))
        if not isinstance(value, kinds[key]) or wrong_number:
            raise SettingsError(f"{value!r} is not allowed", where=key, remedy=f"{key}: {SETTINGS[key]}.")
    return settings
