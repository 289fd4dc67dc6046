"""What a robot model file may say (format spherecal-robot/1), and how it becomes a `RobotModel`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drivers.errors import FileError
from drivers.files.yaml import line_of
from drivers.kinematics.mdh import Capsule, LinearLimit, RobotModel

FORMAT = "spherecal-robot/1"

# Half a turn of doubt: no link twist or offset needs more than one full turn, so a larger number was meant in degrees.
_LARGEST_ANGLE_RAD = 6.5
# Sixteen turns; larger axis limits are degrees, too.
_LARGEST_LIMIT_RAD = 100.0
# The smallest arms on the market are 200 mm long; a chain shorter than this was written in metres.
_SHORTEST_CHAIN_MM = 20.0

Angle = Annotated[float, Field(ge=-_LARGEST_ANGLE_RAD, le=_LARGEST_ANGLE_RAD)]
Length = Annotated[float, Field(ge=-1e5, le=1e5)]
Limit = Annotated[float, Field(ge=-_LARGEST_LIMIT_RAD, le=_LARGEST_LIMIT_RAD)]
Point = tuple[Length, Length, Length]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class _Link(_Strict):
    a_mm: Length
    alpha_rad: Angle
    d_mm: Length
    theta_offset_rad: Angle = 0.0


class _LinearLimit(_Strict):
    row: list[float]
    min: Limit
    max: Limit

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check(self.min < self.max, f"min {self.min:g} is not below max {self.max:g}")
        return self


class _Capsule(_Strict):
    link: Annotated[int, Field(ge=0)]
    start_mm: Annotated[Point, Field(strict=False)]
    end_mm: Annotated[Point, Field(strict=False)]
    radius_mm: Annotated[float, Field(gt=0, le=2000)]


class RobotFile(_Strict):
    """The content of a robot model file, checked."""

    format: Literal["spherecal-robot/1"]
    name: Annotated[str, Field(min_length=1)]
    links: Annotated[list[_Link], Field(min_length=1, max_length=16)]
    coupling: list[list[float]] | None = None
    joint_limits_rad: list[Annotated[tuple[Limit, Limit], Field(strict=False)]] | None = None
    linear_limits_rad: list[_LinearLimit] = []
    source: str = ""
    shape: list[_Capsule] = []

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n = len(self.links)
        _check_coupling(self.coupling, n)
        _check_limits(self.joint_limits_rad, n)
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


def checked(data: object, *, file: str, text: str | None = None) -> RobotFile:
    """The content of a robot model file.

    Raises:
        FileError: with file, key path (and line, where the text is given), what is allowed, and a remedy.
    """
    try:
        return RobotFile.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        kind = str(first["type"])
        raise FileError(_message(first["msg"], kind), file=file, where=_where(first["loc"], text, file), remedy=_remedy(kind)) from error


def _message(message: str, kind: str) -> str:
    if kind == "extra_forbidden":
        return "this key is not known here"
    if kind == "model_type":
        return "a mapping of keys to values belongs here"
    return message.removeprefix("Value error, ").removeprefix("Assertion failed, ")


def _remedy(kind: str) -> str:
    if kind == "extra_forbidden":
        return f"Allowed are {', '.join(RobotFile.model_fields)}; in a link a_mm, alpha_rad, d_mm, theta_offset_rad."
    if kind in ("greater_than_equal", "less_than_equal"):
        return "Lengths are mm and angles rad: was it written in degrees or metres?"
    return f"See `robot model` in docs/ for the format {FORMAT}."


def _where(location: Sequence[str | int], text: str | None, file: str) -> str | None:
    path = ".".join(str(part) for part in location)
    line = line_of(text, location, file=file) if text is not None and location else None
    return ", ".join(part for part in (path, "" if line is None else f"line {line}") if part) or None


def _check(good: bool, message: str) -> None:
    if not good:
        raise ValueError(message)


def _check_coupling(coupling: list[list[float]] | None, n: int) -> None:
    if coupling is None:
        return
    _check(len(coupling) == n and all(len(row) == n for row in coupling), f"coupling must be {n} rows of {n} numbers")
    _check(np.linalg.cond(np.array(coupling, dtype=np.float64)) < 1e6, "coupling cannot be inverted")


def _check_limits(limits: Sequence[tuple[float, float]] | None, n: int) -> None:
    if limits is None:
        return
    _check(len(limits) == n, f"joint_limits_rad has {len(limits)} pairs, the robot {n} axes")
    for i, (low, high) in enumerate(limits):
        _check(low < high, f"joint_limits_rad.{i}: {low:g} is not below {high:g}")
