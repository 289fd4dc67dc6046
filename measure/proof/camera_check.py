"""Camera check: a sphere seen at many places of the camera's volume, before any calibration (the paper's Fig 5).

Every shot stands for itself: a free-radius fit in the camera frame gives diameter and form, and where the sphere was. No
robot, no hand-eye and no other shot comes in, so it does not matter whether the sphere or the camera was moved between
the shots. What it sees is the camera alone: its scale, and what bends a sphere. It is blind to a shift or a turn of the
whole field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acquire.cell import Cell, Limits, cell_of_session, robot_model_of
from acquire.check import check_session
from acquire.sphere_fit import fit_free_radius
from calibrate.observations import Observations, RejectedShot, SphereShot, gather_observations
from drivers.errors import DataError, SettingsError
from drivers.files.session import Session
from drivers.kinematics.se3 import FloatArray
from measure.decision import Judgement, Verdict, judge, overall
from measure.proof.probing import Probing, probing_of
from measure.proof.scatter import student_factor
from measure.verify_result import SessionName

FEWEST_PLACES = 8
LEAST_DEPTH_SHARE, LEAST_SPREAD_MM = 0.5, 40.0
_APART_MM = 5.0
_SECOND_ORDER_FROM = 20
_SCALE_MM = 100.0


@dataclass(frozen=True, slots=True)
class SpherePlace:
    """One sphere at one place of the camera frame."""

    session: str
    index: int
    sphere: str
    centre_in_camera_mm: tuple[float, float, float]
    probing: Probing
    noise_mm: float
    """Standard uncertainty of the diameter from the scatter of the points."""

    @property
    def diameter_error_mm(self) -> float:
        """Free diameter on all points minus the certified one."""
        return self.probing.size_error_mm[0]

    @property
    def form_mm(self) -> float:
        """On 95 % of the points."""
        return self.probing.form_mm[2]


@dataclass(frozen=True, slots=True)
class Trend:
    """A smooth course of the diameter error over the camera frame, and what it leaves."""

    order: int
    """Of the polynomial in x, y, z: 0, 1 or 2."""
    per_100_mm: tuple[float, float, float]
    """Its slope in the middle of the places along x, y, z: mm of diameter per 100 mm."""
    left_mm: float
    """Standard deviation about it: how well one place is repeated by its neighbours."""
    freedom: int


@dataclass(frozen=True, slots=True, eq=False)
class CameraCheck:
    """What a sweep of the sphere says of the camera."""

    sessions: tuple[SessionName, ...]
    places: tuple[SpherePlace, ...]
    rejected: tuple[RejectedShot, ...]
    trend: Trend
    covered_mm: FloatArray
    """(2, 3) corners of the box that the sphere's centre was seen in, camera frame."""
    working_range_mm: tuple[float, float] | None
    limits: tuple[float, float] | None
    """On the sizes of diameter error and form; None for none."""
    judgements: tuple[Judgement, ...]
    verdict: Verdict
    reasons: tuple[str, ...]
    drivers: tuple[str, ...] = ()
    """Of the cameras."""

    def session_name(self, digest: str) -> str:
        """Folder name of a session."""
        return next((s.name for s in self.sessions if s.digest == digest), digest[:12])

    @property
    def diameter_errors_mm(self) -> FloatArray:
        """(n,)."""
        return np.array([place.diameter_error_mm for place in self.places])

    @property
    def forms_mm(self) -> FloatArray:
        """(n,)."""
        return np.array([place.form_mm for place in self.places])

    @property
    def centres_mm(self) -> FloatArray:
        """(n, 3) camera frame."""
        return np.array([place.centre_in_camera_mm for place in self.places])

    def to_json_dict(self) -> dict[str, object]:
        """What `spherecal camera-check --json` prints."""
        errors, forms = self.diameter_errors_mm, self.forms_mm
        return {
            "n_shots": len(self.places) + len(self.rejected),
            "used": len(self.places),
            "rejected": [{"session": self.session_name(r.session), "index": r.index, "reason": r.reason} for r in self.rejected],
            "diameter_error_mm": {"mean": float(errors.mean()), "least": float(errors.min()), "greatest": float(errors.max())},
            "form_mm": {"median": float(np.median(forms)), "greatest": float(forms.max())},
            "trend": {"order": self.trend.order, "per_100_mm": list(self.trend.per_100_mm), "left_mm": self.trend.left_mm},
            "covered_mm": self.covered_mm.tolist(),
            "places": [
                {
                    "session": self.session_name(p.session),
                    "index": p.index,
                    "sphere": p.sphere,
                    "centre_in_camera_mm": list(p.centre_in_camera_mm),
                    "probing": p.probing.to_json_dict(),
                }
                for p in self.places
            ],
            "limits": None if self.limits is None else {"diameter_error_mm": self.limits[0], "form_mm": self.limits[1]},
            "verdict": self.verdict,
            "reasons": list(self.reasons),
        }


