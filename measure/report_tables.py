"""Tables of a report that list everything: each shot with its pose and points, and other calibrations on the same shots."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict

import numpy as np

from calibrate.result import Calibration
from calibrate.result_parts import ShotResult
from measure.report_page import Table
from measure.report_text import NOTHING
from measure.verify_result import VerifyResult

FORMAT = "spherecal-report/1"


def shots_table(shots: Sequence[ShotResult], session_names: Mapping[str, str]) -> tuple[Table, ...]:
    """Every shot that was used, as it went into the calibration; nothing for a robot calibrated alone."""
    if not shots:
        return ()
    lead = (
        "As the calibration used it. Point rms: about the shot's own sphere centre, noise and form. Radial rms: about the common centre. Left out: "
        "distance of its centre from where a solve without this shot expects it. mm; axes in degrees."
    )
    heads = ("session", "shot", "sphere", "points", "point rms", "radial rms", "left out", "x, y, z in camera", "axes")
    rows = tuple(
        (
            session_names.get(shot.session, shot.session[:12]),
            str(shot.index),
            shot.sphere,
            str(shot.n_points),
            f"{shot.point_rms_mm:.3f}",
            f"{shot.radial_rms_mm:.3f}",
            NOTHING if shot.predicted_error_mm is None else f"{shot.predicted_error_mm:.3f}",
            " ".join(f"{x:.1f}" for x in shot.centre_in_camera_mm),
            NOTHING if shot.joints_rad is None else " ".join(f"{q:.1f}" for q in np.degrees(shot.joints_rad)),
        )
        for shot in shots
    )
    return (Table("Every shot of the calibration", lead, heads, rows),)


def beside_table(result: VerifyResult | None, others: Sequence[tuple[str, VerifyResult]]) -> tuple[Table, ...]:
    """The same unseen shots by this calibration, by others, and by none."""
    if result is None or not others:
        return ()
    columns = [("this calibration", result), *others]
    before = result.before
    rows: dict[str, list[float | None]] = {
        "centre rms": [None if before is None else before.centre_rms_mm, *(r.figures.centre_rms_mm for _, r in columns)],
        "largest centre distance": [None if before is None else before.centre_max_mm, *(r.figures.centre_max_mm for _, r in columns)],
        "radial rms": [None if before is None else before.radial_rms_mm, *(r.figures.radial_rms_mm for _, r in columns)],
        "length errors, rms": [_rms(result.before_length_errors_mm.values()), *(_rms(x.error_mm for x in r.lengths) for _, r in columns)],
        "length errors, mean size": [_mean(result.before_length_errors_mm.values()), *(_mean(x.error_mm for x in r.lengths) for _, r in columns)],
    }
    lead = "Calibrations judged on the same shots, which none of them saw. mm."
    return (
        Table(
            "Beside other calibrations",
            lead,
            ("figure", "uncalibrated", *(name for name, _ in columns)),
            tuple((label, *(NOTHING if value is None else f"{value:.3f}" for value in values)) for label, values in rows.items()),
        ),
    )


def _rms(values: Iterable[float]) -> float | None:
    found = np.array(list(values), dtype=np.float64)
    return float(np.sqrt((found**2).mean())) if len(found) else None


def _mean(values: Iterable[float]) -> float | None:
    found = np.array(list(values), dtype=np.float64)
    return float(np.abs(found).mean()) if len(found) else None


def report_data(calibration: Calibration, verification: VerifyResult | None, others: Sequence[tuple[str, VerifyResult]]) -> dict[str, object]:
    """The report for machines: what the calibration says of itself, every shot, and the proof."""
    return {
        "format": FORMAT,
        "calibration": {
            "id": calibration.id,
            "cell": calibration.cell_name,
            "method": calibration.method,
            "camera_error": calibration.camera_error.name,
            "verdict": calibration.verdict,
            "reasons": list(calibration.reasons),
            "created_utc": calibration.created_utc,
            "software": calibration.software,
            "inputs": dict(calibration.inputs),
            "identity": dict(calibration.identity),
            "temperatures_c": {name: list(pair) for name, pair in calibration.temperatures_c.items()},
            "statistics": asdict(calibration.statistics),
            "shots": [_shot(shot) for shot in calibration.shots],
            "rejected": [{"session": r.session, "index": r.index, "reason": r.reason} for r in calibration.rejected],
        },
        "verification": None if verification is None else verification.to_json_dict(),
        "others": {name: result.to_json_dict() for name, result in others},
    }


def _shot(shot: ShotResult) -> dict[str, object]:
    return {
        "session": shot.session,
        "index": shot.index,
        "sphere": shot.sphere,
        "scan_sha256": shot.scan_sha256,
        "n_points": shot.n_points,
        "point_rms_mm": shot.point_rms_mm,
        "radial_rms_mm": shot.radial_rms_mm,
        "left_out_mm": shot.predicted_error_mm,
        "centre_in_camera_mm": shot.centre_in_camera_mm.tolist(),
        "joints_rad": None if shot.joints_rad is None else shot.joints_rad.tolist(),
    }
