"""The RAPID text without a controller: read by a parser, compared with the Python side, and executed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers.abb import program, protocol
from drivers.abb.program import ProgramSettings, filled_in, module_names, module_text, page, write_program
from drivers.abb.protocol import ARGUMENTS, MASTER_VERBS, Fault, LineBuffer, Outcome, Verb, checksum, decode, encode, parse_state
from drivers.errors import SettingsError
from drivers.simulated.controllers.abb_program import RAMP_S, AbbProgram
from tests.support.abb import abb_cell
from tests.support.rapid import KEYWORDS, LONGEST_NAME, ExitCycle, Module, RapidSyntaxError, read
from tests.support.rapid_world import World

MODULES = ("spherecal.mod", "spherecal_main.mod", "spherecal_tcp.mod", "spherecal_serial.mod", "spherecal_state.mod", "spherecal_job.mod")
LONGEST_SOURCE_LINE = 120

# Instructions and functions of RobotWare 5 and 6 that the modules use, with their optional arguments: from the reference
# manual as far as public programs (robotics/open_abb, ros-industrial/abb_driver) confirm them.
_OPTIONS = {
    **dict.fromkeys(("ByteToStr", "StrToByte"), "Hex Okt Bin Char"),
    "CJointT": "TaskRef TaskName",
    "CRobT": "TaskRef TaskName Tool WObj",
    **dict.fromkeys(("ConfJ", "ConfL"), "On Off"),
    "ErrWrite": "W I RL2 RL3 RL4",
    "GetSysData": "ObjectName",
    "GetSysInfo": "SerialNo SWVersion RobotType CtrlId LanIp",
    "ITimer": "Single SingleSafe",
    "IsStopMoveAct": "FromMoveTask FromNonMoveTask",
    "MoveAbsJ": "Conc ID NoEOffs V T Z Inpos WObj TLoad",
    "Open": "File Read Write Append Bin",
    "ReadStrBin": "Time",
    "SocketAccept": "ClientAddress Time",
    "SocketConnect": "Time",
    "SocketReceive": "Str RawData Data ReadNoOfBytes NoRecBytes Time",
    "SocketSend": "Str RawData Data NoOfBytes",
    "StopMove": "Quick AllMotionTasks",
    "StrFind": "NotInSet",
    "WaitRob": "InPos ZeroSpeed",
}
_PLAIN = (
    "Abs ClearIOBuff ClearPath ClkRead ClkReset ClkStart Close DOutput ExitCycle IDelete NumToStr OpMode SocketBind SocketClose SocketCreate "
    "SocketGetStatus SocketListen StartMove StrLen StrMap StrPart StrToVal WaitTime WriteStrBin"
)
INSTRUCTIONS = {name: set(options.split()) for name, options in {**_OPTIONS, **dict.fromkeys(_PLAIN.split(), "")}.items()}
PREDEFINED = {
    *("OP_AUTO", "OP_MAN_PROG", "OP_MAN_TEST", "fine", "v1000", "tool0", "wobj0"),
    *("ERRNO", "ERR_SOCK_TIMEOUT", "ERR_DEV_MAXTIME", "SOCKET_CLOSED"),
}
SIGNALS = {"sphMotorsOn", "sphEmStop", "sphChainOk", "sphExecError"}
TOGETHER = (
    ("spherecal.mod", "spherecal_tcp.mod", "spherecal_main.mod", "spherecal_job.mod"),
    ("spherecal.mod", "spherecal_serial.mod", "spherecal_main.mod"),
)


def locals_of(module: Module) -> set[str]:
    found: set[str] = set()

    def walk(statements: tuple[object, ...]) -> None:
        for statement in statements:
            if isinstance(statement, tuple) and statement and statement[0] == "local":
                found.add(str(statement[1]))
            if isinstance(statement, tuple) and statement and statement[0] == "for":
                found.add(str(statement[1]))
            if isinstance(statement, tuple):
                walk(statement)

    for routine in module.routines.values():
        found.update(routine.parameters)
        walk(routine.body)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_a_module_can_be_read_and_its_lines_and_names_are_short(name: str) -> None:
    text = module_text(name)
    module = read(text)
    assert text.isascii()
    assert max(len(line) for line in text.splitlines()) <= LONGEST_SOURCE_LINE
    names = {module.name, *module.data, *module.routines, *locals_of(module)}
    assert max(len(each) for each in names) <= LONGEST_NAME
    assert not {each.upper() for each in names} & KEYWORDS
    assert "\t" not in text


@pytest.mark.parametrize("broken", ["ENDPROC", "THEN", ";", ":=", '"', "ENDIF"])
def test_the_reader_sees_what_is_missing(broken: str) -> None:
    text = module_text("spherecal.mod")
    at = text.rindex(broken)
    with pytest.raises(RapidSyntaxError):
        read(text[:at] + text[at + len(broken) :])


@pytest.mark.parametrize("names", [*TOGETHER, ("spherecal_state.mod",)])
def test_everything_that_is_used_is_declared_once_or_known(names: tuple[str, ...]) -> None:
    modules = [read(module_text(name)) for name in names]
    declared = [each.lower() for module in modules for each in (*module.data, *module.routines)]  # RAPID does not tell case apart
    assert len(declared) == len(set(declared))
    known = {*declared, *(each.lower() for each in (*INSTRUCTIONS, *PREDEFINED, *SIGNALS))}
    for module in modules:
        assert not {each for each in module.used if each.lower() not in known | {local.lower() for local in locals_of(module)}}
        assert not {(instruction, option) for instruction, option in module.options if option not in INSTRUCTIONS[instruction]}
        assert not {each.lower() for each in locals_of(module)} & {each.lower() for each in INSTRUCTIONS}
        unused = {each for each in (*module.data, *module.routines) if not any(each in other.used for other in modules)}
        assert unused <= {"main", "SphOnRestart", "SphTrigger", "SphResult"}


@pytest.mark.parametrize("names", TOGETHER)
def test_calls_have_the_arguments_that_routines_take(names: tuple[str, ...]) -> None:
    modules = [read(module_text(name)) for name in names]
    routines = {name: routine for module in modules for name, routine in module.routines.items()}
    n_calls = 0

    def walk(part: object) -> None:
        nonlocal n_calls
        if isinstance(part, tuple):
            if len(part) == 3 and part[0] in ("call", "function") and part[1] in routines:
                n_calls += 1
                assert len(part[2]) == len(routines[part[1]].parameters), part[1]
                assert (part[0] == "function") is (routines[part[1]].kind == "FUNC"), part[1]
            for inner in part:
                walk(inner)

    for routine in routines.values():
        walk(routine.body)
        walk(routine.handler)
    assert n_calls > 50


def constants(name: str) -> dict[str, object]:
    module = read(module_text(name))
    return {each: value[1] for each, (kind, _, value) in module.data.items() if kind == "CONST"}


def test_the_tables_of_both_sides_are_the_same() -> None:
    found = constants("spherecal.mod")
    faults = {f"SPH_{'BAD_' if fault not in (Fault.EXPIRED, Fault.BUSY) else ''}{fault.name}": fault for fault in Fault}
    renamed = {"SPH_BAD_CHECKSUM": "SPH_BAD_SUM"}
    for name, fault in faults.items():
        if fault is not Fault.NOT_READY:  # no request of this version is answered by it
            assert found[renamed.get(name, name)] == fault
    for outcome in Outcome:
        assert found[f"SPH_{outcome.name}"] == outcome
    assert found["SPH_VERSION"] == protocol.VERSION
    assert found["SPH_LONGEST"] == protocol.LONGEST
    assert found["SPH_LAST_EPOCH"] == protocol.LAST_EPOCH
    assert (found["SPH_ANGLE_DEC"], found["SPH_ANGLE_WID"]) == (protocol.ANGLE_DECIMALS, protocol.ANGLE_WIDTH)
    assert (found["SPH_LENGTH_DEC"], found["SPH_QUAT_DEC"]) == (protocol.LENGTH_DECIMALS, protocol.QUATERNION_DECIMALS)
    assert (found["SPH_TOKEN_LIFE"], found["SPH_FASTEST"], found["SPH_RAMP"]) == (protocol.TOKEN_LIFE_S, protocol.FASTEST_DEG_S, RAMP_S)
    text = module_text("spherecal.mod")
    for verb in Verb:
        assert (f'sphWord{{2}}="{verb}"' in text) is (verb not in MASTER_VERBS or verb is Verb.HELLO)


def requests() -> list[bytes]:
    """Every verb, right and wrong, with the robot standing."""
    target = ("10.00000", "-5.50000", "3.25000", "0.00000", "20.12345", "-170.1234")
    lines = [
        encode(1, Verb.HELLO), encode(2, Verb.INFO, "1"), encode(3, Verb.INFO, "2"), encode(4, Verb.INFO, "3"), encode(5, Verb.INFO, "9"),
        encode(6, Verb.INFO), encode(7, Verb.TOOL), encode(8, Verb.STATE), encode(9, Verb.POSE), encode(10, Verb.LAST), encode(11, "FLY", "1"),
        encode(12, Verb.TARGET, *target), encode(12, Verb.TARGET, *target), encode(12, Verb.STATE), encode(13, Verb.GO, "7", "0012", "20.0", "3.0"),
        encode(14, Verb.GO, "1", "0011", "20.0", "3.0"), encode(15, Verb.GO, "1", "0012", "20.0", "3.0"), encode(16, Verb.TARGET, *target),
        encode(17, Verb.GO, "1", "0016", "61.0", "3.0"), encode(18, Verb.TARGET, *target[:5]), encode(19, Verb.TARGET, *target[:5], "x"),
        encode(20, Verb.STOP), encode(21, Verb.GO, "1", "18", "x", "3"), encode(22, Verb.TRIGGER, "1", *target), b"0023 J*00\n", b"rubbish\n",
        b"x" * 200 + b"\n", b"\n", b"0024 J*" + checksum("0024 J").encode() + b"\r\n",
    ]  # fmt: skip
    return lines


def test_the_rapid_text_answers_as_the_simulated_controller_does() -> None:
    world = World([(0.1 + 0.2 * i, line) for i, line in enumerate(requests())])
    world.joints_deg = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    from_rapid = world.run()
    now_s = 0.0
    twin = AbbProgram(abb_cell(), lambda: now_s)
    from_python = []
    buffer = LineBuffer()
    for i, data in enumerate(requests()):
        now_s = 0.1 + 0.2 * i
        from_python += [twin.answer(line.removesuffix(b"\r")) for line in buffer.feed(data)]
    assert len(from_python) == len(requests())
    assert from_rapid == from_python
    assert world.moves_begun == 0


def script(*steps: tuple[float, object]) -> World:
    return World(list(steps), ends_s=20.0)  # type: ignore[arg-type]


def target(first_deg: float, number: int = 100) -> bytes:
    return encode(number, Verb.TARGET, f"{first_deg:.5f}", *["0.00000"] * 5)


def go(number: int = 101, token: int = 100, epoch: int = 1, speed: float = 20.0, watchdog: float = 3.0) -> bytes:
    return encode(number, Verb.GO, str(epoch), f"{token:04d}", f"{speed:.4f}", f"{watchdog:.2f}")


def told(world: World, word: str) -> list[tuple[str, ...]]:
    return [line.arguments for line in (decode(data[:-1]) for data in world.sent) if line.word == word]


def ask_state(number: int) -> bytes:
    return encode(number, Verb.STATE)


def states(world: World) -> list[str]:
    return [parse_state(line).motion for line in (decode(data[:-1]) for data in world.sent) if line.word == "J"]


def polls(begin_s: float, end_s: float, step_s: float = 0.3) -> list[tuple[float, bytes]]:
    return [(float(t), ask_state(1000 + i)) for i, t in enumerate(np.arange(begin_s, end_s, step_s))]


def test_a_motion_is_answered_at_once_told_of_while_it_lasts_and_then_done() -> None:
    world = script((0.1, target(30.0)), (0.2, go()), *polls(0.5, 4.0), (5.0, encode(9, Verb.LAST)))
    world.run()
    assert told(world, "G") == [("1", "0100", "2.00")]
    assert states(world)[0] == "M"
    assert states(world)[-1] == "D"
    assert world.joints_deg[0] == pytest.approx(30.0, abs=1e-4)
    assert told(world, "L") == [("1", "100", str(int(Outcome.REACHED)))]
    assert world.moves_begun == 1


def test_a_repeated_start_moves_once() -> None:
    again = ((0.3, go()), (0.9, go()), *polls(1.0, 4.0), (5.0, go()))
    world = script((0.1, target(30.0)), (0.2, go()), *again, (5.2, target(0.0, 200)), (5.4, go(201, 100)))
    world.run()
    assert world.moves_begun == 1
    assert told(world, "E")[-1][0] == str(int(Fault.TOKEN))


def test_stop_stops_forgets_the_path_and_the_next_motion_works() -> None:
    stopped = (*polls(0.5, 1.0), (1.0, encode(3, Verb.STOP)), (2.0, encode(4, Verb.LAST)))
    world = script((0.1, target(30.0)), (0.2, go()), *stopped, (3.0, target(0.0, 200)), (3.2, go(201, 200)), *polls(3.4, 9.0))
    world.run()
    assert told(world, "L") == [("1", "100", str(int(Outcome.STOPPED)))]
    assert world.journal[1:5] == ["StopMove", "ClearPath", "StartMove", "ExitCycle"]
    assert world.moves_begun == 2
    assert world.joints_deg[0] == pytest.approx(0.0, abs=1e-4)


def test_a_silent_computer_and_a_lost_link_end_a_motion() -> None:
    world = script((0.1, target(120.0)), (0.2, go(watchdog=1.0)), (5.0, encode(4, Verb.LAST)))
    world.run()
    assert told(world, "L")[0][2] == str(int(Outcome.SILENCE))
    world = script((0.1, target(120.0)), (0.2, go()), (0.8, b""), (5.0, encode(4, Verb.LAST)))
    world.run()
    assert told(world, "L")[0][2] == str(int(Outcome.LINK_LOST))
    assert world.joints_deg[0] < 30


def hold(seconds: float) -> object:
    def act(world: World) -> None:
        world.held_s = seconds
        world.travelled_deg = 0.0

    return act


def test_a_motion_that_was_held_never_goes_on() -> None:
    """Emergency stop, motors on, Start: with the event routine not at all, without it for one look at most."""
    for installed, most_deg in ((True, 0.0), (False, 3.0)):
        afterwards = ((12.0, encode(4, Verb.LAST)), (13.0, encode(101, Verb.LAST)), (13.5, go(301)))
        world = script((0.1, target(120.0)), (0.2, go()), *polls(0.4, 1.0), (1.0, hold(8.0)), *afterwards)
        world.restart_event = installed
        world.run()
        assert told(world, "L")[0][2] == str(int(Outcome.HELD))
        assert told(world, "E")[-1][0] == str(int(Fault.TOKEN))
        assert world.moves_begun == 1
        assert world.travelled_deg <= most_deg


def test_a_motion_that_was_asked_for_and_held_before_it_began_does_not_begin() -> None:
    """Start is pressed between GO and the motion, and between the motion's first lines and MoveAbsJ."""
    world = script((0.1, target(30.0)))
    world.ends_s = 0.5
    world.run()
    world.machine.data.update(sphGo=True, sphTokenNo=np.float32(5))
    world.machine.call("SphOnRestart")
    assert (world.machine.data["sphGo"], world.machine.data["sphTokenNo"]) == (False, 0)
    assert world.machine.data["sphOutcome"] == Outcome.HELD
    assert not world.stop_move
    for changes in ({"sphHeldNow": True, "sphGivenAt": np.float32(0.1)}, {"sphGivenAt": np.float32(-20.0)}):
        world.machine.data.update(sphGo=True, **changes)
        with pytest.raises(ExitCycle):
            world.machine.call("SphMoveNow")
        assert world.machine.data["sphOutcome"] == Outcome.HELD
        assert not world.machine.data["sphMoving"]
    assert world.moves_begun == 0


