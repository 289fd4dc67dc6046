"""calibration.yaml: written once, whole in itself, its id the digest of its content."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from acquire.cell import Limits
from acquire.plan import PlannedPose
from calibrate.budget import ErrorBudget
from calibrate.camera_error import camera_error_from_settings
from calibrate.camera_field import seen_cells_data, seen_cells_from_data
from calibrate.datum import CORNERS_MM, Datum, References
from calibrate.external_result import external_data, external_from_data
from calibrate.identifiability import Identifiability
from calibrate.normal import NoiseModel
from calibrate.observations import RejectedShot
from calibrate.result_parts import ShotResult, Statistics
from calibrate.robot_terms import RobotTerm
from drivers.errors import FileError
from drivers.files.disk import write_text_atomic
from drivers.files.yaml import dump_yaml, load_yaml
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.models import robot_model_data, robot_model_from_data

if TYPE_CHECKING:
    from calibrate.result import Calibration

FORMAT = "spherecal-calibration/1"
_NOT_IN_ID = ("id", "created_utc", "software", "seconds")
_OF_POSES = ("joints_rad", "base_from_flange")
_Kind = TypeVar("_Kind", bound="Calibration")


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration, atomically; FileError where the place cannot be written."""
    write_text_atomic(path, dump_yaml(calibration_data(calibration)))


def calibration_data(c: Calibration) -> dict[str, object]:
    """Plain data of a calibration, its id computed from the rest."""
    data: dict[str, object] = {
        "format": FORMAT,
        "id": "",
        "method": c.method,
        "cell": c.cell_name,
        "created_utc": c.created_utc,
        "software": c.software,
        "verdict": c.verdict,
        "reasons": list(c.reasons),
        "limits": None if c.limits is None else c.limits.model_dump(),
        "inputs": dict(c.inputs),
        "identity": dict(c.identity),
        "robot_model": None if c.model is None else robot_model_data(c.model),
        "link_twists": c.link_twists,
        "robot_terms": [
            {"kind": t.kind, "axis": t.axis + 1, "order": t.order, "estimated": t.estimated, "coefficient_rad": float(value)}
            for t, value in zip(c.terms, c.terms_rad, strict=True)
        ],
        "flange_from_camera": c.flange_from_camera,
        "camera_error": {**c.camera_error.settings(), "coefficients_mm": c.camera_mm, "seen_volume_mm": c.camera_seen_volume_mm}
        | seen_cells_data(c.seen_cells),
        "radius_offset_mm": c.radius_offset_mm,
        "spheres": {
            name: {"centre_in_base_mm": centre, "radius_offset_mm": c.sphere_radius_offsets_mm[name]}
            for name, centre in c.sphere_centres_in_base_mm.items()
        },
        "datum": _datum_data(c.datum),
        "seen_axis_ranges_rad": c.seen_joints_rad,
        "temperatures_c": dict(c.temperatures_c),
        "noise": asdict(c.noise),
        "statistics": {key: value for key, value in asdict(c.statistics).items() if key != "seconds"},
        "identifiability": None if c.identifiability is None else c.identifiability.to_json_dict(),
        "next_best_poses": [{"id": pose.id, "sphere": pose.sphere, "joints_rad": pose.joints_rad.tolist()} for pose in c.next_best_poses],
        "error_budget": None if c.error_budget is None else c.error_budget.to_json_dict(),
        "parameters": {
            "names": list(c.parameter_names),
            "sigma": np.sqrt(np.maximum(np.diagonal(c.covariance), 0.0)),
            "covariance_rows": _rows(c.covariance),
        },
        "rejected": [asdict(shot) for shot in c.rejected],
        "shots": [_shot_data(shot) for shot in c.shots],
    }
    if c.external is not None:
        data |= {"hand_eye": c.hand_eye, "external": external_data(c.external)}
    plain = _plain(data)
    return {**plain, "id": content_id(plain)}


def content_id(data: Mapping[str, object]) -> str:
    """sha256 of the canonical content without id, time and software."""
    content = {key: value for key, value in data.items() if key not in _NOT_IN_ID}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def load_calibration(path: str | Path, kind: type[_Kind]) -> _Kind:
    """Read a calibration; FileError when it is broken, or when its content does not fit its id."""
    data = load_yaml(path)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise FileError(
            "is no calibration", file=path, where="format", remedy=f"A calibration begins with `format: {FORMAT}`; `spherecal calibrate` writes one."
        )
    if not _fits_its_id(data):
        raise FileError(
            "the content does not fit its id: the file was changed after it was written",
            file=path,
            where="id",
            remedy="Calibrate again; calibrations are never edited.",
        )
    try:
        return _calibration(data, kind, str(path))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"is incomplete ({type(error).__name__}: {error})", file=path, remedy="Calibrate again to write a whole file.") from error


