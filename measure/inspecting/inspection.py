"""The inspection itself: cloud, nominal and spec in, verdict out; the deviation map after it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.errors import DataError
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from measure.gauge.correlation import Correlation
from measure.inspecting.alignment import BestFit, best_fit, datum_alignment
from measure.inspecting.cloud import MeasuredCloud
from measure.inspecting.distance import NominalSurface
from measure.inspecting.features import PartCloud, fit_feature, place_feature, shape_of
from measure.inspecting.fitting import Fit, Response
from measure.inspecting.form import Form, form_of, with_form
from measure.inspecting.geometry import element_of, nominal_element
from measure.inspecting.judging import Judging, check_result, feature_result, verdict_of
from measure.inspecting.nominal import Nominal
from measure.inspecting.quantities import Model, require_checks_fit
from measure.inspecting.region import WIDER
from measure.inspecting.result import AlignmentResult, CheckResult, DeviationMap, Inspection
from measure.inspecting.spec import InspectionSpec, ProfileCheck
from measure.inspecting.uncertainty import FieldError, JointCovariance, StatedField, UnknownField, joint_covariance, residual_covariances
from measure.inspecting.units import require_features_on, require_likely_units
from measure.inspecting.views import FieldSource

_DATUM_ROUNDS = 3
_FEWEST_OF_PART = 100


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """The cloud in the frame of the nominal."""

    cloud: PartCloud
    part_from_base: FloatArray
    fitted: BestFit | None = None


def inspect_cloud(
    cloud: MeasuredCloud,
    nominal: Nominal,
    spec: InspectionSpec,
    *,
    field_source: FieldSource | None = None,
    with_map: bool = True,
    correlation: Correlation | None = None,
    judge_corrected: bool = False,
) -> Inspection:
    """Align, fit, judge; then map the deviations.

    Args:
        cloud: measured points, base frame.
        nominal: mesh of the part.
        spec: features, alignment, tolerances.
        field_source: what is known of the cloud's common errors; from the cloud or the spec where None.
        with_map: whether deviations are wanted though no check asks for them.
        correlation: offsets to a reference gauge, by the names of checks; shown beside the raw values.
        judge_corrected: whether checks that it names are judged by the corrected value.

    Raises:
        DataError: nothing of the cloud lies on the part, or it cannot be aligned.
        FileError: a check asks for what its feature does not have.
        SettingsError: the datums fix no frame.
    """
    began = time.perf_counter()
    require_likely_units(cloud, nominal)
    require_features_on(nominal, spec)
    require_checks_fit(spec, {name: shape_of(feature) for name, feature in spec.features.items()})
    profile = any(isinstance(check, ProfileCheck) for check in spec.checks)
    surface = NominalSurface.of(nominal) if profile or spec.alignment.method == "best_fit" else None
    aligned = _align(cloud, spec, surface)
    fits, problems = _fit_all(spec, aligned.cloud)
    model = Model(spec.features, fits, _datums(spec), has_pose=aligned.fitted is not None)
    forms = {name: form_of(fit) for name, fit in fits.items()}
    responses = [*(with_form(fit.response, forms[name]) for name, fit in fits.items()), *([aligned.fitted.response] if aligned.fitted else [])]
    field = _field(cloud, spec, field_source, responses, aligned.part_from_base)
    covariance, sigmas = _covariances(responses, fits, forms, aligned.fitted, field, spec)
    alignment = _alignment_result(spec, aligned, model, covariance)
    deviations = _deviations(cloud, surface, alignment.part_from_base, spec) if surface is not None and profile else None
    judged = {name: (form.form_mm, sigmas[name]) for name, form in forms.items()}
    judging = Judging(model, covariance, judged, problems, deviations, field.point_sigma_mm(), correlation, judge_corrected)
    features = tuple(feature_result(name, judging) for name in spec.features)
    checks = tuple(check_result(number, spec, judging) for number in range(len(spec.checks)))
    verdict, reasons = verdict_of(checks, spec, field, judging)
    found = Inspection(
        name=spec.name,
        verdict=verdict,
        reasons=reasons,
        alignment=alignment,
        features=features,
        checks=checks,
        n_points=len(cloud.points_mm),
        calibration_id=cloud.calibration_id,
        field_words=field.words,
        inputs={
            "cloud": cloud.file,
            "nominal": nominal.file,
            "nominal_sha256": nominal.sha256,
            "session": cloud.session_digest,
            **_named(correlation),
        },
        notes=(*cloud.notes, *nominal.notes, *_on_correlation(correlation, checks)),
        seconds_to_verdict=time.perf_counter() - began,
        deviations=deviations,
        feature_points_in_part_mm={name: aligned.cloud.points_mm[fit.rows] for name, fit in fits.items()},
    )
    return with_deviations(found, cloud, nominal, spec, surface) if with_map else found


def with_deviations(
    inspection: Inspection, cloud: MeasuredCloud, nominal: Nominal, spec: InspectionSpec, surface: NominalSurface | None = None
) -> Inspection:
    """The same inspection with its map of deviations, which no verdict waits for unless a check asks for it.

    Args:
        inspection: as `inspect_cloud` gave it.
        cloud: the same.
        nominal: the same.
        spec: the same.
        surface: of the nominal, where it is ready.

    Raises:
        DataError: nothing of the cloud lies on the part.
    """
    if inspection.deviations is not None:
        return inspection
    mapped = _deviations(cloud, surface or NominalSurface.of(nominal), inspection.alignment.part_from_base, spec)
    return replace(inspection, deviations=mapped)


def _align(cloud: MeasuredCloud, spec: InspectionSpec, surface: NominalSurface | None) -> _Aligned:
    base_from_part = np.eye(4) if spec.alignment.base_from_part is None else np.asarray(spec.alignment.base_from_part)
    part_from_base = se3.inverse(base_from_part)
    placed = PartCloud(cloud.points_mm, cloud.normals, cloud.weights, cloud.voxel_mm or 0.0).moved(part_from_base)
    if spec.alignment.method == "best_fit" and surface is not None:
        fitted = best_fit(surface, placed)
        return _Aligned(placed.moved(fitted.new_from_part), fitted.new_from_part @ part_from_base, fitted)
    if spec.alignment.method == "datums":
        for number in range(_DATUM_ROUNDS):
            moved = _datum_step(spec, placed, WIDER if number == 0 else 1.0)
            placed, part_from_base = placed.moved(moved), moved @ part_from_base
    return _Aligned(placed, part_from_base)


def _datums(spec: InspectionSpec) -> tuple[str, ...]:
    named = (spec.alignment.primary, spec.alignment.secondary, spec.alignment.tertiary)
    return tuple(name for name in named if name is not None)


def _datum_step(spec: InspectionSpec, cloud: PartCloud, wider: float) -> FloatArray:
    names = _datums(spec)
    measured, drawn = {}, {}
    for name in names:
        feature = spec.features[name]
        searched = feature.model_copy(update={"search_mm": feature.search_mm * wider})
        shape, params = place_feature(name, searched, cloud, spec.features)
        measured[name] = element_of(feature, shape, params)
        drawn[name] = nominal_element(feature, shape)
    return datum_alignment(names, measured, drawn)


def _fit_all(spec: InspectionSpec, cloud: PartCloud) -> tuple[dict[str, Fit], dict[str, str]]:
    fits: dict[str, Fit] = {}
    problems: dict[str, str] = {}
    for name, feature in spec.features.items():
        try:
            fit = fit_feature(name, feature, cloud, spec.features)
            # the camera sees the surface farther out by the known offset than it is
            fits[name] = replace(fit, params=fit.params - fit.response.outward * spec.surface.offset_mm)
        except DataError as error:
            if name in _datums(spec):
                raise
            problems[name] = f"{error.message}. {error.remedy or ''}".strip()
    return fits, problems


def _field(
    cloud: MeasuredCloud, spec: InspectionSpec, source: FieldSource | None, responses: Sequence[Response], part_from_base: FloatArray
) -> FieldError:
    if not responses:
        return UnknownField()
    if source is not None:
        return source(responses, part_from_base)
    if cloud.standard_uncertainty_mm is not None:
        words = f"the cloud's own uncertainty, {cloud.standard_uncertainty_mm:.3f} mm (k = 1) at a typical point, taken as shared by whole regions"
        return StatedField(cloud.standard_uncertainty_mm, words)
    if spec.point_expanded_uncertainty_mm is not None:
        words = f"point_expanded_uncertainty_mm {spec.point_expanded_uncertainty_mm:g} of the inspection file"
        return StatedField(spec.point_expanded_uncertainty_mm / 2, words)
    return UnknownField()


def _covariances(
    responses: Sequence[Response], fits: Mapping[str, Fit], forms: Mapping[str, Form], fitted: BestFit | None, field: FieldError, spec: InspectionSpec
) -> tuple[JointCovariance, dict[str, float]]:
    """Of all parameters together, and the standard uncertainty of every form, which stand behind each other in the responses."""
    from scipy.linalg import block_diag

    if not responses:
        return JointCovariance(np.zeros((0, 0)), (np.zeros((0, 0)),), np.zeros(0)), {}
    own = residual_covariances(list(fits.values()), responses, field)
    blocks = [block_diag(covariance, np.array([[forms[name].noise_variance_mm2]])) for name, covariance in zip(fits, own, strict=True)]
    blocks += [fitted.covariance] if fitted else []
    everything = joint_covariance(responses, blocks, field, spec.surface.expanded_uncertainty_mm / 2)
    at_form = np.cumsum([len(fit.params) + 1 for fit in fits.values()], dtype=np.int64) - 1
    rows = np.eye(len(everything.by_surface))
    sigmas = {name: float(np.sqrt(everything.of(rows[[at]])[0, 0])) for name, at in zip(forms, at_form, strict=True)}
    return everything.of_rows(np.delete(np.arange(len(rows)), at_form)), sigmas


def _deviations(cloud: MeasuredCloud, surface: NominalSurface, part_from_base: FloatArray, spec: InspectionSpec) -> DeviationMap:
    points = se3.apply(part_from_base, cloud.points_mm)
    reach_mm = spec.deviation_limit_mm + abs(spec.surface.offset_mm) + 1e-6
    low, high = surface.nominal.box_mm
    # what lies outside of this box is farther from the mesh than the limit: a table costs nothing
    rows = np.flatnonzero(((points >= low - reach_mm) & (points <= high + reach_mm)).all(axis=1))
    near = surface.nearest(points[rows])
    signed = near.signed_mm - spec.surface.offset_mm
    among = (np.abs(signed) <= spec.deviation_limit_mm) & ~near.at_border
    kept = rows[among]
    if len(kept) < _FEWEST_OF_PART:
        raise DataError(
            f"{len(kept)} of {len(points)} points lie within {spec.deviation_limit_mm:g} mm of the nominal",
            file=cloud.file,
            remedy="Give alignment.base_from_part, or align by best_fit or datums; see that cloud and nominal are of one part, in mm.",
        )
    normal = near.normal[among].mean(axis=0)
    length = float(np.linalg.norm(normal))
    facing = normal / length if length > 0.05 else np.array([0.0, 0.0, 1.0])  # seen from all sides
    return DeviationMap(points[kept], cloud.points_mm[kept], signed[among], len(points) - len(kept), spec.deviation_limit_mm, facing)


def _alignment_result(spec: InspectionSpec, aligned: _Aligned, model: Model, covariance: JointCovariance) -> AlignmentResult:
    part_from_base = model.alignment() @ aligned.part_from_base
    if aligned.fitted is None:
        return AlignmentResult(spec.alignment.method, part_from_base)
    middle = aligned.cloud.points_mm.mean(axis=0)
    gradient = np.zeros((6, len(model.params)))
    gradient[:, -6:] = np.eye(6)
    gradient[:3, -3:] = -se3.hat(middle)
    sigma = np.sqrt(np.maximum(np.diag(covariance.of(gradient)), 0.0))
    return AlignmentResult("best_fit", part_from_base, aligned.fitted.rms_mm, 2 * sigma[:3], 2 * sigma[3:])


def _named(correlation: Correlation | None) -> dict[str, object]:
    return {} if correlation is None else {"correlation": f"{correlation.id[:12]}, version {correlation.version}"}


def _on_correlation(correlation: Correlation | None, checks: Sequence[CheckResult]) -> list[str]:
    """What a person should know of it."""
    if correlation is None:
        return []
    missing = [name for name in correlation.offsets if name not in {check.name for check in checks}]
    notes = [f"the correlation names {', '.join(missing)}, which no tolerance of this inspection is called"] if missing else []
    bent = [check.name for check in checks if check.corrected is not None and not check.corrected.slope_is_one]
    if bent:
        notes.append(
            f"{', '.join(bent)}: the reference gauge sees other differences between parts than spherecal (slope not 1), which no offset cures"
        )
    return notes
