"""The hidden truth of a simulated cell, as plain data.

Tuples of floats throughout, so that a truth compares as what it is and goes to YAML and back unchanged. Every field
has a default that means "no such effect": `RobotTruth()` is the nominal robot.

Not modelled: link and gearbox elasticity beyond gravity, linkage lengths of a parallelogram, temperature as such
(only its drift), vibration after a stop, blur of a moving camera, the projector's shadow, inter-reflection, the pattern's specular highlights.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt

Vector: TypeAlias = tuple[float, ...]
Vector3: TypeAlias = tuple[float, float, float]
Vector6: TypeAlias = tuple[float, float, float, float, float, float]
Row: TypeAlias = tuple[float, float, float, float]
Transform: TypeAlias = tuple[Row, Row, Row, Row]
Probability: TypeAlias = Annotated[float, Field(ge=0.0, le=1.0)]

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

IDENTITY: Transform = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class GearHarmonic:
    """One axis reads q while it stands at q + amplitude sin(cycles q + phase)."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    axis: Annotated[int, Field(ge=0)]
    amplitude_rad: float
    cycles_per_turn: PositiveFloat
    phase_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class RobotTruth:
    """How the true robot differs from its nominal model; each vector has one entry per axis or is left empty."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    a_error_mm: Vector = ()
    alpha_error_rad: Vector = ()
    d_error_mm: Vector = ()
    theta_error_rad: Vector = ()
    tilt_rad: Vector = ()
    """Turn about the link's y before the axis turns (Hayati's beta): two near-parallel axes are not parallel."""
    link_twists: tuple[Vector6, ...] = ()
    """Twists (rho mm, phi rad) on the right of each link, the calibrator's own error model."""
    droop_rad: Vector = ()
    """Deflection of each axis under gravity when the flange is stretched out horizontally from it."""
    backlash_rad: Vector = ()
    """Full play of each axis: the link lags half of it behind the direction of approach."""
    gear_harmonics: tuple[GearHarmonic, ...] = ()
    drift_per_hour: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Twist (mm, rad) of the robot's foot in the base frame per hour of the cell's clock."""
    axis_drift_rad_per_hour: Vector = ()
    axis_repeatability_rad: Vector = ()
    """Standard deviation of each axis, drawn anew at the end of every motion."""
    pose_noise_mm: NonNegativeFloat = 0.0
    """Standard deviation per component of the flange's position, drawn anew at the end of every motion."""
    pose_noise_rad: NonNegativeFloat = 0.0
    """The same for its orientation, turned about the flange's origin."""
    encoder_noise_rad: NonNegativeFloat = 0.0
    """Standard deviation of every reading of every axis; the reported flange pose follows the reading."""
    home_rad: Vector = ()
    """Where the axes stand at first; all zero, or the middle of the range, where left empty."""
    acceleration_rad_s2: PositiveFloat = 3.0

    def per_axis(self) -> dict[str, tuple[object, ...]]:
        """Every list that has one entry per axis, or none."""
        names = (
            "a_error_mm alpha_error_rad d_error_mm theta_error_rad tilt_rad link_twists droop_rad backlash_rad"
            " axis_drift_rad_per_hour axis_repeatability_rad home_rad"
        )
        return {name: getattr(self, name) for name in names.split()}


@dataclass(frozen=True, slots=True)
class NoError:
    """The camera measures true points, but for noise."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    kind: Literal["none"] = "none"


@dataclass(frozen=True, slots=True)
class PillowTruth:
    """The paper's eq. 5 as an error: z_measured = z_true + sum_l k_l (z - z_s) r^(2l), r² = (x - x_s)² + (z - z_s)².

    x and z on the right are the **measured** ones, so that adding the correction with -k at the measured point, as the
    paper does, is the exact inverse.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    sight_crossing_mm: Vector3 = (60.0, 0.0, 500.0)
    k: Vector = (1e-9, 7e-15, 5e-18)
    kind: Literal["pillow"] = "pillow"


