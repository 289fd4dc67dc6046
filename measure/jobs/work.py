"""One part from its folder to its result, in a process of its own; raises nothing, tells everything.

The inputs are read and checked here, not in the runner: whatever a broken file does, it does it to a worker.
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import DataError, SettingsError
from measure.jobs.failures import failure_of
from measure.jobs.marks import trust_in
from measure.jobs.memory import TABLE_MB
from measure.jobs.model import RESULT_FORMAT, Order, Outcome
from measure.jobs.outputs import RESULT_FILE, attempt_folder, commit, read_result, result_folder
from measure.part import CLOUD_FILE

if TYPE_CHECKING:
    from calibrate.result import Calibration
    from drivers.files.session import Session
    from measure.stitch import StitchResult


def measure_part(order: Order) -> Outcome:
    """Do one job: a folder of results, or the reason why there is none."""
    began = time.perf_counter()
    try:
        facts = _facts_of_earlier(order) or _measured(order, began)
    except Exception as error:
        return Outcome(time.perf_counter() - began, worker_name(), failure=failure_of(error))
    return Outcome(time.perf_counter() - began, worker_name(), facts=facts)


def worker_name() -> str:
    """Host and process."""
    return f"{socket.gethostname()}:{os.getpid()}"


def load_program() -> None:
    """Import what every job needs, before the first is waited for."""
    for name in ("calibrate.result", "measure.stitch"):
        importlib.import_module(name)


def facts_of_result(text: str) -> dict[str, object]:
    """What journal and page keep of a result.json."""
    result = json.loads(text)
    stitched = result["stitch"]
    kept = {key: stitched[key] for key in ("n_scans", "n_points", "n_points_in")}
    return {"verdict": result["verdict"], "marks": result["marks"], **kept}


def _facts_of_earlier(order: Order) -> dict[str, object] | None:
    """Of the result that an attempt left whose runner was killed before it could say so."""
    text = read_result(result_folder(order.out, order.job.name))
    return None if text is None else facts_of_result(text)


def _measured(order: Order, began: float) -> dict[str, object]:
    calibration = _calibration(order.files.calibration, order.recipe.calibration_id)
    with attempt_folder(order.out, order.job.name) as working:
        if order.job.kind == "session":
            text = _fill(order, calibration, _session(order), working, began)
        else:
            with attempt_folder(order.out, order.job.name) as place:
                text = _fill(order, calibration, _imported(order, place), working, began)
        commit(working, result_folder(order.out, order.job.name))
    return facts_of_result(text)


def _fill(order: Order, calibration: Calibration, session: Session, working: Path, began: float) -> str:
    """Measure into a folder; the text of its result.json."""
    from measure.console import json_text
    from measure.history.recording import last_taken_utc
    from measure.history.store import now_utc

    trust = trust_in(order.history, calibration, session)
    stitched, inspection = _stitched_and_inspected(order, calibration, session, working)
    result = {
        "format": RESULT_FORMAT,
        "part": order.job.part,
        "job": order.job.id,
        "source": order.job.source,
        "inputs": {"digest": order.job.input_digest, "recipe": order.job.recipe_digest, **asdict(order.recipe)},
        "calibration": {"id": calibration.id, "verdict": calibration.verdict, "created_utc": calibration.created_utc},
        "last_check": trust.last_check_data(),
        "taken_utc": last_taken_utc([session]),
        "marks": [*stitched.marks, *trust.marks],
        "verdict": None if inspection is None else inspection["verdict"],
        "stitch": {**stitched.to_json_dict(), "out": CLOUD_FILE},
        "inspection": inspection,
        "seconds": time.perf_counter() - began,
        "attempt": order.attempt,
        "time_utc": now_utc(),
    }
    text = json_text(result) + "\n"
    (working / RESULT_FILE).write_text(text, encoding="utf-8")
    return text


def _stitched_and_inspected(
    order: Order, calibration: Calibration, session: Session, working: Path
) -> tuple[StitchResult, Mapping[str, object] | None]:
    """What became of the scans, and of the cloud against its nominal where there is one."""
    from measure.stitch import StitchSettings, stitch
    from measure.stitching.scan import DEFAULT_CLEANING, NO_CLEANING

    cleaning = DEFAULT_CLEANING if order.recipe.clean_edges else NO_CLEANING
    settings = StitchSettings(order.recipe.voxel_mm, cleaning, memory_mb=TABLE_MB, n_threads=order.n_threads)
    if order.files.nominal is None:
        return stitch(calibration, session, working / CLOUD_FILE, settings=settings), None
    from measure.jobs.inspection import inspect_part

    return inspect_part(calibration, session, settings, order.files, working)


@lru_cache(maxsize=2)
def _calibration(path: Path, calibration_id: str) -> Calibration:
    """Read once a worker."""
    from calibrate.result import Calibration

    calibration = Calibration.load(path)
    if calibration.id != calibration_id:
        raise SettingsError("is another calibration than the one the job was given", file=path, remedy="Run the command again.")
    return calibration


def _session(order: Order) -> Session:
    from drivers.files.session import read_session

    session = read_session(order.job.source)
    if session.cell_path == order.job.source / "cell.yaml" and session.digest != order.job.input_digest:
        raise DataError("changed after it was found complete", file=order.job.source, remedy="Nothing: it is looked at again.")
    return session


def _imported(order: Order, place: Path) -> Session:
    """A folder of scans and poses as a session, made for this attempt."""
    from acquire.cell import load_cell, robot_model_of
    from acquire.import_clouds import find_clouds, match_clouds
    from acquire.import_poses import Meaning, understand
    from acquire.import_session import plan_import, write_import
    from calibrate.plausibility import likely_cause
    from drivers.files.poses import read_poses
    from drivers.files.session import read_session
    from measure.jobs.parts import MARKER, cloud_folder, pose_file

    source, cell_path = order.job.source, order.files.cell
    poses = pose_file(source)
    if cell_path is None:
        remedy = "Name the cell file with --cell: it says which robot and camera they are from."
        raise SettingsError("holds scans and poses without a session", file=source, remedy=remedy)
    if poses is None:
        raise DataError("the list of poses is gone", file=source, remedy="Put the folder back as it was.")
    cell, listed = load_cell(cell_path), read_poses(poses)
    understood = understand(listed, robot_model_of(cell), Meaning(None, None, None, None), likely_cause)
    matching = match_clouds(listed.labels, find_clouds(cloud_folder(source)), file=poses, allow_missing=(source / MARKER).exists())
    task = plan_import(cell, listed, understood, matching, spheres=(), purpose="workpiece")
    write_import(task, cell, place / "session", purpose="workpiece")
    return read_session(place / "session")
