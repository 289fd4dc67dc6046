"""`spherecal export`: a calibration for other programs, and targets corrected by it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from measure.cli_measure import CalibrationFile
from measure.cli_run import AsJson, Debug, Quiet, command

if TYPE_CHECKING:
    from calibrate.export import Exported
    from measure.console import Console


class ExportFormat(StrEnum):
    """`calibrate.export.FORMATS`, spelled out so that `--help` needs no numpy."""

    hand_eye_yaml = "hand-eye-yaml"
    hand_eye_json = "hand-eye-json"
    hand_eye_csv = "hand-eye-csv"
    quaternion = "quaternion"
    ur_pose = "ur-pose"
    rapid_tooldata = "rapid-tooldata"
    ros_transform = "ros-transform"
    urdf_camera = "urdf-camera"
    urdf = "urdf"
    mdh = "mdh"
    mdh_full = "mdh-full"
    ur_kinematics = "ur-kinematics"
    targets_csv = "targets-csv"
    targets_json = "targets-json"
    targets_rapid = "targets-rapid"


def export(
    calibration: CalibrationFile,
    file_format: Annotated[ExportFormat, typer.Option("--format", "-f", help="What to write; docs/export.md says what each one holds.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file to write; without it the text goes to stdout.")] = None,
    targets: Annotated[Path | None, typer.Option("--targets", help="CSV, JSON or RAPID targets to correct (targets-... formats).")] = None,
    as_json: AsJson = False,
    debug: Debug = False,
    quiet: Quiet = False,
) -> None:
    """Write hand-eye, corrected robot or corrected targets for other programs. Exit code 3 when the calibration is a failed one."""
    with command(as_json, debug, quiet) as run:
        from calibrate import Calibration
        from calibrate.export import export_text
        from calibrate.export_notes import robot_of
        from calibrate.export_target_files import read_targets
        from drivers.files.disk import write_text_atomic

        _require_new_place(out, [calibration, *([] if targets is None else [targets])])
        loaded = Calibration.load(calibration)
        read = None if targets is None else read_targets(targets, robot_of(loaded, "corrected targets").n_joints)
        exported = export_text(loaded, file_format.value, targets=read, targets_file=targets)
        if out is None:
            run.console.say(exported.text.rstrip("\n"))
        else:
            write_text_atomic(out, exported.text)
            run.console.say(f"{out} written")
        _tell(run.console, exported, loaded.verdict)
        result = {"format": file_format.value, "calibration": loaded.id, "verdict": loaded.verdict, "out": out, **_figures(exported)}
        run.finish(result if out is not None else {**result, "text": exported.text}, verdict=loaded.verdict)


def _require_new_place(out: Path | None, inputs: list[Path]) -> None:
    """See that the result can be written and is none of the files it is made from."""
    from drivers.errors import SettingsError
    from measure.files import require_writable

    if out is None:
        return
    require_writable(out)
    if any(out.exists() and path.exists() and out.samefile(path) for path in inputs):
        raise SettingsError("would be overwritten by its own export", file=out, remedy="Name another file with -o.")


def _tell(console: Console, exported: Exported, verdict: str) -> None:
    from calibrate.export_targets import LARGE_CHANGE_RAD

    if verdict == "fail":
        console.note("warning: the verdict of this calibration is fail; do not move a robot by it")
    if exported.residual is not None:
        console.note(exported.residual.text())
    for c in exported.corrected:
        if c.largest_change_rad > LARGE_CHANGE_RAD:
            console.note(f"warning: {c.target.name} is changed by {c.largest_change_rad:.3f} rad: near a singular pose, look before you move")
        if not c.in_seen_range:
            console.note(f"warning: {c.target.name} is outside the axis ranges that the calibration saw: its correction is a guess")


def _figures(exported: Exported) -> dict[str, object]:
    from dataclasses import asdict

    figures: dict[str, object] = {"residual": None if exported.residual is None else asdict(exported.residual)}
    if exported.corrected:
        figures["n_targets"] = len(exported.corrected)
        figures["uncorrected_max_mm"] = max(c.uncorrected_mm for c in exported.corrected)
        figures["outside_seen_range"] = [c.target.name for c in exported.corrected if not c.in_seen_range]
    return figures
