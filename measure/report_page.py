"""What a report holds: the facts it is made from, and the page as plain text and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from acquire.cell import Limits
from calibrate.budget import ErrorBudget
from calibrate.camera_field import CameraField, SeenCells
from calibrate.identifiability import Identifiability
from drivers.kinematics.se3 import FloatArray
from measure.plots import Drawn


@dataclass(frozen=True, slots=True, eq=False)
class ShotResidual:
    """One shot of the calibration, for curve and coverage."""

    session: str
    index: int
    sphere: str
    residual_mm: float
    """Distance of its centre from the sphere's, or radial rms for line profiles."""
    centre_in_camera_mm: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFacts:
    """What a report says of a calibration, in plain values."""

    id: str
    cell_name: str
    verdict: str
    """pass, marginal or fail."""
    reasons: tuple[str, ...]
    method: str
    camera_error: str
    n_shots: int
    used: int
    rejected: tuple[tuple[str, int, str], ...]
    """(session, index, reason)."""
    rank: int
    n_parameters: int
    train_rms_mm: float | None
    cross_validated_rms_mm: float | None
    radius_offset_mm: float
    datum: str
    simulated: bool
    identity: Mapping[str, str] = field(default_factory=dict)
    """Further lines of "where this comes from"."""
    shots: tuple[ShotResidual, ...] = ()
    residual_name: str = "distance from sphere centre, mm"
    seen_mm: FloatArray | None = None
    """(2, 3) corners of the camera volume with data."""
    working_range_mm: tuple[float, float] | None = None
    limits: Limits | None = None
    field_of_view_deg: tuple[float, float] | None = None
    camera_field: Callable[[FloatArray], CameraField] | None = None
    """The camera's correction at points (n, 3), with covariance; None where the camera is taken as it is."""
    seen_cells: SeenCells | None = None
    """Where in the camera's view points were measured."""
    identifiability: Identifiability | None = None
    error_budget: ErrorBudget | None = None
    untried_drivers: tuple[str, ...] = ()
    """Drivers of the cell that have never run on hardware."""
    robot_alone: bool = False
    """Whether external points were all there was: the camera is not calibrated."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of the result table."""

    label: str
    help: str
    before: str
    after: str
    limit: str = ""
    mark: str = ""
    tone: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A plain table; the first column is text."""

    title: str
    lead: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: bool = True


@dataclass(frozen=True, slots=True)
class Picture:
    """A drawn figure with its caption."""

    title: str
    caption: str
    svg: Drawn
    wide: bool = False
    """Whether it takes the whole width of the page."""


@dataclass(frozen=True, slots=True)
class Page:
    """All that the template puts on the page."""

    title: str
    headline: str
    sentence: str
    tone: str
    remarks: tuple[str, ...]
    result_lead: str
    rows: tuple[Row, ...]
    reasons: tuple[str, ...]
    next_steps: tuple[str, ...]
    tables: tuple[Table, ...]
    pictures: tuple[Picture, ...]
    calibration_rows: tuple[Row, ...]
    identity: tuple[tuple[str, str], ...]
    created_utc: str
    software: str
    decision_rule: str
    on_every_page: str = ""
    """What no page may be shown without."""
