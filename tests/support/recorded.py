"""Sessions on disk by the independent little simulator, and the system that knows its truth."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from acquire.cell import Cell, Limits, load_cell
from acquire.session import SessionWriter
from drivers.files.session import Session, read_session
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import PAPER_FLANGE_FROM_CAMERA, SyntheticCell, draw_shot, paper_cell

PLACES = {"A": (900.0, 100.0, 300.0), "B": (820.0, -250.0, 380.0)}
LIMITS = {"centre_rms_mm": 0.2, "length_error_mm": 0.2, "diameter_error_mm": 0.1, "form_mm": 0.5}


@dataclass(frozen=True)
class TrainedOn:
    """A shot that a system was made from."""

    scan_sha256: str


@dataclass(frozen=True)
class TrueSystem:
    """A measuring system that knows the synthetic cell's truth."""

    cell: SyntheticCell
    pose_only: bool = False
    id: str = "0" * 64
    radius_offset_mm: float = 0.0
    limits: Limits | None = None
    shots: tuple[TrainedOn, ...] = ()
    sigma_of_scale: float = 3e-5
    sigma_of_radius_mm: float = 0.0

    @property
    def model(self) -> RobotModel | None:
        return None if self.pose_only else self.cell.nominal

    def points_in_base_mm(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        points = np.array(points_in_camera_mm, dtype=np.float64)
        # a point's error is taken where it is measured: 1e-3 mm of the true place at these slopes
        points[:, 2] -= self.cell.camera_error_mm(points)
        flange = mdh.base_from_flange(self.cell.true, joints_rad) if joints_rad is not None else np.asarray(base_from_flange)
        return se3.apply(flange @ self.cell.flange_from_camera, points)

    @property
    def covariance(self) -> FloatArray:
        """Of the scale of the base, a shift of it along x in mm, and the radius offset."""
        return np.diag([self.sigma_of_scale**2, 1.0, self.sigma_of_radius_mm**2])

    def point_jacobian(
        self, points_in_camera_mm: ArrayLike, *, joints_rad: ArrayLike | None = None, base_from_flange: ArrayLike | None = None
    ) -> FloatArray:
        points = self.points_in_base_mm(points_in_camera_mm, joints_rad=joints_rad, base_from_flange=base_from_flange)
        return np.stack([points, np.tile([1.0, 0, 0], (len(points), 1))], axis=-1)


def write_cell(folder: Path, places: dict[str, tuple[float, float, float]] = PLACES, *, limits: bool = True, kind: str = "area") -> Cell:
    """A cell file with spheres at places and every certified length between neighbours in the order of the names."""
    names = list(places)
    camera: dict[str, object] = {"working_range_mm": [250, 450], "field_of_view_deg": [55, 36], "sight_crossing_mm": [60, 0, 500]}
    data: dict[str, object] = {
        "format": "spherecal-cell/1",
        "name": "test",
        "robot": {"driver": "recorded", "model": "irb1410_paper"},
        "camera": {"driver": "recorded", "kind": kind} | camera,
        "flange_from_camera": PAPER_FLANGE_FROM_CAMERA,
        "spheres": {name: {"diameter_mm": 38.1, "expanded_uncertainty_mm": 0.001} for name in names},
        "lengths": [
            {"between": [a, b], "length_mm": float(np.linalg.norm(np.subtract(places[a], places[b]))), "expanded_uncertainty_mm": 0.005}
            for a, b in itertools.pairwise(names)
        ],
    }
    if limits:
        data["limits"] = LIMITS
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "cell.yaml"
    path.write_text(dump_yaml(data), encoding="utf-8")
    return load_cell(path)


def record_session(
    folder: Path,
    cell: Cell,
    rng: np.random.Generator,
    *,
    truth: SyntheticCell | None = None,
    places: dict[str, tuple[float, float, float]] = PLACES,
    shots_per_sphere: int = 5,
    n_points: int = 300,
    purpose: str = "verification",
    depth_noise_mm: float = 0.05,
) -> Session:
    """Capture every sphere of `places` from random views of the truth, joints and flange poses recorded."""
    truth = truth or paper_cell()
    with SessionWriter.create(folder, purpose=purpose, cell=cell) as writer:
        for name, place in places.items():
            placed = replace(truth, centre_in_base_mm=np.array(place))
            for _ in range(shots_per_sphere):
                shot = draw_shot(placed, rng, n_points=n_points, depth_noise_mm=depth_noise_mm, depth_mm=(260.0, 400.0))
                writer.append(
                    sphere=name,
                    joints_rad=shot.joints_rad,
                    base_from_flange=mdh.base_from_flange(truth.nominal, shot.joints_rad),
                    xyz_mm=shot.points_in_camera_mm.astype(np.float32),
                )
    return read_session(folder)
