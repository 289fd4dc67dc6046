"""A job's inspection: the stitched cloud against the nominal, in the job's own folder, and the verdict for the history."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import DataError, SettingsError
from measure.jobs.outputs import RESULT_FILE

if TYPE_CHECKING:
    from calibrate.result import Calibration
    from drivers.files.session import Session
    from measure.jobs.model import Files
    from measure.part import Drawing
    from measure.stitch import StitchResult, StitchSettings

FOLDER = "inspection"


def inspect_part(
    calibration: Calibration, session: Session, settings: StitchSettings, files: Files, working: Path
) -> tuple[StitchResult, Mapping[str, object]]:
    """Stitch a part's scans and inspect the cloud, write it with pages and tables, and give what `inspect --json` prints.

    Args:
        calibration: with which the cloud is stitched.
        session: of the part.
        settings: of the stitching.
        files: the mesh, and what is asked of the part; without a specification the cloud is compared with the mesh alone.
        working: the folder of this attempt.

    Raises:
        DataError: nothing of the cloud lies on the part, or it cannot be aligned.
        FileError: mesh, specification or a scan is broken, or a check asks for what its feature does not have.
        SettingsError: the datums fix no frame.
    """
    from measure.inspecting.inspection import with_deviations
    from measure.inspecting.outputs import write_outputs
    from measure.part import measure_part

    drawing = _drawing(files)
    # the place of an attempt means nothing to anybody later
    part = measure_part(calibration, session, drawing, Path(), settings, spill_folder=working)
    part.write_cloud(working)
    found = with_deviations(part.inspection, part.cloud(), drawing.nominal, drawing.spec)
    write_outputs(working / FOLDER, found, recording=False)
    return part.stitched, {**found.to_json_dict(), "out": FOLDER}


def record_inspection(history: str, calibration: Calibration, file: Path, result_folder: Path) -> None:
    """Keep a part's inspection in the history; one that is there already stays as it is.

    Args:
        history: its place.
        calibration: that the part was measured with.
        file: of the calibration.
        result_folder: of the job.

    Raises:
        DataError: the history could not be written.
    """
    from measure.history.recording import record_result

    result = json.loads((result_folder / RESULT_FILE).read_text(encoding="utf-8"))
    if result["inspection"] is None:
        return
    content = {"part": result["part"], "job": result["job"], "marks": result["marks"], **result["inspection"]}
    kept = record_result(history, "inspection", calibration, file, content, _unheard, taken_utc=result["taken_utc"])
    if kept is not None and kept["problem"] is not None:
        raise DataError(str(kept["problem"]))


def _unheard(_text: str) -> None:
    """Thousands of parts need no line each."""


@lru_cache(maxsize=1)
def _drawing(files: Files) -> Drawing:
    """Read once a worker: the copies beside the results never change.

    Raises:
        FileError: mesh, specification or correlation is broken.
        SettingsError: there is no mesh.
    """
    from measure.gauge.correlation import load_correlation
    from measure.inspecting.nominal import load_nominal
    from measure.inspecting.spec import InspectionSpec, load_spec
    from measure.part import Drawing

    if files.nominal is None:
        raise SettingsError("an inspection without a mesh", remedy="Name the mesh with --nominal.")
    spec = InspectionSpec(format="spherecal-inspection/1") if files.spec is None else load_spec(files.spec)
    correlation = None if files.correlation is None else load_correlation(files.correlation)
    return Drawing(load_nominal(files.nominal), spec, correlation, files.judge_corrected)
