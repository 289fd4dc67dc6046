"""A machined part that is not quite its drawing, measured by a simulated calibrated cell; and the truth to compare with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquire.cell import Cell
from acquire.poses import PoseLaw, workpiece_poses
from acquire.session import SessionWriter
from acquire.visibility import camera_view
from calibrate.result import Calibration
from drivers.files.session import Session, read_session
from drivers.kinematics import se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.cell import SimulatedCell
from drivers.simulated.draws import PAPER_FLANGE_FROM_CAMERA, transform_rows
from drivers.simulated.truth import Truth, WorkpieceTruth
from drivers.simulated.workpiece_machined import MachinedPart
from measure.inspecting.cloud import MeasuredCloud
from measure.inspecting.geometry import Element
from measure.inspecting.nominal import Nominal
from measure.inspecting.spec import InspectionSpec
from measure.inspecting.views import View, thinned

PLACE_IN_BASE_MM = (880.0, 20.0, 180.0)
PLANES = {
    "top": {"kind": "plane", "centre_mm": [-17.5, 0, 40], "normal": [0, 0, 1], "size_mm": [125, 100], "direction": [1, 0, 0]},
    "step": {"kind": "plane", "centre_mm": [62.5, 0, 58], "normal": [0, 0, 1], "size_mm": [35, 100], "direction": [1, 0, 0]},
    "boss_top": {"kind": "plane", "centre_mm": [62.5, 0, 70], "normal": [0, 0, 1], "size_mm": [14, 14]},
    "riser": {"kind": "plane", "centre_mm": [45, 0, 49], "normal": [-1, 0, 0], "size_mm": [100, 18], "direction": [0, 1, 0]},
}
ROUND = {
    "bore": {"kind": "cylinder", "centre_mm": [-57.5, 0, 29], "axis": [0, 0, 1], "diameter_mm": 20, "length_mm": 12, "hole": True},
    "large_bore": {"kind": "cylinder", "centre_mm": [-12.5, 0, 32], "axis": [0, 0, 1], "diameter_mm": 30, "length_mm": 16, "hole": True},
    "boss": {"kind": "cylinder", "centre_mm": [62.5, 0, 64], "axis": [0, 0, 1], "diameter_mm": 22, "length_mm": 12},
    "sink": {
        "kind": "cone",
        "centre_mm": [-57.5, 0, 37.5],
        "axis": [0, 0, 1],
        "diameter_mm": 25,
        "angle_deg": 90,
        "length_mm": 5,
        "hole": True,
        "keep_from_edges_mm": 1.0,
    },
    "slot": {
        "kind": "slot",
        "centre_mm": [27.5, 0, 34],
        "axis": [0, 0, 1],
        "direction": [0, 1, 0],
        "width_mm": 12,
        "length_mm": 40,
        "depth_mm": 4,
    },
    "bore_circle": {"kind": "circle", "centre_mm": [-12.5, 0, 33], "axis": [0, 0, 1], "diameter_mm": 30, "depth_mm": 3},
}
PAIRS = [("top", "step"), ("top", "boss_top"), ("bore", "large_bore"), ("bore", "boss"), ("large_bore", "slot"), ("riser", "large_bore")]
PAIRS += [("bore", "riser"), ("slot", "boss")]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPart:
    """Scans of a part, and what it truly is."""

    part: MachinedPart
    base_from_part: FloatArray
    scans: tuple[FloatArray, ...]
    """(n, 3) finite points in the camera."""
    joints_rad: FloatArray
    grids_mm: tuple[NDArray[np.float32], ...] = ()
    """(h, w, 3) the scans as the camera gave them, flying pixels and all."""

    def session(self, folder: Path, cell: Cell) -> Session:
        """The scans on disk, as a capture leaves them."""
        with SessionWriter.create(folder, purpose="workpiece", cell=cell) as writer:
            for joints, grid in zip(self.joints_rad, self.grids_mm, strict=True):
                writer.append(joints_rad=joints, xyz_mm=grid)
        return read_session(folder)

    @property
    def views(self) -> list[View]:
        """Thinned as `views_of` does it."""
        pairs = zip(self.scans, self.joints_rad, strict=True)
        return [View(thinned(points), joints, None) for points, joints in pairs]

    def cloud(self, calibration: Calibration, voxel_mm: float = 0.5) -> MeasuredCloud:
        """The stitched cloud, by a slow reference of the voxel fusion."""
        pairs = zip(self.scans, self.joints_rad, strict=True)
        points = np.concatenate([calibration.points_in_base_mm(points, joints_rad=joints) for points, joints in pairs])
        return measured_cloud(*voxel_means(points, voxel_mm), voxel_mm=voxel_mm)


def voxel_means(points_mm: FloatArray, voxel_mm: float) -> tuple[FloatArray, FloatArray]:
    """(m, 3) one mean point per voxel, and (m,) how many points it stands for."""
    cells = np.floor(points_mm / voxel_mm).astype(np.int64)
    cells -= cells.min(axis=0)
    spans = cells.max(axis=0) + 1
    _, label = np.unique((cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2], return_inverse=True)
    count = np.bincount(label)
    return np.column_stack([np.bincount(label, points_mm[:, i]) for i in range(3)]) / count[:, None], count.astype(np.float64)


def supported(xyz_mm: FloatArray, *, max_steps: float = 6.0, min_neighbours: int = 6) -> NDArray[np.bool_]:
    """(h, w) points of a scan (h, w, 3) with enough of their 8 neighbours near them: what cleaning its edges leaves."""
    with np.errstate(invalid="ignore", divide="ignore"):
        step = float(np.nanmedian(np.diff(xyz_mm[..., 0] / xyz_mm[..., 2], axis=1)))
        padded = np.pad(xyz_mm, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        count = np.zeros(xyz_mm.shape[:2], dtype=np.int64)
        for dv, du in ((i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)):
            other = padded[dv : dv + xyz_mm.shape[0], du : du + xyz_mm.shape[1]]
            count += np.linalg.norm(other - xyz_mm, axis=2) < max_steps * step * xyz_mm[..., 2]
    return np.asarray(count >= min_neighbours)


def measured_cloud(
    points_mm: FloatArray, count: FloatArray | None = None, *, voxel_mm: float | None = None, sigma_mm: float | None = None
) -> MeasuredCloud:
    """Points as `load_cloud` would hand them over."""
    weights = np.ones(len(points_mm)) if count is None else count
    return MeasuredCloud(Path("cloud.ply"), points_mm, None, weights, sigma_mm, None, None, voxel_mm, ())


def nominal_of(part: MachinedPart, segments: int = 360) -> Nominal:
    """The mesh of a part as it is drawn."""
    vertices, faces = part.mesh(segments)
    return Nominal(Path("part.stl"), "0" * 64, vertices, faces.astype(np.int64), ())


def drawn_spec(**changes: object) -> InspectionSpec:
    """Everything of the drawing, nothing judged."""
    data = {"format": "spherecal-inspection/1", "features": {**PLANES, **ROUND}, **changes}
    return InspectionSpec.model_validate(data)


def random_part(rng: np.random.Generator) -> MachinedPart:
    """A part whose dimensions are off by some tenths."""
    names = ("bore_radius_mm", "sink_radius_mm", "large_bore_radius_mm", "slot_width_mm", "slot_length_mm")
    off = dict(zip((*names, "step_height_mm", "boss_radius_mm", "boss_height_mm"), rng.normal(0, 0.1, 8), strict=True))
    drawn = MachinedPart()
    centres = {
        name: tuple(float(c) for c in np.array(getattr(drawn, name)) + rng.normal(0, 0.1, 2))
        for name in ("bore_centre_mm", "large_bore_centre_mm", "slot_centre_mm", "boss_centre_mm")
    }
    return replace(drawn, **{name: getattr(drawn, name) + float(value) for name, value in off.items()}, **centres)  # type: ignore[arg-type]


def true_elements(part: MachinedPart) -> Mapping[str, Element]:
    """The features as they truly are, at the places where the drawing asks."""
    z = np.array([0.0, 0, 1])
    flat = {"top": (-17.5, 0, 40), "step": (62.5, 0, part.step_height_mm), "boss_top": (62.5, 0, part.step_height_mm + part.boss_height_mm)}
    found = {name: Element("plane", np.array(place, dtype=float), z) for name, place in flat.items()}
    found["riser"] = Element("plane", np.array([45.0, 0, 49]), np.array([-1.0, 0, 0]))

    def standing(centre: tuple[float, float], height: float) -> FloatArray:
        return np.array([*centre, height])

    found["bore"] = Element("cylinder", standing(part.bore_centre_mm, 29), z, 2 * part.bore_radius_mm)
    found["large_bore"] = Element("cylinder", standing(part.large_bore_centre_mm, 32), z, 2 * part.large_bore_radius_mm)
    found["bore_circle"] = Element("circle", standing(part.large_bore_centre_mm, 33), z, 2 * part.large_bore_radius_mm)
    found["boss"] = Element("cylinder", standing(part.boss_centre_mm, 64), z, 2 * part.boss_radius_mm)
    slope = (part.sink_radius_mm - part.bore_radius_mm) / part.sink_depth_mm
    diameter = 2 * (part.sink_radius_mm - 2.5 * slope)
    found["sink"] = Element("cone", standing(part.bore_centre_mm, 37.5), z, diameter, angle_deg=float(2 * np.degrees(np.arctan(slope))))
    found["slot"] = Element("slot", standing(part.slot_centre_mm, 34), z, None, part.slot_width_mm, part.slot_length_mm)
    return found


def measure_part(
    truth: Truth, model: RobotModel, folder: Path, rng: np.random.Generator, *, n_views: int = 12, resolution_px: tuple[int, int] = (640, 400)
) -> MeasuredPart:
    """Put a random part into a cell and scan it; the truth's spheres stay away."""
    import trimesh

    part = random_part(rng)
    vertices, faces = part.mesh(720)
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "part.stl")
    base_from_part = se3.from_rotation_translation(se3.exp_so3([0.0, 0.0, float(rng.uniform(-0.5, 0.5))]), PLACE_IN_BASE_MM)
    camera = replace(truth.camera, resolution_px=resolution_px)
    workpiece = WorkpieceTruth(transform_rows(base_from_part), mesh="part.stl")
    cell = SimulatedCell(replace(truth, camera=camera, workpiece=workpiece, spheres={}), model, folder=folder)
    joints = _poses(cell, model, base_from_part, n_views, rng)
    eye = SimulatedCamera(cell)
    eye.open()
    scans, grids = [], []
    for q in joints:
        cell.start_motion(q, speed_rad_s=1.0)
        cell.advance(60.0)
        grids.append(eye.capture(timeout_s=10.0).xyz_mm)
        grid = grids[-1].astype(np.float64)
        scans.append(grid[supported(grid)])
    return MeasuredPart(part, base_from_part, tuple(scans), joints, tuple(grids))


def _poses(cell: SimulatedCell, model: RobotModel, base_from_part: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    from acquire.cell import CameraSection

    section = CameraSection.model_validate({"driver": "simulated", "working_range_mm": [250, 430], "field_of_view_deg": [55, 36]})
    corners = se3.apply(base_from_part, np.array([[x, y, z] for x in (-80, 80) for y in (-50, 50) for z in (0, 70)], dtype=float))
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    law = PoseLaw(floor_mm=-500.0)
    pool = workpiece_poses(model, np.array(PAPER_FLANGE_FROM_CAMERA), camera_view(section), box, n, rng, law=law)
    return pool.joints_rad
