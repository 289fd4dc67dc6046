"""Where the uncertainty of a measured point comes from, over the work volume.

A point's covariance is `J S J'` of the calibration plus pose noise and noise of the point. The blocks of J (robot
geometry, hand-eye, camera field, physics of the arm) have shares `J_b S_bb J_b'` of their own, but the shots know sums of
them better than each: errors that cancel in every shot cancel in most measurements too. So the shares do not add up, and
"together" is what counts. Parts of S that move no point of the work volume (gauge, see `calibrate.gauge`) would only
blow up the shares: each block's is that of the shortest change of the parameters (mm, rad x 500 mm) that moves all
points alike, and their sum stays the same to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from drivers.errors import SettingsError
from drivers.kinematics import se3
from drivers.kinematics.inverse import branches_of_many
from drivers.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calibrate.result import Calibration

LENGTH_MM = 300.0
_ANGLE_SCALE_MM = 500.0
_GRID = (8, 8, 3)
_VIEWS = 2
_PAIRS = 50
_SMALLEST_SHARE = 1e-7
"""Directions that move points of the work volume by less than this share of what the strongest moves them are gauge."""
_MARGIN_RAD = float(np.radians(1))


@dataclass(frozen=True, slots=True)
class Shares:
    """Standard uncertainties in mm, root mean square over places; of points all three directions together."""

    robot_geometry_mm: float
    hand_eye_mm: float
    camera_field_mm: float
    arm_physics_mm: float
    """Deflection under gravity and transmission errors: by their priors, where no shot told."""
    calibration_mm: float
    """The blocks above together, what they have in common cancelled; the base frame's own fit is in it."""
    artefact_mm: float | None
    """The part of `calibration_mm` that comes from certificates: radii, optical offset, lengths. None where unknown."""
    pose_noise_mm: float
    point_noise_mm: float
    total_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBudget:
    """What a measured point and a length are uncertain by, and why."""

    region: str
    box_in_base_mm: FloatArray
    """(2, 3)."""
    n_places: int
    """Places of the region that views like those of the calibration reach."""
    point: Shares
    largest_point_mm: float
    """Of `total_mm` over the places."""
    length_mm: float
    length: Shares
    """Of a length between two points of so far apart, each measured from a view of its own."""
    plan_x_mm: FloatArray
    """(nx,)."""
    plan_y_mm: FloatArray
    """(ny,)."""
    plan_mm: FloatArray
    """(ny, nx) total of a point, rms over height; NaN out of reach."""

    def to_json_dict(self) -> dict[str, object]:
        """For the calibration file and `--json`."""
        return {
            "region": self.region,
            "box_in_base_mm": self.box_in_base_mm.tolist(),
            "n_places": self.n_places,
            "point": _told(self.point),
            "largest_point_mm": self.largest_point_mm,
            "length_mm": self.length_mm,
            "length": _told(self.length),
            "plan": {
                "x_mm": self.plan_x_mm.tolist(),
                "y_mm": self.plan_y_mm.tolist(),
                "total_mm": [[float(value) if np.isfinite(value) else None for value in row] for row in self.plan_mm],
            },
        }

    @classmethod
    def from_json_dict(cls, data: Mapping[str, object]) -> ErrorBudget:
        """What `to_json_dict` wrote; KeyError, TypeError or ValueError for anything else."""
        plan = data["plan"]
        if not isinstance(plan, Mapping):
            raise TypeError("plan is no mapping")
        return cls(
            region=str(data["region"]),
            box_in_base_mm=_numbers(data["box_in_base_mm"]),
            n_places=int(str(data["n_places"])),
            point=_shares_from(data["point"]),
            largest_point_mm=float(str(data["largest_point_mm"])),
            length_mm=float(str(data["length_mm"])),
            length=_shares_from(data["length"]),
            plan_x_mm=_numbers(plan["x_mm"]),
            plan_y_mm=_numbers(plan["y_mm"]),
            plan_mm=_numbers(plan["total_mm"]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Measured points: v of them, each in a view of its own."""

    place: NDArray[np.int64]
    """(v,) index of the place that each lies at."""
    points_in_camera_mm: FloatArray
    """(v, 3)."""
    jacobian: FloatArray
    """(v, 3, p)."""
    pose_covariance_mm2: FloatArray
    """(v, 3, 3)."""
    point_covariance_mm2: FloatArray
    """(v, 3, 3)."""
    joints_rad: FloatArray | None = None
    """(v, n) where the robot stands; None for pose-only calibrations."""


def error_budget(
    calibration: Calibration, box_in_base_mm: FloatArray, region: str, *, artefact: FloatArray | None = None, joints_rad: FloatArray | None = None
) -> ErrorBudget | None:
    """The budget over a box, for views like those of the calibration; None where none reaches it.

    Args:
        calibration: with shots of spheres.
        box_in_base_mm: (2, 3) where work will be measured.
        region: what to call it.
        artefact: (P, P) the part of the calibration's covariance that comes from certificates.
        joints_rad: (m, n) whose orientations views have; the datum's poses if None.
    """
    rng = np.random.default_rng(17)
    axes = [low + (np.arange(n) + 0.5) / n * (high - low) for low, high, n in zip(*box_in_base_mm, _GRID, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    starts, ends, length = _pairs(box_in_base_mm, LENGTH_MM, rng)
    places = np.concatenate([grid, starts, ends])
    views = views_at(calibration, places, rng, np.concatenate([np.full(len(grid), _VIEWS), np.ones(2 * len(starts), dtype=np.int64)]), joints_rad)
    on_grid = views.place < len(grid)
    if not on_grid.any():
        return None
    used = _without_gauge(calibration, views.jacobian)
    squares = shares_of_views(calibration, used, views, artefact)
    pairs = _pairs_of(views, len(grid), len(starts))
    along = (ends - starts)[views.place[pairs[0]] - len(grid)] / length
    return ErrorBudget(
        region=region,
        box_in_base_mm=box_in_base_mm,
        n_places=len(np.unique(views.place[on_grid])),
        point=_rms({key: value[on_grid] for key, value in squares.items()}),
        largest_point_mm=float(np.sqrt(squares["total_mm"][on_grid].max())),
        length_mm=length,
        length=_rms(_shares_of_lengths(calibration, used, views, pairs, along, artefact)),
        plan_x_mm=axes[0].round(2),
        plan_y_mm=axes[1].round(2),
        plan_mm=_plan(views.place[on_grid], squares["total_mm"][on_grid]).round(5),
    )


def _plan(place: NDArray[np.int64], squares_mm2: FloatArray) -> FloatArray:
    """(ny, nx) root mean square over the views of all places of the grid that stand above each other."""
    column = place // _GRID[2]
    size = _GRID[0] * _GRID[1]
    n_views = np.bincount(column, minlength=size)
    mean = np.bincount(column, squares_mm2, size) / np.where(n_views, n_views, np.nan)
    return np.asarray(np.sqrt(mean).reshape(_GRID[:2]).T)


def blocks(calibration: Calibration) -> dict[str, slice]:
    """Columns of `point_jacobian` by what they belong to."""
    n_links, n_camera = calibration.link_twists.size, len(calibration.camera_mm)
    camera = n_links + 6
    return {
        "robot_geometry_mm": slice(0, n_links),
        "hand_eye_mm": slice(n_links, camera),
        "camera_field_mm": slice(camera, camera + n_camera),
        "arm_physics_mm": slice(camera + n_camera, camera + n_camera + len(calibration.terms)),
    }


def shares_of_views(calibration: Calibration, covariance: FloatArray, views: Views, artefact: FloatArray | None = None) -> dict[str, FloatArray]:
    """(v,) variances in mm² of every share, all three directions together; `covariance` (p, p) of the Jacobian's parameters."""
    jacobian = views.jacobian
    squares = {name: _traces(jacobian[..., part], covariance[part, part]) for name, part in blocks(calibration).items()}
    squares["calibration_mm"] = _traces(jacobian, covariance)
    squares["artefact_mm"] = np.full(len(jacobian), np.nan) if artefact is None else _traces(jacobian, _cut(artefact, jacobian))
    squares["pose_noise_mm"] = np.trace(views.pose_covariance_mm2, axis1=1, axis2=2)
    squares["point_noise_mm"] = np.trace(views.point_covariance_mm2, axis1=1, axis2=2)
    squares["total_mm"] = squares["calibration_mm"] + squares["pose_noise_mm"] + squares["point_noise_mm"]
    return squares


def views_at(
    calibration: Calibration,
    places_in_base_mm: FloatArray,
    rng: np.random.Generator,
    n_views: NDArray[np.int64],
    joints_rad: FloatArray | None = None,
) -> Views:
    """Views of places (k, 3) like those of the calibration: its orientations, and places of the camera's view that it saw.

    Args:
        calibration: whose shots count.
        places_in_base_mm: (k, 3).
        rng: seeded by the caller.
        n_views: (k,) wanted of each place; as many as are within the axes' limits are made.
        joints_rad: (m, n) whose orientations views have; the datum's poses if None.
    """
    place = np.repeat(np.arange(len(places_in_base_mm)), n_views)
    seen = np.array([shot.centre_in_camera_mm for shot in calibration.shots])[rng.integers(len(calibration.shots), size=len(place))]
    wanted = places_in_base_mm[place]
    if calibration.model is None:
        return _pose_only_views(calibration, place, wanted, seen)
    poses = calibration.datum.references.joints_rad if joints_rad is None else joints_rad
    reference = poses[rng.integers(len(poses), size=len(place))]
    flange_from_camera = calibration.flange_from_camera
    rotation = (calibration.base_from_flange(reference) @ flange_from_camera)[:, :3, :3]
    base_from_camera = se3.from_rotation_translation(rotation, wanted - (rotation @ seen[..., None])[..., 0])
    rows, joints = _nearest_solutions(calibration, base_from_camera @ se3.inverse(flange_from_camera), reference)
    flange = calibration.base_from_flange(joints)
    points = se3.apply(se3.inverse(flange @ flange_from_camera), wanted[rows])
    jacobian = calibration.point_jacobian(points, joints_rad=joints) if len(rows) else np.zeros((0, 3, len(calibration.covariance)))
    pose, point = calibration.noise_covariances_mm2(points, flange)
    return Views(place[rows], points, jacobian, pose, point, joints)


def _nearest_solutions(calibration: Calibration, base_from_flange: FloatArray, near_rad: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Rows (j,) of poses (v, 4, 4) within reach, and for each the axis angles (j, n) nearest to others (v, n)."""
    model = calibration.model
    if model is None:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 0))
    try:
        found = branches_of_many(model, base_from_flange, margin_rad=_MARGIN_RAD)
    except SettingsError:
        return np.zeros(0, dtype=np.int64), np.zeros((0, model.n_joints))
    away = np.abs(found.joints_rad - near_rad[found.target]).max(axis=1)
    order = np.lexsort((away, found.target))
    rows, first = np.unique(found.target[order], return_index=True)
    return rows.astype(np.int64), found.joints_rad[order[first]]


def _pose_only_views(calibration: Calibration, place: NDArray[np.int64], wanted: FloatArray, seen: FloatArray) -> Views:
    """One pose of the flange does for all: turning and shifting it turns and shifts the covariances, and nothing else."""
    flange = np.eye(4)
    flange[:3, 3] = wanted.mean(axis=0)
    pose, point = calibration.noise_covariances_mm2(seen, np.broadcast_to(flange, (len(seen), 4, 4)))
    return Views(place, seen, calibration.point_jacobian(seen, base_from_flange=flange), pose, point)


def _without_gauge(calibration: Calibration, jacobian: FloatArray) -> FloatArray:
    """(p, p) covariance of the shortest parameter changes that move the points of a Jacobian (v, 3, p) as the true ones do."""
    p = jacobian.shape[-1]
    scale = np.array([_ANGLE_SCALE_MM if name.endswith("_rad") else 1.0 for name in calibration.parameter_names[:p]])
    flat = jacobian.reshape(-1, p) / scale
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = vectors[:, values > _SMALLEST_SHARE**2 * values[-1]]
    project = kept @ kept.T / scale[:, None] * scale
    return np.asarray(project @ calibration.covariance[:p, :p] @ project.T)


def _pairs(box_mm: FloatArray, length_mm: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, float]:
    """Ends (k, 3) of lengths in random directions inside a box, and how long they are: shorter where the box is small."""
    sides = box_mm[1] - box_mm[0]
    length = min(length_mm, 0.6 * float(sides.max()))
    way = rng.normal(size=(40 * _PAIRS, 3))
    way *= length / np.linalg.norm(way, axis=1, keepdims=True)
    start = box_mm[0] + rng.random(way.shape) * sides
    inside = ((start + way >= box_mm[0]) & (start + way <= box_mm[1])).all(axis=1)
    return start[inside][:_PAIRS], (start + way)[inside][:_PAIRS], length


def _pairs_of(views: Views, n_grid: int, n_pairs: int) -> NDArray[np.int64]:
    """(2, k) views of the two ends of every length of which both are within reach."""
    row = np.full(n_grid + 2 * n_pairs, -1)
    row[views.place] = np.arange(len(views.place))
    first, second = row[n_grid : n_grid + n_pairs], row[n_grid + n_pairs :]
    both = (first >= 0) & (second >= 0)
    return np.stack([first[both], second[both]])


def _shares_of_lengths(
    calibration: Calibration, covariance: FloatArray, views: Views, pairs: NDArray[np.int64], along: FloatArray, artefact: FloatArray | None
) -> dict[str, FloatArray]:
    rows = np.einsum("ki,kip->kp", along, views.jacobian[pairs[1]] - views.jacobian[pairs[0]])[:, None]
    noises = [
        np.einsum("ki,kij,kj->k", along, part[pairs[0]] + part[pairs[1]], along)[:, None, None]
        for part in (views.pose_covariance_mm2, views.point_covariance_mm2)
    ]
    return shares_of_views(calibration, covariance, Views(views.place[pairs[0]], along, rows, *noises), artefact)


def _traces(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(((jacobian @ covariance) * jacobian).sum(axis=(1, 2)))


def _cut(covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
    return covariance[: jacobian.shape[-1], : jacobian.shape[-1]]


def _rms(squares: Mapping[str, FloatArray]) -> Shares:
    def root(values: FloatArray) -> float:
        return float(np.sqrt(max(float(values.mean()), 0.0))) if len(values) else float("nan")

    artefact = root(squares["artefact_mm"]) if np.isfinite(squares["artefact_mm"]).all() else None
    return Shares(**{name: root(values) for name, values in squares.items() if name != "artefact_mm"}, artefact_mm=artefact)


def _told(shares: Shares) -> dict[str, float | None]:
    return {name: value if value is not None and np.isfinite(value) else None for name, value in asdict(shares).items()}


def _shares_from(data: object) -> Shares:
    if not isinstance(data, Mapping):
        raise TypeError("the shares are no mapping")
    return Shares(**{field.name: _or_none(data[field.name], field.name) for field in fields(Shares)})  # type: ignore[arg-type]


def _or_none(value: object, name: str) -> float | None:
    if value is None:
        return None if name == "artefact_mm" else float("nan")
    return float(str(value))


def _numbers(value: object) -> FloatArray:
    """An array of a file, where null stands for what is no number."""
    return np.array(value, dtype=np.float64)