def camera_check(sessions: Sequence[Session], *, limits: tuple[float, float] | None = None) -> CameraCheck:
    """Look at every sphere of some sessions by itself.

    Args:
        sessions: at least one; what they were captured for does not matter.
        limits: on diameter error and form (95 %), mm; the cell's where None.

    Raises:
        DataError: no shot shows a sphere.
        SettingsError: a line profile, whose arcs have no diameter of their own.
        FileError: a session is broken.
    """
    cells = [cell_of_session(session) for session in sessions]
    parts = [_seen(session, cell) for session, cell in zip(sessions, cells, strict=True)]
    shots = [shot for part in parts for shot in part.shots]
    rejected = tuple(shot for part in parts for shot in part.rejected)
    if not shots:
        why = f"; the first refusal was: {rejected[0].reason}" if rejected else ""
        raise DataError(f"no shot shows a sphere{why}", file=sessions[0].folder, remedy="Capture shots of the sphere over the camera's volume.")
    given = next((cell.limits for cell in cells if cell.limits is not None), None)
    found = check_shots(shots, next(c.camera.working_range_mm for c in cells), _certificates(cells), limits=limits or _limits_of(given))
    names = tuple(SessionName(session.folder.name, session.digest) for session in sessions)
    drivers = tuple(sorted({cell.camera.driver for cell in cells}))
    return replace(found, sessions=names, rejected=rejected, drivers=drivers)


def check_shots(
    shots: Sequence[SphereShot],
    working_range_mm: tuple[float, float] | None,
    certificates: dict[str, tuple[float, float]],
    *,
    limits: tuple[float, float] | None,
) -> CameraCheck:
    """The same on found spheres; `certificates` gives standard uncertainties of diameter and form by sphere."""
    places = tuple(_place(shot) for shot in shots)
    centres, errors = np.array([p.centre_in_camera_mm for p in places]), np.array([p.diameter_error_mm for p in places])
    trend = _trend(centres, errors)
    covered = np.array([centres.min(axis=0), centres.max(axis=0)])
    judged = () if limits is None else _judgements(places, trend, certificates, limits)
    verdict, reasons = overall(judged, _gaps(centres, covered, working_range_mm, limits))
    return CameraCheck((), places, (), trend, covered, working_range_mm, limits, judged, verdict, reasons)


def _limits_of(limits: Limits | None) -> tuple[float, float] | None:
    return None if limits is None else (limits.diameter_error_mm, limits.form_mm)


def _certificates(cells: Sequence[Cell]) -> dict[str, tuple[float, float]]:
    return {name: (s.expanded_uncertainty_mm / 2, (s.form_mm or 0.0) / 2) for cell in cells for name, s in cell.spheres.items()}


def _seen(session: Session, cell: Cell) -> Observations:
    if cell.camera.kind == "line_profile":
        raise SettingsError("a line profile shows arcs, which have no diameter of their own", file=session.folder, remedy="Use an area camera.")
    model = robot_model_of(cell, session)
    check_session(session, cell, model)
    # where the robot believes the sphere says nothing when it is the sphere that was moved
    return gather_observations([session], cell=cell, model=model, predict=lambda _: None)


