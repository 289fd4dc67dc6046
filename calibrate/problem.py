"""The whole-cloud problem: what is known, what is sought, and its linearisation (METHOD.md 4).

Residual of point i of shot j on sphere s: `|W_ij + e_j - c_s| - (R_s + dR + dR_s)`, W the corrected point in the base,
e_j the displacement that the pose noise of the shot's scan causes at the sphere.

Unknowns, in this order: link twists (6 n), hand-eye (6), camera coefficients (k), deflection terms (K), the shared radius offset dR (1), a
radius deviation per sphere within its certificate (S), sphere centres (3 S), and for external points (see `calibrate.external`) frames (6 F) and
targets (3 T). The pose noise is a nuisance twist per scan,
`(t mm, w rad)` about the flange origin in base axes, with prior `diag(s_t² I, s_r² I)`: at the centre it displaces by
`t + w x (c - f)`, which is METHOD.md's N_j = s_t² I + s_r² hat(l) hat(l)', and two spheres in one scan share it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from calibrate.camera_error import CameraError
from calibrate.external_points import ExternalPoints
from calibrate.robot_terms import RobotTerm
from drivers.kinematics import mdh, se3
from drivers.kinematics.mdh import RobotModel
from drivers.kinematics.se3 import FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Priors:
    """What is believed before any data, as standard deviations of physical size."""

    link_rho_mm: float = 1.0
    link_phi_rad: float = 2e-3
    radius_offset_mm: float = 0.1
    hand_eye_mm: float = 100.0
    hand_eye_rad: float = 0.3
    deflection_rad: float = 1.7e-4
    """Of an axis under gravity at full stretch."""
    transmission_rad: float = 4e-5
    """Amplitude of an axis' transmission error, what the play of gears adds included. Both sizes were set on 172 cells: intervals
    covered 95.6 %, but one cell in twenty was 1.48 times worse than it said."""
    estimated_rad: float = 1e-3
    """Of a term that is estimated, because held-out shots want it."""

    def term_sigma_rad(self, terms: tuple[RobotTerm, ...]) -> FloatArray:
        """(K,) of deflection terms."""
        considered = {"compliance": self.deflection_rad}
        return np.array([self.estimated_rad if term.estimated else considered.get(term.kind, self.transmission_rad) for term in terms])


@dataclass(frozen=True, slots=True, eq=False)
class LengthConstraint:
    """A certified length between the centres of two spheres (indices)."""

    first: int
    second: int
    length_mm: float
    sigma_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All data of a solve; m shots, n axes, S spheres, G scans, N points."""

    model: RobotModel | None
    joints_rad: FloatArray | None
    """(m, n), or None for pose-only data."""
    base_from_flange: FloatArray
    """(m, 4, 4): reported poses, or the nominal model's."""
    scan: IntArray
    """(m,) index of the scan a shot was seen in."""
    sphere: IntArray
    """(m,) index of the shot's sphere."""
    points_in_camera_mm: FloatArray
    """(N, 3), shot by shot."""
    starts: IntArray
    """(m + 1,)."""
    camera_error: CameraError
    radius_mm: FloatArray
    """(S,) certified."""
    radius_sigma_mm: FloatArray
    """(S,) standard uncertainty of the certified radius."""
    lengths: tuple[LengthConstraint, ...] = ()
    priors: Priors = field(default_factory=Priors)
    terms: tuple[RobotTerm, ...] = ()
    """Deflection terms of the arm, K of them."""
    load: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    """(m, n, K) of the terms."""
    first_flange_from_camera: FloatArray | None = None
    """(4, 4) the start's hand-eye transform: a far and weak hold where the shots leave the camera's orientation open."""
    along_sight: bool = True
    """Whether residuals run along the line of sight from the camera's origin (area cameras)."""
    external: ExternalPoints | None = None
    """Points of the flange that a laser tracker saw."""

    @property
    def n_shots(self) -> int:
        """Number of shots m."""
        return int(self.scan.shape[0])

    @property
    def n_scans(self) -> int:
        """Number of scans G, each with its own pose noise; stops at which external points were seen come last."""
        n_stops = 0 if self.external is None else self.external.n_stops
        return (int(self.scan.max()) + 1 if self.n_shots else 0) + n_stops

    @property
    def free_terms(self) -> NDArray[np.bool_]:
        """(K,) deflection terms that are unknowns of the solve."""
        return np.array([term.estimated for term in self.terms], dtype=bool)

    @property
    def layout(self) -> Layout:
        """Where each unknown sits."""
        n_links = 0 if self.joints_rad is None else self.joints_rad.shape[1]
        n_references, n_targets = (0, 0) if self.external is None else (len(self.external.references), len(self.external.targets))
        return _layout(n_links, len(self.camera_error.axis), len(self.terms), len(self.radius_mm), n_references, n_targets)