@dataclass(frozen=True, slots=True)
class StereoTruth:
    """Projector and camera whose real geometry is not the one the software triangulates with.

    The camera sits at the origin, the projector at (baseline, 0, 0), turned by `toe_in_rad` about y towards the camera.
    `*_error` are real minus assumed.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    focal_px: PositiveFloat = 1200.0
    projector_focal_px: PositiveFloat = 1200.0
    baseline_mm: float = 120.0
    toe_in_rad: float = 0.24
    focal_error_px: float = 0.0
    principal_error_px: tuple[float, float] = (0.0, 0.0)
    projector_focal_error_px: float = 0.0
    projector_principal_error_px: float = 0.0
    baseline_error_mm: float = 0.0
    toe_in_error_rad: float = 0.0
    kind: Literal["stereo"] = "stereo"


@dataclass(frozen=True, slots=True)
class FieldTruth:
    """A smooth depth error of the **true** point: a bowl over the view and a ripple across it and along the depth."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    bowl_mm: float = 0.0
    """Depth error at `half_width_mm` from the camera's axis."""
    half_width_mm: PositiveFloat = 150.0
    ripple_mm: float = 0.0
    wavelength_mm: PositiveFloat = 120.0
    kind: Literal["field"] = "field"


CameraErrorTruth: TypeAlias = Annotated[NoError | PillowTruth | StereoTruth | FieldTruth, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """The true camera: where it really sits, what it sees, how wrong and how noisy it is."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    flange_from_camera: Transform = IDENTITY
    kind: Literal["area", "line_profile"] = "area"
    resolution_px: tuple[PositiveInt, PositiveInt] = (1280, 800)
    """Width and height; a line profile uses the width only."""
    field_of_view_deg: tuple[PositiveFloat, PositiveFloat] = (55.0, 36.0)
    working_range_mm: tuple[PositiveFloat, PositiveFloat] = (200.0, 800.0)
    """Depths outside are never delivered."""
    range_noise_mm: NonNegativeFloat = 0.0
    """Standard deviation along the ray at `range_noise_at_mm`."""
    range_noise_at_mm: PositiveFloat = 350.0
    range_noise_growth: NonNegativeFloat = 0.0
    """Power of the range with which the noise grows: 0 constant, 2 as triangulation does."""
    flying_pixel_fraction: Probability = 0.0
    """Share of the pixels at a depth edge that are drawn into the gap behind."""
    flying_pixel_mm: NonNegativeFloat = 5.0
    """Longest such displacement along the ray."""
    incidence_limit_deg: Annotated[float, Field(gt=0.0, le=90.0)] = 90.0
    """No point where the ray meets the surface at a larger angle from its normal."""
    incidence_softness_deg: NonNegativeFloat = 0.0
    """Over this many degrees below the limit the chance of a point falls from one to zero."""
    invalid_fraction: Probability = 0.0
    """Share of the points lost at random."""
    exposure_s: NonNegativeFloat = 0.2
    error: CameraErrorTruth = field(default_factory=NoError)


@dataclass(frozen=True, slots=True)
class SphereTruth:
    """A sphere as it really stands in the cell."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    centre_in_base_mm: Vector3
    diameter_mm: PositiveFloat
    optical_offset_mm: float = 0.0
    """Added to the mechanical radius: coated and translucent spheres read a little large."""

    @property
    def seen_radius_mm(self) -> float:
        """The radius that the camera sees."""
        return self.diameter_mm / 2 + self.optical_offset_mm


@dataclass(frozen=True, slots=True)
class BoxTruth:
    """A box of given sides about the origin of its own frame: a table, a post, a fixture."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    size_mm: tuple[PositiveFloat, PositiveFloat, PositiveFloat]
    base_from_box: Transform


@dataclass(frozen=True, slots=True)
class WorkpieceTruth:
    """A mesh in the cell: the built-in `stepped_block` or `machined_part`, or a mesh file (mm) beside the truth file."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    base_from_part: Transform
    mesh: str = "stepped_block"


@dataclass(frozen=True, slots=True)
class Truth:
    """Everything about one simulated cell that nobody but the simulator may know."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    seed: Annotated[int, Field(ge=0)] = 0
    robot: RobotTruth = RobotTruth()
    camera: CameraTruth = CameraTruth()
    spheres: dict[str, SphereTruth] = field(default_factory=dict)
    boxes: tuple[BoxTruth, ...] = ()
    workpiece: WorkpieceTruth | None = None


def mesh_path(workpiece: WorkpieceTruth, folder: Path) -> Path:
    """Where the mesh file of a workpiece lies, relative to the truth file's folder."""
    return folder / workpiece.mesh