def _place(shot: SphereShot) -> SpherePlace:
    start = shot.centre_in_camera_mm
    if start is None:
        raise DataError(f"shot {shot.index} has no centre of its own", remedy="Use an area camera.")
    probing = probing_of(shot.points_in_camera_mm, shot.radius_mm, start)
    if probing is None:
        raise DataError(f"shot {shot.index} has too few points on its sphere", remedy="Capture it from nearer.")
    centre, _, covariance = fit_free_radius(shot.points_in_camera_mm, shot.radius_mm, start)
    x, y, z = (float(value) for value in centre)
    return SpherePlace(shot.session, shot.index, shot.sphere, (x, y, z), probing, 2.0 * float(np.sqrt(covariance[3, 3])))


def _trend(centres_mm: FloatArray, errors_mm: FloatArray) -> Trend:
    """A polynomial of the order that the number of places bears; what it leaves is their repeatability."""
    n = len(errors_mm)
    order = 2 if n >= _SECOND_ORDER_FROM else 1 if n >= FEWEST_PLACES else 0
    away = (centres_mm - centres_mm.mean(axis=0)) / _SCALE_MM
    columns = [np.ones((n, 1)), away, np.column_stack([away**2, away[:, [0, 0, 1]] * away[:, [1, 2, 2]]])][: order + 1]
    design = np.concatenate(columns, axis=1)
    coefficients, _, rank, _ = np.linalg.lstsq(design, errors_mm, rcond=1e-6)
    left = errors_mm - design @ coefficients
    freedom = max(n - int(rank), 0)
    slopes = coefficients[1:4] if order else np.zeros(3)
    sigma = float(np.sqrt(left @ left / freedom)) if freedom else 0.0
    return Trend(order, (float(slopes[0]), float(slopes[1]), float(slopes[2])), sigma, freedom)


def _judgements(
    places: Sequence[SpherePlace], trend: Trend, certificates: dict[str, tuple[float, float]], limits: tuple[float, float]
) -> tuple[Judgement, ...]:
    repeated = trend.left_mm * student_factor(trend.freedom) if trend.freedom else 0.0
    found = []
    for place in places:
        u_size, u_form = certificates[place.sphere]
        where = "({:.0f}, {:.0f}, {:.0f})".format(*place.centre_in_camera_mm)
        u = float(np.hypot(max(place.noise_mm, repeated), u_size))
        found.append(judge(f"diameter at {where}, shot {place.index}", place.diameter_error_mm, limits[0], u))
        found.append(judge(f"form at {where}, shot {place.index}", place.form_mm, limits[1], u_form))
    return tuple(found)


def _gaps(
    centres_mm: FloatArray, covered_mm: FloatArray, working_range_mm: tuple[float, float] | None, limits: tuple[float, float] | None
) -> list[str]:
    gaps = [] if limits is not None else ["no limits given"]
    apart = np.linalg.norm(centres_mm[:, None] - centres_mm[None], axis=2)
    n_places = sum(bool((apart[i, :i] > _APART_MM).all()) for i in range(len(centres_mm)))
    if n_places < FEWEST_PLACES:
        gaps.append(f"the sphere was seen at {n_places} places, {FEWEST_PLACES} are wanted")
    span = covered_mm[1] - covered_mm[0]
    if working_range_mm is not None:
        share = float(span[2]) / (working_range_mm[1] - working_range_mm[0])
        if share < LEAST_DEPTH_SHARE:
            gaps.append(f"{100 * share:.0f} % of the working range was covered in depth, {100 * LEAST_DEPTH_SHARE:.0f} % are wanted")
    if span[:2].min() < LEAST_SPREAD_MM:
        axis = "xy"[int(span[:2].argmin())]
        gaps.append(f"the sphere moved by {span[:2].min():.0f} mm along {axis} of the camera, {LEAST_SPREAD_MM:.0f} mm are wanted")
    return gaps
