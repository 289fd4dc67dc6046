"""A job's inspection: the stitched cloud against the nominal, in the job's own folder, and the verdict for the history."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import DataError
from measure.jobs.outputs import RESULT_FILE

if TYPE_CHECKING:
    from calibrate.result import Calibration
    from drivers.files.session import Session
    from drivers.kinematics.se3 import FloatArray
    from measure.inspecting.fitting import Response
    from measure.inspecting.nominal import Nominal
    from measure.inspecting.uncertainty import FieldError

FOLDER = "inspection"


def inspect_part(calibration: Calibration, session: Session, cloud: Path, nominal: Path, spec: Path | None, working: Path) -> Mapping[str, object]:
    """Inspect a part's cloud, write the pages and tables beside it, and give what `inspect --json` prints.

    Args:
        calibration: with which the cloud was stitched.
        session: from which it was stitched.
        cloud: the stitched cloud.
        nominal: mesh of the part.
        spec: inspection.yaml; None compares with the mesh alone.
        working: the folder of this attempt.

    Raises:
        DataError: nothing of the cloud lies on the part, or it cannot be aligned.
        FileError: mesh or specification is broken, or a check asks for what its feature does not have.
        SettingsError: the datums fix no frame.
    """
    from measure.inspecting.cloud import load_cloud
    from measure.inspecting.inspection import inspect_cloud
    from measure.inspecting.outputs import write_outputs
    from measure.inspecting.spec import InspectionSpec, load_spec

    wanted = InspectionSpec(format="spherecal-inspection/1") if spec is None else load_spec(spec)
    found = inspect_cloud(load_cloud(cloud), _nominal(nominal), wanted, field_source=_field_source(calibration, session))
    write_outputs(working / FOLDER, found, recording=False)
    return {**found.to_json_dict(), "out": FOLDER}


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
def _nominal(path: Path) -> Nominal:
    """Read once a worker: the copy beside the results never changes."""
    from measure.inspecting.nominal import load_nominal

    return load_nominal(path)


def _field_source(calibration: Calibration, session: Session) -> Callable[[Sequence[Response], FloatArray], FieldError]:
    """What calibration and views tell of the errors that a cloud's points share."""
    from measure.inspecting.views import seen_field, views_of

    views = views_of(calibration, session)

    def source(responses: Sequence[Response], part_from_base: FloatArray) -> FieldError:
        return seen_field(calibration, views, responses, part_from_base)

    return source
