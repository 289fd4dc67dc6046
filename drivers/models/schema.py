"""What a robot model file may say (format spherecal-robot/1), and how it becomes a `RobotModel`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from drivers.files.schema import Pair, StrictModel, Text, Vector3
from drivers.kinematics.mdh import Capsule, LinearLimit, RobotModel

# No link twist or offset needs more than one full turn, so a larger number was meant in degrees.
_LARGEST_ANGLE_RAD = 6.5
# Sixteen turns; larger axis limits are degrees, too.
_LARGEST_LIMIT_RAD = 100.0
_LARGEST_LENGTH_MM = 1e5
# The smallest arms on the market are 200 mm long; a chain shorter than this was written in metres.
_SHORTEST_CHAIN_MM = 20.0


def _angle(value: float) -> float:
    _check(abs(value) <= _LARGEST_ANGLE_RAD, f"{value:g} is no angle of a link in rad (was it written in degrees?)")
    return value


def _limit(value: float) -> float:
    _check(abs(value) <= _LARGEST_LIMIT_RAD, f"{value:g} is no axis limit in rad (was it written in degrees?)")
    return value


def _limits(value: tuple[float, float]) -> tuple[float, float]:
    low, high = map(_limit, value)
    _check(low < high, f"{low:g} is not below {high:g}")
    return value


def _length(value: float) -> float:
    _check(abs(value) <= _LARGEST_LENGTH_MM, f"{value:g} mm is longer than any robot")
    return value


def _check(good: bool, message: str) -> None:
    if not good:
        raise ValueError(message)


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


Angle = Annotated[float, AfterValidator(_angle)]
Length = Annotated[float, AfterValidator(_length)]


class _Link(StrictModel):
    a_mm: Length
    alpha_rad: Angle
    d_mm: Length
    theta_offset_rad: Angle = 0.0


class _LinearLimit(StrictModel):
    row: list[float]
    min: Annotated[float, AfterValidator(_limit)]
    max: Annotated[float, AfterValidator(_limit)]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check(self.min < self.max, f"min {self.min:g} is not below max {self.max:g}")
        return self


class _Capsule(StrictModel):
    link: Annotated[int, Field(ge=0)]
    start_mm: Vector3
    end_mm: Vector3
    radius_mm: Annotated[float, Field(gt=0, le=2000)]


class RobotFile(StrictModel):
    """The content of a robot model file, checked."""

    format: Literal["spherecal-robot/1"]
    name: Text
    links: Annotated[list[_Link], Field(min_length=1, max_length=16)]
    coupling: list[list[float]] | None = None
    joint_limits_rad: list[Annotated[Pair, AfterValidator(_limits)]] | None = None
    linear_limits_rad: Annotated[tuple[_LinearLimit, ...], BeforeValidator(_as_tuple)] = ()
    source: str = ""
    shape: Annotated[tuple[_Capsule, ...], BeforeValidator(_as_tuple)] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n = len(self.links)
        _check_coupling(self.coupling, n)
        limits = self.joint_limits_rad
        _check(limits is None or len(limits) == n, f"joint_limits_rad has {len(limits or ())} pairs, the robot {n} axes")
        for i, linear in enumerate(self.linear_limits_rad):
            _check(len(linear.row) == n, f"linear_limits_rad.{i}.row has {len(linear.row)} numbers, the robot {n} axes")
        for i, capsule in enumerate(self.shape):
            _check(capsule.link <= n, f"shape.{i}.link is {capsule.link}, the last link is {n}")
        reach_mm = sum(abs(link.a_mm) + abs(link.d_mm) for link in self.links)
        _check(reach_mm >= _SHORTEST_CHAIN_MM, f"all links together are {reach_mm:g} mm long; lengths must be in mm, these look like metres")
        return self

    def model(self, text: str) -> RobotModel:
        """The model; `text` is the YAML that it was read from."""
        n = len(self.links)
        limits = self.joint_limits_rad or [(-np.inf, np.inf)] * n
        return RobotModel(
            name=self.name,
            a_mm=np.array([link.a_mm for link in self.links]),
            alpha_rad=np.array([link.alpha_rad for link in self.links]),
            d_mm=np.array([link.d_mm for link in self.links]),
            theta_offset_rad=np.array([link.theta_offset_rad for link in self.links]),
            coupling=np.eye(n) if self.coupling is None else np.array(self.coupling, dtype=np.float64),
            joint_limits_rad=np.array(limits, dtype=np.float64),
            linear_limits=tuple(LinearLimit(np.array(limit.row), limit.min, limit.max) for limit in self.linear_limits_rad),
            shape=tuple(Capsule(part.link, part.start_mm, part.end_mm, part.radius_mm) for part in self.shape),
            source=self.source,
            text=text,
        )


def _check_coupling(coupling: Sequence[Sequence[float]] | None, n: int) -> None:
    if coupling is None:
        return
    _check(len(coupling) == n and all(len(row) == n for row in coupling), f"coupling must be {n} rows of {n} numbers")
    _check(np.linalg.cond(np.array(coupling, dtype=np.float64)) < 1e6, "coupling cannot be inverted")
