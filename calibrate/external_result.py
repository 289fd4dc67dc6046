"""What external points leave in a calibration: frames and targets with their covariance, and how well each shot fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from calibrate.datum import Datum, base_motion
from calibrate.external_points import ExternalPoints
from calibrate.external_solve import rms_mm, rows_without_pose_noise
from calibrate.problem import Problem, State
from drivers.kinematics import se3
from drivers.kinematics.se3 import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ExternalFrame:
    """Where an external reference stands."""

    base_from_reference: FloatArray
    """(4, 4) in the stated base."""
    covariance: FloatArray
    """(6, 6) of a left twist (mm, rad) in the stated base."""


@dataclass(frozen=True, slots=True, eq=False)
class ExternalTarget:
    """A point of the flange that an external reference sees."""

    point_in_flange_mm: FloatArray
    """(3,)"""
    covariance_mm2: FloatArray
    """(3, 3)"""


@dataclass(frozen=True, slots=True, eq=False)
class ExternalShotResult:
    """One external point that the calibration was made from."""

    session: str
    index: int
    reference: str
    target: str
    point_in_reference_mm: FloatArray
    """(3,) as measured."""
    residual_mm: FloatArray
    """(3,) robot's less reference's place of the target, stated base."""
    predicted_error_mm: float | None
    """Distance from where a solve without this shot expects the target."""
    joints_rad: FloatArray | None = None
    """(n,) where the robot stood; None in files of older versions."""


@dataclass(frozen=True, slots=True, eq=False)
class ExternalResult:
    """External points in a calibration."""

    references: Mapping[str, ExternalFrame]
    targets: Mapping[str, ExternalTarget]
    train_rms_mm: float
    """Rms length of the residuals, no pose noise taken out."""
    cross_validated_rms_mm: float | None
    """The same of points left out; None where nothing could be left out."""
    predicted_rms_mm: float
    """First-order prediction of it."""
    shots: tuple[ExternalShotResult, ...]
    compared: Mapping[str, float] = field(default_factory=dict)
    """Held-out rms (mm) of external points alone with a rigid arm and with one that yields under gravity."""

    def to_json_dict(self) -> dict[str, object]:
        """What `spherecal calibrate --json` prints of it."""
        return {
            "n_shots": len(self.shots),
            "references": list(self.references),
            "targets": {name: target.point_in_flange_mm.tolist() for name, target in self.targets.items()},
            "train_rms_mm": self.train_rms_mm,
            "cross_validated_rms_mm": self.cross_validated_rms_mm,
            "compared": dict(self.compared),
        }


def external_result(
    problem: Problem,
    state: State,
    datum: Datum,
    covariance: FloatArray,
    held_out_mm: FloatArray,
    predicted: float,
    compared: Mapping[str, float] | None = None,
) -> ExternalResult | None:
    """Frames, targets and residuals of a solve in the stated base; None where no external point took part.

    Args:
        problem: with its external points.
        state: solved.
        datum: the stated base.
        covariance: (P, P), scaled on held-out shots.
        held_out_mm: (E, 3) of `held_out_errors`.
        predicted: of `predicted_rms_mm`.
        compared: held-out rms of the arms that were tried.
    """
    points, layout = problem.external, problem.layout
    if points is None or not points.n_shots:
        return None
    residual = rows_without_pose_noise(problem, state).residual_mm
    held_out = np.linalg.norm(held_out_mm, axis=1)
    frames = {name: _frame(problem, state, datum, covariance, i) for i, name in enumerate(points.references) if bool((points.reference == i).any())}
    targets = {}
    for i, name in enumerate(points.targets):
        at = slice(layout.targets.start + 3 * i, layout.targets.start + 3 * i + 3)
        if bool((points.target == i).any()):
            targets[name] = ExternalTarget(state.target_in_flange_mm[i], covariance[at, at])
    rms = rms_mm(held_out_mm)
    return ExternalResult(
        references=frames,
        targets=targets,
        train_rms_mm=rms_mm(residual),
        cross_validated_rms_mm=rms if np.isfinite(rms) else None,
        predicted_rms_mm=predicted,
        shots=tuple(
            ExternalShotResult(
                session=shot.session,
                index=shot.index,
                reference=shot.reference,
                target=shot.target,
                point_in_reference_mm=shot.point_in_reference_mm,
                residual_mm=datum.base_from_solver[:3, :3] @ residual[i],
                predicted_error_mm=float(held_out[i]) if np.isfinite(held_out[i]) else None,
                joints_rad=shot.joints_rad,
            )
            for i, shot in enumerate(points.shots)
        ),
        compared=compared or {},
    )


def _frame(problem: Problem, state: State, datum: Datum, covariance: FloatArray, index: int) -> ExternalFrame:
    """A frame in the stated base; that base follows the parameters, and the frame with it."""
    layout = problem.layout
    own = np.arange(layout.references.start + 6 * index, layout.references.start + 6 * index + 6)
    used = np.concatenate([np.arange(layout.n_geometric), own])
    between = layout.terms.start - layout.links.stop
    of_base = base_motion(datum, problem.model, state.link_twists, between, problem.terms, state.terms_rad)
    jacobian = se3.adjoint(datum.base_from_solver) @ np.concatenate([of_base, np.eye(6)], axis=1)
    return ExternalFrame(datum.base_from_solver @ state.base_from_reference[index], jacobian @ covariance[np.ix_(used, used)] @ jacobian.T)


def external_names(points: ExternalPoints | None) -> tuple[str, ...]:
    """Names of the unknowns of external points, with their units."""
    if points is None:
        return ()
    twist = ("rho_x_mm", "rho_y_mm", "rho_z_mm", "phi_x_rad", "phi_y_rad", "phi_z_rad")
    frames = [f"reference.{name}.{part}" for name in points.references for part in twist]
    return (*frames, *(f"target.{name}.{axis}_mm" for name in points.targets for axis in "xyz"))


def external_data(external: ExternalResult) -> dict[str, object]:
    """Plain data for calibration.yaml."""
    return {
        "references": {
            name: {"base_from_reference": frame.base_from_reference, "covariance": frame.covariance} for name, frame in external.references.items()
        },
        "targets": {
            name: {"point_in_flange_mm": target.point_in_flange_mm, "covariance_mm2": target.covariance_mm2}
            for name, target in external.targets.items()
        },
        "train_rms_mm": external.train_rms_mm,
        "cross_validated_rms_mm": external.cross_validated_rms_mm,
        "predicted_rms_mm": external.predicted_rms_mm,
        "compared": dict(external.compared),
        "shots": [{name: getattr(shot, name) for name in shot.__slots__} for shot in external.shots],
    }


def external_from_data(data: Mapping[str, object]) -> ExternalResult:
    """Back from the plain data; KeyError, TypeError or ValueError where it is incomplete."""
    return ExternalResult(
        references={
            name: ExternalFrame(_array(frame["base_from_reference"], 4, 4), _array(frame["covariance"], 6, 6))
            for name, frame in _named(data["references"])
        },
        targets={
            name: ExternalTarget(_array(target["point_in_flange_mm"], 3), _array(target["covariance_mm2"], 3, 3))
            for name, target in _named(data["targets"])
        },
        train_rms_mm=float(_array(data["train_rms_mm"])),
        cross_validated_rms_mm=_number(data["cross_validated_rms_mm"]),
        predicted_rms_mm=float(_array(data["predicted_rms_mm"])),
        shots=tuple(_shot(shot) for shot in _list(data["shots"])),
        compared={name: float(_array(value)) for name, value in _mapping(data["compared"]).items()},
    )


def _shot(data: object) -> ExternalShotResult:
    if not isinstance(data, dict):
        raise TypeError("a shot without keys")
    return ExternalShotResult(
        session=str(data["session"]),
        index=int(str(data["index"])),
        reference=str(data["reference"]),
        target=str(data["target"]),
        point_in_reference_mm=_array(data["point_in_reference_mm"], 3),
        residual_mm=_array(data["residual_mm"], 3),
        predicted_error_mm=_number(data["predicted_error_mm"]),
        joints_rad=None if data.get("joints_rad") is None else np.asarray(data["joints_rad"], dtype=np.float64),
    )


def _mapping(value: object) -> Mapping[str, object]:
    if not isinstance(value, dict):
        raise TypeError("keys are needed")
    return value


def _named(value: object) -> list[tuple[str, Mapping[str, object]]]:
    return [(name, _mapping(item)) for name, item in _mapping(value).items()]


def _list(value: object) -> list[object]:
    if not isinstance(value, list):
        raise TypeError("a list is needed")
    return value


def _array(value: object, *shape: int) -> FloatArray:
    if value is None:
        raise ValueError("null where a number is needed")
    return np.asarray(value, dtype=np.float64).reshape(shape)


def _number(value: object) -> float | None:
    return None if value is None else float(_array(value))