def test_after_pp_to_routine_what_was_asked_for_is_over() -> None:
    """PP to SphServe keeps the variables: neither a GO nor a motion under way is gone on with, and a token is none any more."""
    for before in ({"sphGo": True}, {"sphMoving": True}, {"sphTokenNo": np.float32(100)}):
        world = script((0.1, target(30.0)))
        world.ends_s = 0.5
        world.run()
        outcome = Outcome.NONE if "sphTokenNo" in before else Outcome.RUNNING
        world.machine.data.update(before, sphGivenAt=np.float32(0.4), sphOutcome=np.float32(outcome))
        world.script, world.ends_s = [(0.7, go()), (0.9, encode(4, Verb.LAST))], 2.0
        world.run()
        assert told(world, "E")[-1][0] == str(int(Fault.TOKEN))
        assert told(world, "L")[0][2] == str(int(Outcome.NONE if "sphTokenNo" in before else Outcome.HELD))
        assert world.moves_begun == 0


def test_after_pp_to_main_nothing_of_before_is_known() -> None:
    def pp_to_main(world: World) -> None:
        world.pp_main = True

    afterwards = ((3.0, go()), (4.0, go(301, 100, epoch=2)), (5.0, encode(4, Verb.HELLO)))
    world = script((0.1, target(120.0)), (0.2, go()), *polls(0.4, 1.0), (1.0, pp_to_main), *afterwards)
    world.run()
    assert [error[0] for error in told(world, "E")] == [str(int(Fault.EPOCH)), str(int(Fault.TOKEN))]
    assert told(world, "H") == [("1", "2")]
    assert world.moves_begun == 1


