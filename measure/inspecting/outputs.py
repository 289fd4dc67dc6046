"""The files of an inspection: JSON, CSV, coloured PLY, one HTML page, a recording."""

from __future__ import annotations

import csv
import datetime
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import SettingsError
from drivers.files.disk import write_text_atomic
from drivers.files.ply import write_ply
from measure.console import json_text
from measure.files import new_folder
from measure.inspecting.page import page_of, render
from measure.inspecting.picture import colour_scale_mm, colours_of
from measure.inspecting.result import RESULT_FORMAT, Inspection

RESULT_FILE = "inspection.json"


def require_replaceable(folder: Path) -> None:
    """See that nothing but an empty folder or a former inspection will be replaced.

    Raises:
        SettingsError: the folder holds something else.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        former = json.loads((folder / RESULT_FILE).read_text(encoding="utf-8"))
        ours = isinstance(former, dict) and former.get("format") == RESULT_FORMAT
    except (OSError, ValueError):
        ours = False
    if not ours:
        raise SettingsError("exists and is no former inspection", file=folder, remedy="Name another folder with -o.")


def write_outputs(folder: Path, inspection: Inspection, *, recording: bool = True, add: Callable[[Path], None] | None = None) -> None:
    """Write all files; the folder appears whole or not at all, and replaces a former inspection.

    Args:
        folder: where to.
        inspection: what was found.
        recording: whether the Rerun recording is wanted too.
        add: puts further files into the folder before it appears.

    Raises:
        SettingsError: the folder holds something else.
        FileError: it cannot be written.
    """
    require_replaceable(folder)
    with new_folder(folder) as working:
        write_text_atomic(working / RESULT_FILE, json_text(inspection.to_json_dict()) + "\n")
        write_text_atomic(working / "features.csv", features_csv(inspection))
        write_text_atomic(working / "checks.csv", checks_csv(inspection))
        if add is not None:
            add(working)
        write_text_atomic(working / "inspection.html", render(page_of(inspection, datetime.datetime.now(datetime.UTC))))
        if inspection.deviations is not None:
            _write_deviations(working / "deviations.ply", inspection)
            if recording:
                from measure.viewer_inspection import write_inspection

                write_inspection(working / "inspection.rrd", inspection)


def features_csv(inspection: Inspection) -> str:
    """One line a figure of a feature; the form's line is called form."""
    rows: list[list[object]] = []
    for feature in inspection.features:
        common = [
            feature.name,
            feature.kind,
            feature.n_points,
            None if feature.coverage is None else feature.coverage.seen_deg,
            feature.problem or "",
        ]
        for value in feature.values:
            deviation = "" if value.nominal is None else value.measured - value.nominal
            rows.append([*common, value.name, value.unit, value.nominal, value.measured, deviation, value.expanded_uncertainty])
        if feature.problem is None:
            rows.append([*common, "form", "mm", 0.0, feature.form_mm, feature.form_mm, feature.form_expanded_uncertainty_mm])
        else:
            rows.append([*common, *[""] * 6])
    heads = ["feature", "kind", "points", "circumference_seen_deg", "problem", "figure", "unit", "nominal", "measured", "deviation"]
    return _csv([*heads, "expanded_uncertainty"], rows)


def checks_csv(inspection: Inspection) -> str:
    """One line a tolerance."""
    rows: list[list[object]] = []
    for c in inspection.checks:
        raw = [c.name, c.kind, " ".join(c.features), c.unit, c.nominal, c.lower, c.upper, c.measured, c.expanded_uncertainty, c.verdict]
        told = c.corrected
        corrected = [None] * 3 if told is None else [told.value_mm, told.expanded_uncertainty_mm, told.offset_mm]
        rows.append([*raw, c.problem or c.doubt or "", *corrected, "corrected" if c.judged_corrected else "measured"])
    heads = ["name", "kind", "features", "unit", "nominal", "lower", "upper", "measured", "expanded_uncertainty", "verdict", "problem"]
    return _csv([*heads, "corrected", "corrected_expanded_uncertainty", "offset", "judged"], rows)


def _csv(heads: list[str], rows: list[list[object]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(heads)
    for row in rows:
        writer.writerow([_cell(item) for item in row])
    return stream.getvalue()


def _cell(item: object) -> object:
    if isinstance(item, float):
        return f"{item:.6f}" if np.isfinite(item) else ""
    return "" if item is None else item


def _write_deviations(path: Path, inspection: Inspection) -> None:
    deviations = inspection.deviations
    if deviations is None:
        return
    scale_mm = colour_scale_mm(deviations)
    colours = colours_of(deviations.signed_mm, scale_mm)
    channels = {name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}
    properties: dict[str, ArrayLike] = {"deviation": deviations.signed_mm.astype(np.float32), **channels}
    comments = ["unit mm", "frame base", f"calibration {inspection.calibration_id}", f"colour_scale_mm {scale_mm:g}"]
    write_ply(path, deviations.points_in_base_mm.astype(np.float32), properties=properties, comments=comments)