def _fits_its_id(data: Mapping[str, object]) -> bool:
    try:
        return content_id(data) == data.get("id")
    except TypeError:  # keys of several types cannot be put in order: never written by us
        return False


def _calibration(data: dict[str, object], kind: type[_Kind], file: str) -> _Kind:
    camera = _mapping(data["camera_error"])
    spheres = {name: _mapping(sphere) for name, sphere in _mapping(data["spheres"]).items()}
    datum, parameters = _mapping(data["datum"]), _mapping(data["parameters"])
    limits = data["limits"]
    model_settings = {key: value for key, value in camera.items() if key not in ("coefficients_mm", "seen_volume_mm", "seen_cells")}
    return kind(
        id=str(data["id"]),
        method=str(data["method"]),
        model=None if data["robot_model"] is None else robot_model_from_data(data["robot_model"], file=file),
        link_twists=_array(data["link_twists"]).reshape(-1, 6),
        terms=tuple(_term(_mapping(t)) for t in _sequence(data["robot_terms"])),
        terms_rad=np.array([float(_array(_mapping(t)["coefficient_rad"])) for t in _sequence(data["robot_terms"])]),
        flange_from_camera=_rigid(data["flange_from_camera"], file, "flange_from_camera"),
        camera_error=camera_error_from_settings(model_settings, file=file),
        camera_mm=_array(camera["coefficients_mm"]),
        camera_seen_volume_mm=_array(camera["seen_volume_mm"]),
        radius_offset_mm=float(_array(data["radius_offset_mm"])),
        sphere_centres_in_base_mm={name: _array(sphere["centre_in_base_mm"]) for name, sphere in spheres.items()},
        sphere_radius_offsets_mm={name: float(_array(sphere["radius_offset_mm"])) for name, sphere in spheres.items()},
        datum=_datum(datum, file),
        seen_joints_rad=None if data["seen_axis_ranges_rad"] is None else _array(data["seen_axis_ranges_rad"]),
        noise=NoiseModel(**{key: float(_array(value)) for key, value in _mapping(data["noise"]).items()}),
        parameter_names=tuple(str(name) for name in _sequence(parameters["names"])),
        covariance=_from_rows(parameters["covariance_rows"]),
        statistics=Statistics(**{**_mapping(data["statistics"]), "seconds": 0.0}),  # type: ignore[arg-type]
        limits=None if limits is None else Limits.model_validate(limits),
        verdict=str(data["verdict"]),
        reasons=tuple(str(reason) for reason in _sequence(data["reasons"])),
        shots=tuple(_shot(_mapping(shot)) for shot in _sequence(data["shots"])),
        rejected=tuple(RejectedShot(str(r["session"]), int(str(r["index"])), str(r["reason"])) for r in map(_mapping, _sequence(data["rejected"]))),
        cell_name=str(data["cell"]),
        inputs=_mapping(data["inputs"]),
        identity=_mapping(data["identity"]),
        created_utc=str(data["created_utc"]),
        software=str(data["software"]),
        hand_eye=_hand_eye(data.get("hand_eye", "calibrated")),
        external=None if data.get("external") is None else external_from_data(_mapping(data["external"])),
        # sections that files of older versions lack
        temperatures_c={name: _pair(seen) for name, seen in _mapping(data.get("temperatures_c", {})).items()},
        identifiability=None if data.get("identifiability") is None else Identifiability.from_json_dict(_mapping(data["identifiability"])),
        next_best_poses=tuple(_pose(_mapping(pose)) for pose in _sequence(data.get("next_best_poses", []))),
        seen_cells=seen_cells_from_data(camera["seen_cells"], _array(camera["seen_volume_mm"])) if "seen_cells" in camera else None,
        error_budget=None if data.get("error_budget") is None else ErrorBudget.from_json_dict(_mapping(data["error_budget"])),
    )