def test_a_target_goes_stale() -> None:
    world = script((0.1, target(30.0)), *polls(1.0, 6.0, 1.0), (6.5, go()))
    world.run()
    assert told(world, "E") == [(str(int(Fault.EXPIRED)), "target", "expired")]
    assert world.moves_begun == 0


def test_the_clock_is_set_back_before_it_grows_coarse() -> None:
    def hours_pass(world: World) -> None:
        world.now_s += 12000.0

    world = World([(0.5, hours_pass), (12004.0, target(30.0)), (12004.2, go()), *polls(12004.4, 12007.0)], ends_s=12008.0)
    world.run()
    assert world.clock_from_s > 9000
    assert world.joints_deg[0] == pytest.approx(30.0, abs=1e-4)


@pytest.mark.parametrize("via", ["tcp", "serial"])
def test_the_program_is_written_with_the_settings_filled_in(via: str, tmp_path: Path) -> None:
    settings = ProgramSettings(via=via, address="10.1.2.3", port=6000, com="COM2:", mass_kg=2.5)  # type: ignore[arg-type]
    written = write_program(tmp_path / "out", settings)
    assert {path.name for path, _ in written} == {*module_names(settings), program.PAGE}
    for name in module_names(settings):
        read((tmp_path / "out" / name).read_bytes().decode("ascii"))
    assert '[2.5,[0,0,50]' in filled_in("spherecal.mod", settings)
    line = constants_of(filled_in(f"spherecal_{via}.mod", settings))
    assert (line["SPH_ADDRESS"], line["SPH_PORT"]) == ("10.1.2.3", 6000) if via == "tcp" else line["SPH_COM"] == "COM2:"
    text = page(settings)
    assert "{{" not in text
    assert "<!--" not in text
    assert ("616-1" in text) is (via == "tcp")
    assert "never run on hardware" in text.lower()
    with pytest.raises(SettingsError):
        write_program(tmp_path / "out", settings)
    write_program(tmp_path / "out", settings, force=True)


def constants_of(text: str) -> dict[str, object]:
    return {name: value[1] for name, (kind, _, value) in read(text).data.items() if kind == "CONST"}


def test_what_rapid_could_not_hold_is_not_written(tmp_path: Path) -> None:
    for settings in (ProgramSettings(address='1"; X'), ProgramSettings(com="COM1"), ProgramSettings(pc_address="host.example")):
        with pytest.raises(SettingsError):
            write_program(tmp_path / "x", settings)


def test_every_argument_count_is_a_line() -> None:
    assert set(ARGUMENTS) == set(Verb)
