"""Teaching poses at a terminal: keys become commands, what robot and camera say becomes a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

from acquire.plan import PlannedPose
from acquire.sphere import ArcFinding
from acquire.teach import Lesson
from acquire.teach_events import Finish, Guide, Jog, Looked, NextSphere, Record, Recorded, Taught, TeachCommand, TeachEvent, Told, Undo, Via

if TYPE_CHECKING:
    from rich.console import RenderableType

KEYS = "Enter keeps the pose, f keeps it unseen, v a point of the way, u undoes, q ends\nn next sphere, g soft or held"
JOG_KEYS = "1-9 axis, + and - move it, < and > halve and double the step"
SAFETY = "NO safety function: emergency stop in reach, nobody between arm and fixture"
HAND_GUIDING = (
    "The arm of {name!r} will give way to the hand. A wrong payload makes it rise or sink by itself: hold it when it goes soft, "
    "stay out of where it could trap you, keep the emergency stop in reach."
)
JOGGING = "The arm of {name!r} will move one axis at a key press, at up to {speed:g} rad/s. Look at the arm, not at the screen."
_ROWS = 8
_WIDTH = 80
_LARGEST_STEP_RAD, _SMALLEST_STEP_RAD = np.radians(20.0), np.radians(0.05)
_PLAIN: Mapping[str, TeachCommand] = {
    "\n": Record(),
    "\r": Record(),
    "f": Record(anyway=True),
    "v": Via(),
    "u": Undo(),
    "n": NextSphere(),
    "q": Finish(),
}


class Keys(Protocol):
    """Where keys come from."""

    def pressed(self, wait_s: float = 0.0) -> str | None:
        """The next key, waiting for it so long; None where there is none."""
        ...


class Hand:
    """What keys mean; remembers the axis and the step of jogging."""

    def __init__(self, *, jog: bool) -> None:
        self.jog = jog
        self.axis = 0
        self.step_rad = float(np.radians(2.0))

    def command(self, key: str, looked: Looked) -> TeachCommand | None:
        """The command of a key; None for keys that only choose something, or mean nothing."""
        if key == "g":
            return Guide(on=not looked.guided)
        if key in _PLAIN:
            return _PLAIN[key]
        if not self.jog:
            return None
        if key.isdigit() and key != "0":
            self.axis = int(key) - 1
        elif key in "<>":
            self.step_rad = float(np.clip(self.step_rad * (0.5 if key == "<" else 2.0), _SMALLEST_STEP_RAD, _LARGEST_STEP_RAD))
        elif key in "+-":
            return Jog(self.axis, self.step_rad if key == "+" else -self.step_rad)
        return None


def teach(lesson: Lesson, keys: Keys, screen: TeachScreen, hand: Hand, save: Callable[[tuple[PlannedPose, ...]], None], *, every_s: float) -> None:
    """Lead a lesson to its end; `save` is told of the poses whenever they change.

    Raises:
        SpherecalError: as `acquire.teach.run_teach` and `save`.
    """
    command: TeachCommand | None = None
    known: tuple[PlannedPose, ...] = ()
    while True:
        event = lesson.send(command)
        command = None
        screen.show(event)
        if isinstance(event, Taught):
            return
        if isinstance(event, Looked):
            if event.poses != known:
                known = event.poses
                save(known)
            command = _asked(keys, hand, screen, event, every_s)


def _asked(keys: Keys, hand: Hand, screen: TeachScreen, looked: Looked, every_s: float) -> TeachCommand | None:
    """The command of the next key, while the picture on the screen is fresh."""
    while (key := keys.pressed(every_s)) is not None:
        command = hand.command(key, looked)
        if command is not None:
            screen.doing(command)
            return command
        screen.show(looked)
    return None


class TeachScreen:
    """What a person sees: a picture that is drawn again and again on a terminal, lines of what changes elsewhere."""

    def __init__(self, note: Callable[[str], None], draw: Callable[[RenderableType], None] | None, hand: Hand) -> None:
        self._note, self._draw, self._hand = note, draw, hand
        self._looked: Looked | None = None
        self._told = self._last_line = ""
        self._remarks: dict[str, str] = {}

    def show(self, event: TeachEvent) -> None:
        """Take one event."""
        match event:
            case Looked():
                self._looked = event
                self._line(seen_text(event))
            case Recorded(pose=pose, touches=touches):
                self._remarks[pose.id] = _remark(event)
                self._told = f"pose {pose.id} kept"
                if touches:
                    self._told += "; the straight way from the pose before touches something: u, then v on a way round"
                self._line(self._told)
            case Told(text=text):
                self._told = text
                self._line(text)
            case Taught():
                return
        self._redraw()

    def doing(self, command: TeachCommand) -> None:
        """Say that a key was taken, before the arm has come to rest and a picture is taken."""
        self._told = {Record: "keeping still ...", Via: "keeping still ...", Jog: "moving ..."}.get(type(command), self._told)
        self._redraw()

    def _line(self, text: str) -> None:
        if self._draw is None and text != self._last_line:
            self._last_line = text
            self._note(text)

    def _redraw(self) -> None:
        if self._draw is not None and self._looked is not None:
            self._draw(self._picture(self._looked))

    def _picture(self, looked: Looked) -> RenderableType:
        from rich.console import Group
        from rich.text import Text

        jog = [f"jog: axis {self._hand.axis + 1}, step {np.degrees(self._hand.step_rad):.2g} degrees", JOG_KEYS] if self._hand.jog else []
        lines = [seen_text(looked), *_arm_lines(looked), self._told, SAFETY, *KEYS.split("\n"), *jog]
        return Group(self._table(looked.poses), *(Text(line) for line in lines if line))

    def _table(self, poses: tuple[PlannedPose, ...]) -> RenderableType:
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        counts = ", ".join(f"{n} of {sphere or 'none'}" for sphere, n in sorted(Counter(pose.sphere for pose in poses).items(), key=str))
        table = Table(box=SIMPLE_HEAD, pad_edge=False, title=f"{len(poses)} poses: {counts}" if poses else "no pose yet", title_justify="left")
        for column in ("pose", "sphere", "axes, degrees", "remark"):
            table.add_column(column, no_wrap=True, overflow="ellipsis")
        for pose in poses[-_ROWS:]:
            table.add_row(pose.id, pose.sphere or "-", degrees_text(pose.joints_rad), self._remarks.get(pose.id, ""))
        return table


def seen_text(looked: Looked) -> str:
    """Whether the sphere is seen, and how well."""
    name, finding = looked.sphere or "-", looked.finding
    if finding is None:
        return f"sphere {name} NOT seen: {looked.reason}"
    figures = f"{finding.n_points} points, rms {finding.rms_mm:.3f} mm"
    if isinstance(finding, ArcFinding):
        return f"arc of sphere {name} seen: {figures}, turns {np.degrees(finding.arc_angle_rad):.0f} degrees"
    x, y, z = finding.centre_in_camera_mm
    return f"sphere {name} seen: {figures}, {z:.0f} mm away, {np.degrees(np.arctan2(np.hypot(x, y), z)):.0f} degrees off the middle"


def _arm_lines(looked: Looked) -> list[str]:
    axes = "axes unknown" if looked.joints_rad is None else f"axes {degrees_text(looked.joints_rad)}"
    lines = [f"{axes}  {'SOFT: led by hand' if looked.guided else 'held'}"]
    if looked.alike is not None:
        lines.append(f"nearly the same as {looked.alike}: another direction of view tells more")
    if looked.n_via:
        lines.append(f"points on the way to the next pose: {looked.n_via}")
    return lines


def degrees_text(joints_rad: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    """Axis angles in short."""
    return " ".join(f"{angle:.1f}" for angle in np.degrees(joints_rad))


def _remark(event: Recorded) -> str:
    parts = ["not seen" if event.finding is None else f"{event.finding.n_points} points"]
    parts += [f"via {len(event.pose.via_rad)}"] if event.pose.via_rad else []
    parts += ["way touches!"] if event.touches else []
    return ", ".join(parts)