def _datum_data(datum: Datum) -> dict[str, object]:
    data: dict[str, object] = {
        "kind": datum.kind,
        "base_from_solver": datum.base_from_solver,
        "reference_joints_rad": _rows(datum.references.joints_rad),
        "reference_points_in_flange_mm": datum.references.points_in_flange_mm,
    }
    if datum.like:
        data["like"] = datum.like
    if datum.motion is not None and datum.noise is not None:
        data |= {"spheres": list(datum.spheres), "motion_rows": _rows(datum.motion), "noise_rows": _rows(datum.noise)}
    return data


def _datum(data: Mapping[str, object], file: str) -> Datum:
    # older files compared the flange's own corners
    points = _array(data["reference_points_in_flange_mm"]) if "reference_points_in_flange_mm" in data else CORNERS_MM
    base_from_solver = _rigid(data["base_from_solver"], file, "datum.base_from_solver")
    references = References(_from_rows(data["reference_joints_rad"]), points.reshape(-1, 3))
    motion, noise = (_from_rows(data[key]) if key in data else None for key in ("motion_rows", "noise_rows"))
    spheres = tuple(str(name) for name in _sequence(data.get("spheres", [])))
    return Datum(str(data["kind"]), base_from_solver, references, str(data.get("like", "")), spheres, motion, noise)


def _hand_eye(value: object) -> str:
    if value not in ("calibrated", "cell", "none"):
        raise ValueError(f"unknown hand_eye {value!r}")
    return str(value)


def _pose(data: Mapping[str, object]) -> PlannedPose:
    return PlannedPose(str(data["id"]), str(data["sphere"]), _array(data["joints_rad"]))


def _term(data: Mapping[str, object]) -> RobotTerm:
    match data["kind"]:
        case "compliance" | "sine" | "cosine" | "tangent" | "secant" as kind:
            return RobotTerm(kind, int(str(data["axis"])) - 1, int(str(data["order"])), data.get("estimated") is True)
        case other:
            raise ValueError(f"unknown robot term {other!r}")


def _shot_data(shot: ShotResult) -> dict[str, object]:
    data = {name: getattr(shot, name) for name in shot.__slots__}
    return {name: value for name, value in data.items() if value is not None or name not in _OF_POSES}


def _shot(data: Mapping[str, object]) -> ShotResult:
    centre = data["centre_in_base_mm"]
    predicted = data["predicted_error_mm"]
    return ShotResult(
        session=str(data["session"]),
        index=int(str(data["index"])),
        sphere=str(data["sphere"]),
        scan_sha256=str(data["scan_sha256"]),
        n_points=int(str(data["n_points"])),
        point_rms_mm=float(_array(data["point_rms_mm"])),
        radial_rms_mm=float(_array(data["radial_rms_mm"])),
        centre_in_camera_mm=_array(data["centre_in_camera_mm"]),
        centre_in_base_mm=None if centre is None else _array(centre),
        predicted_error_mm=None if predicted is None else float(_array(predicted)),
        joints_rad=_array(data["joints_rad"]) if "joints_rad" in data else None,
        base_from_flange=_array(data["base_from_flange"]) if "base_from_flange" in data else None,
    )


def _rows(matrix: FloatArray) -> list[str]:
    """One text per row: a covariance as lists of numbers would fill a thousand lines and take a second to read."""
    return [" ".join(repr(float(value)) for value in row) for row in matrix]


def _from_rows(rows: object) -> FloatArray:
    matrix = [[float(value) for value in str(row).split()] for row in _sequence(rows)]
    return np.array(matrix, dtype=np.float64) if matrix else np.zeros((0, 0))


def _plain(value: object) -> dict[str, object]:
    """JSON-ready data; numbers that are not finite become null."""
    return {str(key): _plain_value(item) for key, item in value.items()} if isinstance(value, Mapping) else {}


def _plain_value(value: object) -> object:
    if isinstance(value, Mapping):
        return _plain(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain_value(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _array(value: object) -> FloatArray:
    if value is None:
        raise ValueError("null where a number is needed")
    return np.asarray(value, dtype=np.float64)


def _rigid(value: object, file: str, where: str) -> FloatArray:
    transform = _array(value)
    if not se3.is_rigid(transform):
        raise FileError("is no rigid transform", file=file, where=where, remedy="Calibrate again to write a whole file.")
    return transform


def _pair(value: object) -> tuple[float, float]:
    low, high = _array(value)
    return float(low), float(high)


def _mapping(value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise TypeError(f"{type(value).__name__} where keys are needed")
    return value


def _sequence(value: object) -> Sequence[object]:
    if not isinstance(value, list):
        raise TypeError(f"{type(value).__name__} where a list is needed")
    return value
