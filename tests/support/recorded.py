"""Sessions on disk by the independent little simulator, and the system that knows its truth."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from acquire.cell import Cell, Limits, load_cell, robot_model_of
from acquire.session import SessionWriter
from calibrate.camera_error import PillowError
from calibrate.datum import References, nominal_robot_datum
from calibrate.normal import NoiseModel
from calibrate.observations import RejectedShot, gather_observations
from calibrate.result import Calibration
from calibrate.result_parts import ShotResult, Statistics
from drivers.files.session import Session, read_session
from drivers.files.yaml import dump_yaml
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray
from tests.support.synthetic import PAPER_FLANGE_FROM_CAMERA, SyntheticCell, draw_shot, paper_cell

PLACES = {"A": (900.0, 100.0, 300.0), "B": (820.0, -250.0, 380.0)}
LIMITS = {"centre_rms_mm": 0.2, "length_error_mm": 0.2, "diameter_error_mm": 0.1, "form_mm": 0.5}


NEXT_TO_NO_NOISE = NoiseModel(point_mm=0.05, pose_mm=1e-6, pose_rad=1e-9)


@dataclass(frozen=True)
class TrainedOn:
    """A shot that a system was made from."""

    scan_sha256: str
    joints_rad: FloatArray | None = None
    base_from_flange: FloatArray | None = None


@dataclass(frozen=True)
class TrueSystem:
    """A measuring system that knows the synthetic cell's truth."""

    cell: SyntheticCell
    pose_only: bool = False
    id: str = "0" * 64
    identity: Mapping[str, object] = field(default_factory=dict)
    radius_offset_mm: float = 0.0
    limits: Limits | None = None
    shots: tuple[TrainedOn, ...] = ()
    sigma_of_scale: float = 3e-5
    sigma_of_radius_mm: float = 0.0
    noise: NoiseModel = NEXT_TO_NO_NOISE
    temperatures_c: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    camera_seen_volume_mm: FloatArray = field(default_factory=lambda: np.array([[-500.0, -500.0, 100.0], [500.0, 500.0, 900.0]]))
    seen_joints_rad: FloatArray | None = None
    sphere_centres_in_base_mm: Mapping[str, FloatArray] = field(default_factory=dict)

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
    def flange_from_camera(self) -> FloatArray:
        return self.cell.flange_from_camera

    def base_from_flange(self, joints_rad: ArrayLike) -> FloatArray:
        return mdh.base_from_flange(self.cell.true, joints_rad)

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


def nominal_calibration(cell: Cell, sessions: Sequence[Session]) -> Calibration:
    """A calibration that leaves robot, first guess and camera as they are; what it states of itself is made up."""
    model = robot_model_of(cell)
    if model is None or cell.flange_from_camera is None:
        raise LookupError("the cell must have a robot and a first guess")
    observations = gather_observations(sessions, cell=cell, model=model)
    joints = np.array([shot.joints_rad for shot in observations.shots], dtype=np.float64)
    places = np.array([shot.points_in_camera_mm.mean(axis=0) for shot in observations.shots])
    return Calibration(
        id="c" * 64,
        method="clouds",
        model=model,
        link_twists=np.zeros((6, 6)),
        terms=(),
        terms_rad=np.zeros(0),
        flange_from_camera=cell.flange_from_camera,
        camera_error=PillowError(n_terms=1),
        camera_mm=np.array([0.05]),
        camera_seen_volume_mm=np.array([places.min(axis=0), places.max(axis=0)]),
        radius_offset_mm=0.01,
        sphere_centres_in_base_mm={name: np.array(place) for name, place in PLACES.items()},
        sphere_radius_offsets_mm=dict.fromkeys(PLACES, 0.01),
        datum=nominal_robot_datum(model, np.zeros((6, 6)), References(joints)),
        seen_joints_rad=np.array([joints.min(axis=0), joints.max(axis=0)]),
        noise=NoiseModel(point_mm=0.05, pose_mm=0.01, pose_rad=1e-4),
        parameter_names=(),
        covariance=1e-6 * np.eye(44),
        statistics=Statistics(len(places), len(places), 25, 43, 80.0, 0.05, 0.06, 0.055, 1.0, 4, 1.0, {"none": 0.2, "pillow": 0.06}),
        limits=cell.limits,
        verdict="pass",
        reasons=("the limits are kept",),
        shots=tuple(
            ShotResult(s.session, s.index, s.sphere, s.scan_sha256, len(s.points_in_camera_mm), 0.04, 0.05, place, np.zeros(3), 0.06)
            for s, place in zip(observations.shots, places, strict=True)
        ),
        rejected=(RejectedShot(sessions[0].digest, 99, "coverage: the cap <is> too small"),),
        cell_name=cell.name,
        inputs={"cell_sha256": cell.sha256, "sessions": [session.digest for session in sessions]},
        identity={"robot_serial": "1410-<42>"},
        created_utc="2026-01-01T00:00:00Z",
        software="spherecal 0",
    )
