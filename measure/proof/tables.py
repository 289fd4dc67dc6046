"""The proof's tables on a report page: probing error, slides, and shots beyond the calibrated reach."""

from __future__ import annotations

import numpy as np

from measure.proof.probing import Probing
from measure.proof.slide import CAUTION, NOTHING, slide_rows
from measure.report_page import Table
from measure.verify_result import VerifyResult


def proof_tables(result: VerifyResult) -> tuple[Table, ...]:
    """Those that have anything to say."""
    found = (_probing(result), _slides(result), _external(result), _outside(result), _shots(result))
    return tuple(table for table in found if table.rows)


def _probing(result: VerifyResult) -> Table:
    rows = []
    for name in result.figures.spheres:
        members = [p for p in result.probing if p.sphere == name and p.probing is not None]
        rows += [(name, "all views", *_figures(p.probing)) for p in members if p.session is None]
        rows += [(name, f"{result.session_name(p.session)}, shot {p.index}", *_figures(p.probing)) for p in members if p.session is not None]
    return Table(
        "Probing error of form and size",
        "Free-radius fits. Form: the thinnest shell about the centre that holds all points, 99.7 % or 95 % of them; size: fitted diameter of those "
        "points minus the certified one. All views stitched first, then every view by itself, where no robot error comes in. mm.",
        ("sphere", "of", "points", "form, all", "99.7 %", "95 %", "size, all", "99.7 %", "95 %"),
        tuple(rows),
    )


def _figures(probing: Probing | None) -> tuple[str, ...]:
    if probing is None:
        return (NOTHING,) * 7
    return (str(probing.n_points), *(f"{form:.3f}" for form in probing.form_mm), *(f"{size:+.3f}" for size in probing.size_error_mm))


def _slides(result: VerifyResult) -> Table:
    return Table(
        "Slide test, view by view",
        f"| |P1 - P2| - L | of single views of both ends, no two of a pair from the same robot pose. {CAUTION}",
        ("slide", "pairs", "mean, mm", "max, mm", "std, mm", "signed mean, mm", "refused"),
        tuple(slide_rows(result.slides)),
    )


def _external(result: VerifyResult) -> Table:
    found = result.external
    rows = []
    for point in () if found is None else found.points:
        errors = [f"{e:+.3f} ± {u:.3f}" for e, u in zip(point.error_mm, point.expanded_uncertainty_mm, strict=True)]
        name = f"{result.session_name(point.session)}, shot {point.index}"
        rows.append((name, point.reference, point.target, *errors, f"{point.distance_mm:.3f}"))
    judged = "Judged by the lengths between them, above." if result.of_points_alone else "Told and not judged."
    together = "" if found is None else f"All together: {found.rms_mm:.3f} rms, where these uncertainties expect {found.expected_rms_mm:.3f}. "
    return Table(
        "External reference points",
        "Where the calibrated robot expects a target minus where the reference saw it, in the base, with U (k = 2) of this difference: calibration "
        f"of robot, reference and target, pose noise, noise of the reference. {together}The camera does not come in. {judged} mm.",
        ("point", "reference", "target", "x", "y", "z", "distance"),
        tuple(rows),
    )


def _shots(result: VerifyResult) -> Table:
    shots = {(shot.session, shot.index, shot.sphere): shot for shot in result.observations.shots}
    rows = []
    for view in result.figures.views:
        shot = shots[view.session, view.index, view.sphere]
        centre = NOTHING if shot.centre_in_camera_mm is None else " ".join(f"{x:.1f}" for x in shot.centre_in_camera_mm)
        off = NOTHING if view.deviation_mm is None else f"{view.deviation_mm:.3f}"
        axes = NOTHING if shot.joints_rad is None else " ".join(f"{q:.1f}" for q in np.degrees(shot.joints_rad))
        rows.append(
            (result.session_name(view.session), str(view.index), view.sphere, str(view.n_points), f"{view.radial_rms_mm:.3f}", off, centre, axes)
        )
    return Table(
        "Every shot of the verification",
        "Radial rms: about the sphere's common centre. Off: distance of the shot's own centre from the mean of its sphere's. mm; axes in degrees.",
        ("session", "shot", "sphere", "points", "radial rms", "off", "x, y, z in camera", "axes"),
        tuple(rows),
    )


def _outside(result: VerifyResult) -> Table:
    return Table(
        "Shots beyond what the calibration saw",
        "Used all the same: there the calibration continues what it found elsewhere, and its U says little.",
        ("session", "shot", "sphere", "what"),
        tuple((result.session_name(shot.session), str(shot.index), shot.sphere, "; ".join(shot.what)) for shot in result.outside),
        numeric=False,
    )