@dataclass(frozen=True)
class Layout:
    """Slices of the vector of unknowns; no slots, because each is worked out once and kept."""

    n_links: int
    n_camera: int
    n_terms: int
    n_spheres: int
    n_references: int = 0
    n_targets: int = 0

    @cached_property
    def links(self) -> slice:
        """Link twists."""
        return slice(0, 6 * self.n_links)

    @cached_property
    def hand_eye(self) -> slice:
        """Hand-eye update."""
        return slice(6 * self.n_links, 6 * self.n_links + 6)

    @cached_property
    def camera(self) -> slice:
        """Camera coefficients."""
        return slice(self.hand_eye.stop, self.hand_eye.stop + self.n_camera)

    @cached_property
    def terms(self) -> slice:
        """Deflection terms of the arm."""
        return slice(self.camera.stop, self.camera.stop + self.n_terms)

    @cached_property
    def radius_offset(self) -> slice:
        """The shared optical radius offset."""
        return slice(self.terms.stop, self.terms.stop + 1)

    @cached_property
    def sphere_radius(self) -> slice:
        """Radius deviation of each sphere."""
        return slice(self.radius_offset.stop, self.radius_offset.stop + self.n_spheres)

    @cached_property
    def centres(self) -> slice:
        """Sphere centres."""
        return slice(self.sphere_radius.stop, self.sphere_radius.stop + 3 * self.n_spheres)

    @cached_property
    def references(self) -> slice:
        """Frames of external points."""
        return slice(self.centres.stop, self.centres.stop + 6 * self.n_references)

    @cached_property
    def targets(self) -> slice:
        """Targets of external points."""
        return slice(self.references.stop, self.references.stop + 3 * self.n_targets)

    @cached_property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.targets.stop)

    @cached_property
    def n_geometric(self) -> int:
        """Robot, hand-eye and camera with the arm's deflection: what moves a measured point."""
        return int(self.terms.stop)


_layout = lru_cache(Layout)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns, nuisances included."""

    link_twists: FloatArray
    """(n, 6), (0, 6) for pose-only data."""
    flange_from_camera: FloatArray
    camera_mm: FloatArray
    """(k,)."""
    terms_rad: FloatArray
    """(K,) coefficients of the deflection terms."""
    radius_offset_mm: float
    sphere_radius_deviation_mm: FloatArray
    """(S,)."""
    centres_in_base_mm: FloatArray
    """(S, 3)."""
    pose_noise: FloatArray
    """(G, 6) nuisance twists (t mm, w rad) about the flange origin, base axes."""
    base_from_reference: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(F, 4, 4) frames of external points."""
    target_in_flange_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(T, 3) what external points are seen of."""

    def moved(self, layout: Layout, step: FloatArray, noise_step: FloatArray) -> State:
        """The state after a Gauss-Newton step (size,) and nuisance steps (G, 6)."""
        return State(
            link_twists=self.link_twists + step[layout.links].reshape(-1, 6),
            flange_from_camera=se3.exp(step[layout.hand_eye]) @ self.flange_from_camera,
            camera_mm=self.camera_mm + step[layout.camera],
            terms_rad=self.terms_rad + step[layout.terms],
            radius_offset_mm=self.radius_offset_mm + float(step[layout.radius_offset][0]),
            sphere_radius_deviation_mm=self.sphere_radius_deviation_mm + step[layout.sphere_radius],
            centres_in_base_mm=self.centres_in_base_mm + step[layout.centres].reshape(-1, 3),
            pose_noise=self.pose_noise + noise_step,
            base_from_reference=se3.exp(step[layout.references].reshape(-1, 6)) @ self.base_from_reference,
            target_in_flange_mm=self.target_in_flange_mm + step[layout.targets].reshape(-1, 3),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """Where every shot's camera is and how its sphere's centre would move with each unknown."""

    base_from_flange: FloatArray
    """(m, 4, 4), corrected."""
    base_from_camera: FloatArray
    """(m, 4, 4)."""
    centre_in_camera_mm: FloatArray
    """(m, 3) where the shot's sphere is expected, nuisance included."""
    columns: FloatArray
    """(m, v - 1, P): rows u (camera axes), camera basis, radius; columns the unknowns."""
    noise_columns: FloatArray
    """(m, 3, 6): displacement in camera axes per nuisance twist."""

    def subset(self, keep: IntArray) -> Geometry:
        """The same of some shots (indices)."""
        return Geometry(*(getattr(self, each.name)[keep] for each in fields(self)))


