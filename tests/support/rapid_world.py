"""What surrounds `spherecal.mod` when it is executed in a test: clock, robot, line, interrupts, and a person at the pendant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.abb.program import module_text
from drivers.kinematics import mdh
from drivers.simulated.controllers.abb_program import Identity, quaternion_wxyz
from tests.support.abb import abb_model
from tests.support.rapid import LONGEST_STRING, ExitCycle, Machine, RapidError, RapidSyntaxError, read

CONSTANTS: dict[str, Any] = {
    "OP_AUTO": np.float32(1),
    "OP_MAN_PROG": np.float32(2),
    "OP_MAN_TEST": np.float32(3),
    "fine": "fine",
    "v1000": "v1000",
    "tool0": "tool0",
    "wobj0": "wobj0",
}


class Finished(Exception):
    """The script of the test is at its end."""


@dataclass
class World:
    """Runs SphServe until the script is at its end.

    The script is a list of (time, bytes or a function): bytes come over the line, a function is what a person does.
    """

    script: list[tuple[float, bytes | Callable[[World], None]]]
    ends_s: float = 30.0
    identity: Identity = field(default_factory=Identity)
    joints_deg: list[float] = field(default_factory=lambda: [0.0] * 6)
    restart_event: bool = True
    """Whether SphOnRestart is installed as an event routine."""
    now_s: float = 0.0
    sent: list[bytes] = field(default_factory=list)
    journal: list[str] = field(default_factory=list)
    moves_begun: int = 0
    travelled_deg: float = 0.0
    """Way of the first axis in all motions."""
    held_s: float = 0.0
    stop_move: bool = False
    interrupts: dict[str, float] = field(default_factory=dict)
    machine: Machine = field(init=False)

    def __post_init__(self) -> None:
        names = [name[2:] for name in dir(self) if name.startswith("i_")]
        instructions = {name: getattr(self, f"i_{name}") for name in names}
        self.machine = Machine([read(module_text("spherecal.mod"))], instructions, CONSTANTS)
        self.pp_main = False

    def run(self) -> list[bytes]:
        """Everything that was sent."""
        try:
            while True:
                try:
                    self.machine.call("SphServe")
                except ExitCycle:
                    self.machine.connected.clear()
                    self.interrupts.clear()
                    self.journal.append("ExitCycle")
                except PpToMain:
                    self.machine.pp_to_main()
                    self.interrupts.clear()
                    self.stop_move = False
                    self.journal.append("PP to main")
        except Finished:
            return self.sent

    def line_from_pc(self) -> bytes | None:
        """What has come by now."""
        while self.script and self.script[0][0] <= self.now_s:
            what = self.script.pop(0)[1]
            if isinstance(what, bytes):
                return what
            what(self)
        return None

    # ---- the line ----------------------------------------------------------------------------

    def i_SphOpen(self, machine: Machine, required: Any, options: Any) -> None:
        machine.data["sphLinkUp"] = True

    def i_SphClose(self, machine: Machine, required: Any, options: Any) -> None:
        machine.data["sphLinkUp"] = False

    def i_SphNewcomer(self, machine: Machine, required: Any, options: Any) -> None:
        self.now_s += 0.1

    def i_SphReceive(self, machine: Machine, required: Any, options: Any) -> bool:
        end_s = self.now_s + float(machine.value(required[0]))
        while True:
            data = self.line_from_pc()
            if data is not None:
                if data == b"":
                    machine.data["sphLinkUp"] = False
                    return False
                # a socket gives at most what a string holds
                machine.data["sphChunk"] = data[:LONGEST_STRING].decode("latin-1")
                if data[LONGEST_STRING:]:
                    self.script.insert(0, (self.now_s, data[LONGEST_STRING:]))
                self.now_s += 0.002
                return True
            following = self.script[0][0] if self.script else self.ends_s + 1
            if following > end_s:
                self.now_s = end_s
                if self.now_s > self.ends_s:
                    raise Finished
                return False
            self.now_s = max(following, self.now_s)

    def i_SphSend(self, machine: Machine, required: Any, options: Any) -> None:
        text = machine.value(required[0]) + "\n"
        if len(text) > LONGEST_STRING:
            raise RapidSyntaxError(f"{text!r} is too long to be sent")
        self.sent.append(text.encode("latin-1"))

    # ---- time and interrupts -----------------------------------------------------------------

    def i_ClkRead(self, machine: Machine, required: Any, options: Any) -> Any:
        return np.float32(np.floor((self.now_s - self.clock_from_s) * 100) / 100)

    clock_from_s = 0.0

    def i_ClkReset(self, machine: Machine, required: Any, options: Any) -> None:
        self.clock_from_s = self.now_s

    def i_ClkStart(self, machine: Machine, required: Any, options: Any) -> None: ...

    def i_ITimer(self, machine: Machine, required: Any, options: Any) -> None:
        name = required[1][1]
        if name not in machine.connected:
            raise RapidSyntaxError(f"{name} is not connected")
        self.interrupts[name] = float(machine.value(required[0]))

    def i_IDelete(self, machine: Machine, required: Any, options: Any) -> None:
        name = required[0][1]
        if name not in machine.connected:
            raise RapidError("ERR_INTNOTCONNECTED")  # harsher than a controller perhaps is
        del machine.connected[name]
        self.interrupts.pop(name, None)

    # ---- motion ------------------------------------------------------------------------------

    def i_MoveAbsJ(self, machine: Machine, required: Any, options: Any) -> None:
        if self.stop_move:
            raise RapidSyntaxError("a motion while StopMove is active")
        target = machine.value(required[0])["robax"]
        target_deg = [float(target[f"rax_{i}"]) for i in range(1, 7)]
        self.moves_begun += 1
        start, took_s, total_s = list(self.joints_deg), 0.0, float(machine.value(options["T"]))
        self.journal.append(f"MoveAbsJ {target_deg[0]:.3f}")
        while took_s < total_s:
            step_s = min(min(self.interrupts.values(), default=total_s), total_s - took_s)
            share = (took_s + step_s) / total_s
            self.now_s += step_s
            self._person_may_hold_the_program()
            if not self.stop_move:
                took_s += step_s
                before = self.joints_deg[0]
                self.joints_deg = [a + share * (b - a) for a, b in zip(start, target_deg, strict=True)]
                self.travelled_deg += abs(self.joints_deg[0] - before)
            for name in tuple(self.interrupts):
                machine.call(machine.connected[name])
        self.journal.append("arrived")

    def _person_may_hold_the_program(self) -> None:
        while self.script and not isinstance(self.script[0][1], bytes) and self.script[0][0] <= self.now_s:
            what = self.script.pop(0)[1]
            assert callable(what)
            what(self)
        if self.held_s:
            self.now_s, self.held_s = self.now_s + self.held_s, 0.0
            if self.restart_event:
                self.machine.call("SphOnRestart")
        if self.pp_main:
            self.pp_main = False
            raise PpToMain

    def i_StopMove(self, machine: Machine, required: Any, options: Any) -> None:
        self.stop_move = True
        self.journal.append("StopMove")

    def i_ClearPath(self, machine: Machine, required: Any, options: Any) -> None:
        if not self.stop_move:
            raise RapidSyntaxError("ClearPath while the robot moves")
        self.journal.append("ClearPath")

    def i_StartMove(self, machine: Machine, required: Any, options: Any) -> None:
        self.stop_move = False
        self.journal.append("StartMove")

    def i_ExitCycle(self, machine: Machine, required: Any, options: Any) -> None:
        raise ExitCycle

    def i_IsStopMoveAct(self, machine: Machine, required: Any, options: Any) -> bool:
        return self.stop_move and "FromMoveTask" in options

    def i_ConfJ(self, machine: Machine, required: Any, options: Any) -> None: ...

    def i_ConfL(self, machine: Machine, required: Any, options: Any) -> None: ...

    # ---- readings ----------------------------------------------------------------------------

    def i_CJointT(self, machine: Machine, required: Any, options: Any) -> Any:
        robax = {f"rax_{i + 1}": np.float32(angle) for i, angle in enumerate(self.joints_deg)}
        return {"robax": robax, "extax": {f"eax_{c}": np.float32(9e9) for c in "abcdef"}}

    def i_CRobT(self, machine: Machine, required: Any, options: Any) -> Any:
        if {name: machine.value(value) for name, value in options.items()} != {"Tool": "tool0", "WObj": "wobj0"}:
            raise RapidSyntaxError("not the flange in the world frame")
        flange = mdh.base_from_flange(abb_model(), np.radians(self.joints_deg))
        q = quaternion_wxyz(flange[:3, :3])
        rot = {f"q{i + 1}": np.float32(value) for i, value in enumerate(q)}
        return {"trans": dict(zip("xyz", flange[:3, 3].astype(np.float32), strict=True)), "rot": rot}

    def i_OpMode(self, machine: Machine, required: Any, options: Any) -> Any:
        return CONSTANTS["OP_AUTO"]

    def i_GetSysInfo(self, machine: Machine, required: Any, options: Any) -> str:
        (option,) = options
        return {"SerialNo": self.identity.serial, "SWVersion": self.identity.version, "RobotType": self.identity.kind}[option]

    def i_GetSysData(self, machine: Machine, required: Any, options: Any) -> None:
        name = self.identity.tool if required[0][1] == "sphActTool" else self.identity.work_object
        machine.assign(options["ObjectName"], name)

    # ---- strings and numbers -----------------------------------------------------------------

    def i_StrLen(self, machine: Machine, required: Any, options: Any) -> Any:
        return np.float32(len(machine.value(required[0])))

    def i_StrPart(self, machine: Machine, required: Any, options: Any) -> str:
        text, start, count = (machine.value(part) for part in required)
        if not (1 <= start <= len(text) and count >= 1 and start + count - 1 <= len(text)):
            raise RapidSyntaxError(f"StrPart({text!r}, {start}, {count}) is outside the string")
        return str(text[int(start) - 1 : int(start + count) - 1])

    def i_StrFind(self, machine: Machine, required: Any, options: Any) -> Any:
        text, start, wanted = (machine.value(part) for part in required)
        if not 1 <= start <= len(text):
            raise RapidSyntaxError(f"StrFind from {start} in {text!r}")
        return np.float32(next((i + 1 for i in range(int(start) - 1, len(text)) if text[i] in wanted), len(text) + 1))

    def i_StrMap(self, machine: Machine, required: Any, options: Any) -> str:
        text, of, to = (machine.value(part) for part in required)
        return str(text.translate(str.maketrans(of, to)))

    def i_StrToVal(self, machine: Machine, required: Any, options: Any) -> bool:
        try:
            machine.assign(required[1], np.float32(float(machine.value(required[0]))))
        except ValueError:
            return False
        return True

    def i_StrToByte(self, machine: Machine, required: Any, options: Any) -> Any:
        if set(options) != {"Char"}:
            raise RapidSyntaxError("StrToByte without Char")
        return np.float32(ord(machine.value(required[0])))

    def i_ByteToStr(self, machine: Machine, required: Any, options: Any) -> str:
        value = float(machine.value(required[0]))
        if set(options) != {"Hex"} or not (0 <= value <= 255 and value == int(value)):
            raise RapidSyntaxError(f"ByteToStr of {value}")
        return f"{int(value):02X}"

    def i_NumToStr(self, machine: Machine, required: Any, options: Any) -> str:
        value, decimals = (float(machine.value(part)) for part in required)
        text = f"{value:.{int(decimals)}f}"
        return text.removeprefix("-") if float(text) == 0 else text

    def i_Abs(self, machine: Machine, required: Any, options: Any) -> Any:
        return np.float32(abs(machine.value(required[0])))


class PpToMain(Exception):
    """The program pointer was moved to main."""
