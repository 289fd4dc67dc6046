"""`spherecal plan`: poses that the robot can reach and from which the camera sees what it should."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_run import AsJson, Debug, EarlierCalibration, Quiet, command

if TYPE_CHECKING:
    from collections.abc import Sequence

    from acquire.cell import Cell
    from acquire.obstacles import MeshObstacle
    from calibrate.design_shots import Expectation
    from drivers.kinematics.se3 import FloatArray
    from measure.console import Console
    from measure.covering import Coverage
    from measure.planning import PlanResult, Purpose


class For(StrEnum):
    """What a plan is for."""

    calibrate = "calibrate"
    verify = "verify"
    workpiece = "workpiece"
    check = "check"


_POSES = 40
_PURPOSES: dict[For, Purpose] = {For.calibrate: "calibration", For.verify: "verification", For.workpiece: "workpiece", For.check: "verification"}


def plan(
    cell: Annotated[Path, typer.Argument(help="The cell file.")],
    part: Annotated[Path | None, typer.Argument(help="For --for workpiece: the part to cover (STL, PLY, OBJ in mm).")] = None,
    n: Annotated[int | None, typer.Option("-n", min=1, help="Poses wanted, shared among the spheres; 40, for a check 8, if left out.")] = None,
    purpose: Annotated[For, typer.Option("--for", help="What the poses are for.")] = For.calibrate,
    out: Annotated[Path, typer.Option("--out", "-o", help="The plan to write.")] = Path("plan.yaml"),
    sphere: Annotated[list[str] | None, typer.Option("--sphere", help="Look at this sphere. Repeat; all if left out.")] = None,
    region: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Box in the base, mm, for --for workpiece; the work volume if left out."),
    ] = None,
    placed: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X Y Z RX RY RZ", help="The part's origin in the base, mm, and its turns about the base's x, y, z, degrees."),
    ] = None,
    start_deg: Annotated[
        str | None, typer.Option("--start", metavar="Q1,Q2,...", help="Where the robot stands before the run, axis angles in degrees.")
    ] = None,
    calibration: EarlierCalibration = None,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other poses.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Plan feasible poses (for a calibration those that tell most) and write them as a plan that may be edited."""
    with command(as_json, debug, quiet) as run:
        import numpy as np

        from acquire.cell import load_cell
        from acquire.plan import PLAN_FORMAT, write_plan
        from measure.files import replacing
        from measure.planning import PlanSettings, make_plan

        box = None if region is None else np.array(region).reshape(2, 3)
        loaded = load_cell(cell)
        settings = PlanSettings(
            _PURPOSES[purpose],
            n or _POSES,
            tuple(sphere or ()),
            box,
            _part(loaded, part, placed, purpose),
            seed,
            None if start_deg is None else np.radians(_angles(start_deg)),
            _expectation(calibration) if purpose is For.calibrate else None,
            _poses_of(calibration) if purpose is For.verify else None,
        )
        result = make_plan(loaded, settings) if purpose is not For.check else _check_plan(cell, calibration, sphere or [], n, seed)
        with replacing(out, PLAN_FORMAT) as former:
            write_plan(result.plan, out)
        if former is not None and former.exists():
            run.console.note(f"the earlier {out} was kept as {former}")
        _tell(run.console, result, out)
        run.finish({**result.to_json_dict(), "out": out})


def _check_plan(cell: Path, calibration: Path | None, spheres: list[str], n: int | None, seed: int) -> PlanResult:
    from acquire.cell import load_cell
    from calibrate import Calibration
    from drivers.errors import SettingsError
    from measure.quick.planning import N_POSES, plan_check

    if calibration is None:
        remedy = "Give --calibration calibration.yaml."
        raise SettingsError("a check is planned for the calibration that it checks", where="--calibration", remedy=remedy)
    return plan_check(load_cell(cell), Calibration.load(calibration), spheres, n or N_POSES, seed)


def _part(cell: Cell, part: Path | None, placed: Sequence[float] | None, purpose: For) -> MeshObstacle | None:
    from drivers.errors import SettingsError
    from measure.covering import placed_part

    if part is None and placed is None:
        return None
    if part is None or purpose is not For.workpiece:
        remedy = "Use it as: plan CELL part.stl --for workpiece --placed X Y Z RX RY RZ."
        raise SettingsError("a part and its place are for --for workpiece, both together", where="--placed", remedy=remedy)
    return placed_part(cell, part, placed)


def _angles(text: str) -> list[float]:
    from drivers.errors import SettingsError

    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise SettingsError(f"{text!r} are no axis angles", where="--start", remedy="Give them in degrees, e.g. 0,-90,90,0,45,0.") from error


def _expectation(calibration: Path | None) -> Expectation | None:
    from calibrate import Calibration
    from calibrate.design_cell import expectation_of

    return None if calibration is None else expectation_of(Calibration.load(calibration))


def _poses_of(calibration: Path | None) -> FloatArray | None:
    """(m, n) axis angles that a calibration was made at."""
    import numpy as np

    from calibrate import Calibration

    if calibration is None:
        return None
    joints = [shot.joints_rad for shot in Calibration.load(calibration).shots if shot.joints_rad is not None]
    return np.array(joints) if joints else None


def _tell(console: Console, result: PlanResult, out: Path) -> None:
    rows = [[f"rejected: {reason}", count] for reason, count in sorted(result.rejected.items())]
    console.table("", ["candidates", "views"], [["drawn", result.n_candidates], *rows, ["feasible", result.n_feasible]])
    vias = sum(len(pose.via_rad) for pose in result.plan.poses) - result.n_one_sided
    around = f", {vias} points to pass round what stands in the way" if vias else ""
    console.say(f"{len(result.plan.poses)} poses in {out}, {result.n_one_sided} reached from the same side{around}")
    if result.lengths is not None and result.lengths.wanted_mm is not None and result.lengths.longest_mm < result.lengths.wanted_mm:
        longest, wanted = result.lengths.longest_mm, result.lengths.wanted_mm
        console.note(f"its spheres are at most {longest:.0f} mm apart, less than two thirds of the work volume's diagonal ({wanted:.0f} mm)")
    if result.coverage is not None:
        _tell_coverage(console, result.coverage)
    length_mm, centre_mm = (result.plan.predicted.get(key) for key in ("length_rms_mm", "centre_rms_mm"))
    if length_mm is not None:
        centre = "" if centre_mm is None else f", centre of one view {centre_mm:.3f} mm"
        console.say(f"expected of a calibration from them, one sigma: lengths over the work volume {length_mm:.3f} mm{centre}")
    separations = result.plan.predicted.get("separation_sigmas")
    if isinstance(separations, dict):
        told = ", ".join(f"{name} {value:.1f}" for name, value in separations.items())
        console.say(f"how far each change stands out from the others, standard deviations: {told}")
        console.say(f"the run takes about {result.plan.predicted.get('seconds')} s at 3 s a scan")


def _tell_coverage(console: Console, coverage: Coverage) -> None:
    twice = f"of the surface {coverage.covered_fraction:.1%} is seen, {coverage.seen_twice_fraction:.1%} more than once"
    rest = ", ".join(f"{reason} {share:.1%}" for reason, share in sorted(coverage.not_covered.items(), key=lambda item: -item[1]))
    console.say(f"{twice}; not seen: {rest or 'nothing'}")
