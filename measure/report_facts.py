"""From a calibration to the plain facts that a report states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from acquire.cell import Cell
from calibrate.datum import Datum
from calibrate.result import Calibration
from calibrate.result_parts import ShotResult
from drivers.kinematics.se3 import FloatArray
from drivers.registry import untried_drivers
from measure.report_page import CalibrationFacts, ShotResidual

_DATUM_TEXTS = {
    "nominal_robot": "base = best fit of the calibrated to the nominal robot over the work volume",
    "controller": "base = as the controller reports it",
    "calibration": "base = that of the earlier calibration {like}: best fit to its robot over the work volume",
    "spheres": "base = that of the earlier calibration {like}: spheres {spheres} stand where they stood",
}


def _datum_text(datum: Datum) -> str:
    return _DATUM_TEXTS.get(datum.kind, datum.kind).format(like=datum.like[:12], spheres=", ".join(datum.spheres))


def facts_of(calibration: Calibration, cell: Cell | None = None, session_names: Mapping[str, str] | None = None) -> CalibrationFacts:
    """What a report says of a calibration.

    Args:
        calibration: the calibration.
        cell: for the camera's working range, and whether the cell is simulated.
        session_names: names by digest, instead of the folders that the calibration names.
    """
    names = {**folders_of(calibration.inputs), **(session_names or {})}
    statistics = calibration.statistics
    return CalibrationFacts(
        id=calibration.id,
        cell_name=calibration.cell_name,
        verdict=calibration.verdict,
        reasons=calibration.reasons,
        method=calibration.method,
        camera_error=_camera_error_text(calibration),
        n_shots=statistics.n_shots,
        used=statistics.used,
        rejected=tuple((_name(names, r.session), r.index, r.reason) for r in calibration.rejected),
        rank=statistics.rank,
        n_parameters=statistics.n_parameters,
        train_rms_mm=statistics.train_rms_mm,
        cross_validated_rms_mm=statistics.cross_validated_rms_mm,
        radius_offset_mm=calibration.radius_offset_mm,
        datum=_datum_text(calibration.datum),
        simulated=_is_simulated(calibration, cell),
        identity=dict(_identity(calibration)) | dict(_artefacts(cell)),
        shots=tuple(_residual(shot) for shot in calibration.shots),
        residual_name=_residual_name(calibration.shots),
        seen_mm=calibration.camera_seen_volume_mm,
        working_range_mm=None if cell is None else cell.camera.working_range_mm,
        limits=calibration.limits,
        field_of_view_deg=None if cell is None else cell.camera.field_of_view_deg,
        camera_field=calibration.camera_field if len(calibration.camera_mm) else None,
        seen_cells=calibration.cells,
        identifiability=calibration.identifiability,
        error_budget=calibration.error_budget,
        robot_alone=calibration.hand_eye != "calibrated",
        untried_drivers=untried_drivers(*_drivers(calibration, cell)),
    )


def _camera_error_text(calibration: Calibration) -> str:
    compared = calibration.statistics.compared
    if not compared:
        return calibration.camera_error.name
    # null where too little was left to compare on
    tried = ", ".join(name if rms is None else f"{name} {rms:.3f}" for name, rms in compared.items())
    return f"{calibration.camera_error.name} (left-out rms, mm: {tried})"


def _residual(shot: ShotResult) -> ShotResidual:
    value = shot.radial_rms_mm if shot.predicted_error_mm is None else shot.predicted_error_mm
    return ShotResidual(shot.session, shot.index, shot.sphere, value, shot.centre_in_camera_mm)


def _residual_name(shots: Sequence[ShotResult]) -> str:
    is_centre = any(shot.centre_in_base_mm is not None for shot in shots)
    return "distance from sphere centre, mm" if is_centre else "radial rms, mm"


def _drivers(calibration: Calibration, cell: Cell | None) -> set[str]:
    """Of robot and camera, as the calibration's file and the cell name them."""
    named = calibration.inputs.get("drivers")
    known = {str(name) for name in named.values()} if isinstance(named, Mapping) else set()
    return known if cell is None else known | {cell.robot.driver, cell.camera.driver}


