"""A sphere that the calibration never saw, of another diameter and surface, at another place, scanned and inspected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquire.poses import PoseLaw, sphere_candidates
from acquire.visibility import camera_view
from calibrate.result import Calibration
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA
from drivers.simulated.truth import SphereTruth
from measure.inspecting.features import PartCloud, fit_feature
from measure.inspecting.fitting import Fit, Response
from measure.inspecting.geometry import element_of
from measure.inspecting.quantities import Model, own_quantities
from measure.inspecting.spec import SphereFeature
from measure.inspecting.uncertainty import joint_covariance, residual_covariances
from measure.inspecting.views import View, seen_field
from tests.support.machined import supported, voxel_means
from tests.support.volume import VolumeCell

DIAMETER_MM = 50.0
OFFSET_MM = 0.06
PLACE_MM = (960.0, 150.0, 380.0)
_CAP_COSINE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ForeignSphere:
    """What an inspection found of it, and what is true."""

    diameter_error_mm: float
    """Of the surface that is seen."""
    diameter_u_mm: float
    """Expanded, k = 2."""
    place_error_mm: FloatArray
    """(3,) after the calibration's base was laid onto the true one by the calibration's own spheres."""
    place_u_mm: FloatArray
    radial_rms_mm: float
    """Of all raw points of all views."""
    sensor_sigma_mm: float
    """Of the same points: what noise along the rays makes of radial residuals."""
    field_sigma_mm: float
    """Stated error of a point's coordinate."""


def measured_sphere(volume: VolumeCell, calibration: Calibration, rng: np.random.Generator, *, n_views: int = 12) -> ForeignSphere:
    """Scan the sphere from 12 poses, stitch, fit."""
    truth = volume.simulated.truth
    sphere = SphereTruth(PLACE_MM, DIAMETER_MM, optical_offset_mm=OFFSET_MM)
    camera = replace(truth.camera, resolution_px=(320, 200))
    cell = SimulatedCell(replace(truth, camera=camera, spheres={"S": sphere}), volume.model)
    view, centre = camera_view(volume.cell.camera), np.array(PLACE_MM)
    pool = sphere_candidates(
        volume.model, np.array(PAPER_FLANGE_FROM_CAMERA), centre, DIAMETER_MM / 2, view, 40 * n_views, rng, law=PoseLaw(floor_mm=-200.0)
    )
    _, first = np.unique(pool.view, return_index=True)
    joints = pool.joints_rad[rng.permutation(first)[:n_views]]
    scans = [_scan(cell, q) for q in joints]
    in_base = [calibration.points_in_base_mm(points, joints_rad=q) for points, q in zip(scans, joints, strict=True)]
    found = np.concatenate(in_base)
    voxels, count = voxel_means(found, 0.5)
    feature = SphereFeature.model_validate(
        {"kind": "sphere", "centre_mm": tuple(np.median(found, axis=0) - [0, 0, DIAMETER_MM / 3]), "diameter_mm": DIAMETER_MM, "search_mm": 8.0}
    )
    fit = fit_feature("S", feature, PartCloud(voxels, None, count, 0.5), {})
    element = element_of(feature, fit.shape, fit.params)
    values = _values(feature, fit, calibration, [View(p, q, None) for p, q in zip(scans, joints, strict=True)])
    radial = np.linalg.norm(found - element.point_mm, axis=1) - (element.diameter_mm or 0.0) / 2
    sight = [se3.apply(calibration.base_from_flange(q) @ calibration.flange_from_camera, np.zeros(3)) for q in joints]
    cosine = np.concatenate([_cosine(points, eye, element.point_mm) for points, eye in zip(in_base, sight, strict=True)])
    return ForeignSphere(
        diameter_error_mm=(element.diameter_mm or 0.0) - 2 * sphere.seen_radius_mm,
        diameter_u_mm=values["diameter"],
        place_error_mm=se3.apply(_true_from_calibrated(volume, calibration), element.point_mm) - centre,
        place_u_mm=np.array([values[axis] for axis in "xyz"]),
        radial_rms_mm=float(np.sqrt(np.mean(radial**2))),
        sensor_sigma_mm=float(camera.range_noise_mm * np.sqrt(np.mean(cosine**2))),
        field_sigma_mm=values["field"],
    )


def _scan(cell: SimulatedCell, joints_rad: FloatArray) -> FloatArray:
    cell.start_motion(joints_rad, speed_rad_s=1.0)
    cell.advance(60.0)
    eye = SimulatedCamera(cell)
    eye.open()
    grid = eye.capture(timeout_s=10.0).xyz_mm.astype(np.float64)
    return np.asarray(grid[supported(grid, min_neighbours=8)])


def _cosine(points: FloatArray, eye: FloatArray, centre: FloatArray) -> FloatArray:
    normal, ray = points - centre, points - eye
    return np.asarray(np.einsum("ni,ni->n", normal, ray) / np.linalg.norm(normal, axis=1) / np.linalg.norm(ray, axis=1))


def _values(feature: SphereFeature, fit: Fit, calibration: Calibration, views: Sequence[View]) -> dict[str, float]:
    """Expanded uncertainties by name, and the field's standard deviation."""
    responses: list[Response] = [fit.response]
    field = seen_field(calibration, views, responses, np.eye(4))
    covariance = joint_covariance(responses, residual_covariances([fit], responses, field), field, 0.0)
    model = Model({"S": feature}, {"S": fit})
    quantities = own_quantities("S", model.nominal(["S"])["S"])
    found = {quantity.name: 2 * model.measure(quantity, covariance).standard_uncertainty for quantity in quantities}
    return {**found, "field": field.point_sigma_mm()}


def _true_from_calibrated(volume: VolumeCell, calibration: Calibration) -> FloatArray:
    """The calibration's base is defined by its datum: the calibration's own spheres lay it onto the true one."""
    names = list(calibration.sphere_centres_in_base_mm)
    there = np.stack([calibration.sphere_centres_in_base_mm[name] for name in names])
    true = np.array([volume.simulated.truth.spheres[name].centre_in_base_mm for name in names])
    return se3.fit_rigid(there, true)