def without_terms(problem: Problem) -> Problem:
    """The problem of a rigid arm: where no term is estimated they are held at zero, and a solve without them ends at the same place."""
    return replace(problem, terms=(), load=np.zeros((problem.n_shots, 0, 0)))


def corrected_chain(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Flange poses (m, 4, 4) and frames of the link twists (m, n, 4, 4), each before its own twist; n is 0 for pose-only data."""
    from calibrate import geometry_kernels

    if problem.model is None or problem.joints_rad is None:
        return problem.base_from_flange, np.zeros((problem.n_shots, 0, 4, 4))
    deflection = problem.load @ state.terms_rad if state.terms_rad.any() else None
    links = mdh.link_transforms(problem.model, problem.joints_rad, deflection)
    base_from_flange, turned = np.zeros((problem.n_shots, 4, 4)), np.zeros(links.shape)
    geometry_kernels.chain_frames(links, se3.exp(state.link_twists), base_from_flange, turned)
    return base_from_flange, turned


def linearise_geometry(problem: Problem, state: State) -> Geometry:
    """Camera poses, expected centres and Jacobian columns of all shots at a state."""
    from calibrate import geometry_kernels

    layout = problem.layout
    base_from_flange, turned = corrected_chain(problem, state)
    base_from_camera = base_from_flange @ state.flange_from_camera
    centre = state.centres_in_base_mm[problem.sphere]
    lever = centre - base_from_flange[:, :3, 3]
    noise_columns = se3.point_columns(lever)
    noise = np.einsum("mij,mj->mi", noise_columns, state.pose_noise[problem.scan])
    moving_point = centre - noise
    camera_from_base_rotation = np.swapaxes(base_from_camera[:, :3, :3], -1, -2)
    rows = np.arange(problem.n_shots)
    columns = np.zeros((problem.n_shots, layout.n_camera + 4, layout.size))
    geometry_kernels.motion_columns(
        np.ascontiguousarray(camera_from_base_rotation),
        np.ascontiguousarray(base_from_flange),
        turned,
        se3.left_jacobian(state.link_twists),
        problem.load if problem.terms else np.zeros((problem.n_shots, 0, 0)),
        moving_point,
        problem.sphere,
        np.array([layout.links.start, layout.hand_eye.start, layout.terms.start, layout.centres.start]),
        columns,
    )
    k = np.arange(layout.n_camera)
    columns[:, 3 + k, layout.camera.start + k] = 1.0
    columns[:, -1, layout.radius_offset.start] = 1.0
    columns[rows, -1, layout.sphere_radius.start + problem.sphere] = 1.0
    return Geometry(
        base_from_flange=base_from_flange,
        base_from_camera=base_from_camera,
        centre_in_camera_mm=se3.apply(se3.inverse(base_from_camera), moving_point),
        columns=columns,
        noise_columns=camera_from_base_rotation @ noise_columns,
    )


def expected_radius_mm(problem: Problem, state: State) -> FloatArray:
    """(m,) radius at which each shot's sphere should read."""
    radius = problem.radius_mm + state.radius_offset_mm + state.sphere_radius_deviation_mm
    return np.asarray(radius[problem.sphere])