def _is_simulated(calibration: Calibration, cell: Cell | None) -> bool:
    return "simulated" in {*_drivers(calibration, cell), *(str(value) for value in calibration.identity.values())}


def folders_of(inputs: Mapping[str, object]) -> dict[str, str]:
    """Folder names of the calibration's sessions by digest, as far as its inputs tell them."""
    sessions = inputs.get("sessions")
    rows = [row for row in sessions if isinstance(row, Mapping)] if isinstance(sessions, list | tuple) else []
    return {str(row["digest"]): str(row["folder"]) for row in rows if "digest" in row and "folder" in row}


def _artefacts(cell: Cell | None) -> Iterator[tuple[str, str]]:
    if cell is None:
        return
    for name, sphere in cell.spheres.items():
        certificate = f", certificate: {sphere.certificate}" if sphere.certificate else ""
        yield f"sphere {name}", f"diameter {sphere.diameter_mm:g} mm, U {sphere.expanded_uncertainty_mm:g} mm{certificate}"
    for length in cell.lengths:
        yield f"length {'-'.join(length.between)}", f"{length.length_mm:g} mm, U {length.expanded_uncertainty_mm:g} mm"


def _identity(calibration: Calibration) -> Iterator[tuple[str, str]]:
    yield "calibrated", f"{calibration.created_utc} by {calibration.software}"
    yield "robot model", "none: flange poses as the controller reports them" if calibration.model is None else calibration.model.name
    yield from _external(calibration)
    yield from _flat(calibration.identity, "")
    yield from ((f"input {key}", value) for key, value in _flat(calibration.inputs, ""))
    for sensor, (coldest, warmest) in calibration.temperatures_c.items():
        yield f"temperature {sensor}", f"{coldest:.1f}°C to {warmest:.1f}°C"
    if calibration.seen_joints_rad is not None:
        low, high = np.degrees(calibration.seen_joints_rad)
        yield "axis ranges used", ", ".join(f"{a:.0f}° to {b:.0f}°" for a, b in zip(low, high, strict=True))


def _external(calibration: Calibration) -> Iterator[tuple[str, str]]:
    external = calibration.external
    if external is None:
        return
    if calibration.hand_eye != "calibrated":
        source = "the cell file's" if calibration.hand_eye == "cell" else "nothing is known of it"
        yield "hand-eye transform and camera", f"not calibrated, for no sphere was seen: {source}"
    left_out = external.cross_validated_rms_mm
    missed = "" if left_out is None else f", missed by {left_out:.3f} mm rms when left out"
    yield "external reference points", f"{len(external.shots)} used{missed}"
    for name, frame in external.references.items():
        sigma_mm = float(np.sqrt(np.trace(frame.covariance[:3, :3])))
        yield f"external reference {name}", f"origin at {_place(frame.base_from_reference[:3, 3])} in the base, 1 sigma {sigma_mm:.3f} mm there"
    for name, target in external.targets.items():
        sigma_mm = float(np.sqrt(np.trace(target.covariance_mm2)))
        yield f"external target {name}", f"{_place(target.point_in_flange_mm)} in the flange, 1 sigma {sigma_mm:.3f} mm"


def _place(point_mm: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in point_mm) + ") mm"


def _flat(value: object, path: str) -> Iterator[tuple[str, str]]:
    """Nested mappings and lists as lines."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(item, f"{path} {key}".strip().replace("_", " "))
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value, start=1):
            yield from _flat(item, f"{path} {number}".strip())
    elif value is not None:
        yield path, str(value)


def _name(names: Mapping[str, str], digest: str) -> str:
    return names.get(digest, digest[:12])
