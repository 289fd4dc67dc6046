"""The cell file: robot, camera, spheres, certified lengths, limits, and what stands around (DESIGN section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from acquire.obstacles import Obstacle
from drivers.errors import FileError
from drivers.files.disk import decode_text, read_bytes, sha256_hex
from drivers.files.schema import Corners, NotNegative, Pair, Positive, StrictModel, Text, TextPair, Transform, Vector3, check
from drivers.files.session import Session
from drivers.files.yaml import parse_yaml
from drivers.kinematics.mdh import RobotModel
from drivers.models import load_robot_model, parse_robot_model
from drivers.protocols import Devices
from drivers.registry import make_devices

CELL_FORMAT = "spherecal-cell/1"
_SMALLEST_DIAMETER_MM = 1.0
Expansion = Annotated[float, Field(gt=-1e-4, lt=1e-3)]
"""Per kelvin. Steel is 11.5e-6: the bounds catch a forgotten 1e-6."""
Celsius = Annotated[float, Field(gt=-100, lt=100)]


class _Device(StrictModel):
    model_config = ConfigDict(extra="allow")

    driver: Text

    @property
    def settings(self) -> Mapping[str, object]:
        """The driver's own keys, checked by the driver when a device is made."""
        return dict(self.__pydantic_extra__ or {})


class RobotSection(_Device):
    """Which driver moves the robot, and which model describes it."""

    model: Text | None


class CameraSection(_Device):
    """Which driver reads the camera, and what it can see."""

    kind: Literal["area", "line_profile"] = "area"
    working_range_mm: Pair | None = None
    field_of_view_deg: Pair | None = None
    sight_crossing_mm: Vector3 | None = None
    """Where the two lines of sight cross (METHOD 1, S), in the camera frame."""

    @field_validator("working_range_mm")
    @classmethod
    def _range_rises(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        _require(value is None or 0 <= value[0] < value[1], "the nearest distance must come first, from 0 on")
        return value

    @field_validator("field_of_view_deg")
    @classmethod
    def _view_is_an_angle(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        _require(value is None or all(0 < angle < 180 for angle in value), "full angles across and down, between 0 and 180 degrees")
        return value


class Sphere(StrictModel):
    """A certified sphere at one place."""

    diameter_mm: Positive
    expanded_uncertainty_mm: NotNegative
    """Of the diameter, k = 2."""
    centre_in_base_mm: Vector3 | None = None
    certificate: str | None = None
    form_mm: NotNegative | None = None
    cte_per_k: Expansion | None = None
    reference_temperature_c: Celsius | None = None
    """Where the diameter holds; 20 degrees C where it is not told."""

    @field_validator("diameter_mm")
    @classmethod
    def _is_in_mm(cls, value: float) -> float:
        _require(value >= _SMALLEST_DIAMETER_MM, f"{value:g} mm is no sphere that a camera can measure (is it in metres?)")
        return value

    @property
    def radius_mm(self) -> float:
        """Half the certified diameter."""
        return self.diameter_mm / 2

    @property
    def radius_standard_uncertainty_mm(self) -> float:
        """One sigma of the radius: U/2 of the diameter, halved."""
        return self.expanded_uncertainty_mm / 4


class CertifiedLength(StrictModel):
    """A certified distance between two sphere centres."""

    between: TextPair
    length_mm: Positive
    expanded_uncertainty_mm: Positive
    """k = 2."""
    cte_per_k: Expansion | None = None
    """Without it the length is taken as it is, whatever the temperature."""
    reference_temperature_c: Celsius = 20.0

    @property
    def standard_uncertainty_mm(self) -> float:
        """One sigma: U/2."""
        return self.expanded_uncertainty_mm / 2


class Limits(StrictModel):
    """What `pass` and `conform` mean in this cell."""

    centre_rms_mm: Positive
    length_error_mm: Positive
    diameter_error_mm: Positive
    form_mm: Positive
    guard: Literal["reference_and_repeat", "reference"] = "reference_and_repeat"
    """What the guard band of a verification holds: see `measure.decision`."""

    @model_serializer(mode="wrap")
    def _as_written(self, plain: SerializerFunctionWrapHandler) -> dict[str, object]:
        """Without a guard that nobody chose: files of older versions, and their digests, stay what they were."""
        return {key: value for key, value in plain(self).items() if key != "guard" or self.guard != "reference_and_repeat"}


class Motion(StrictModel):
    """How the capture run moves and waits."""

    speed_rad_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    settle_s: Annotated[float, Field(ge=0, le=600)] = 0.5
    frames: Annotated[int, Field(ge=1, le=100)] = 1


class Suspend(StrictModel):
    """What suspends a capture run besides trouble with robot and camera; null never does."""

    missing_spheres: Annotated[int, Field(ge=1)] | None = 3
    """Shots in a row in which one sphere is not found."""
    temperature_drift_k: Positive | None = 5.0
    """Of the camera, from the run's first shot on."""


Scalar = str | int | float | bool | None


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


class Cell(StrictModel):
    """A checked cell file."""

    format: Literal["spherecal-cell/1"]
    name: Text
    robot: RobotSection
    camera: CameraSection
    flange_from_camera: Transform | None
    """(4, 4) first guess, or None."""
    spheres: dict[Text, Sphere]
    lengths: Annotated[tuple[CertifiedLength, ...], BeforeValidator(_as_tuple)] = ()
    limits: Limits | None = None
    work_volume_mm: Corners | None = None
    obstacles: Annotated[tuple[Obstacle, ...], BeforeValidator(_as_tuple)] = ()
    motion: Motion = Motion()
    suspend: Suspend = Suspend()
    identity: dict[str, Scalar] = Field(default_factory=dict)
    identity_mismatch: dict[Text, Literal["refuse", "mark"]] = Field(default_factory=dict)
    """What happens where a calibration was made with something else under this key of `identity`."""

    _path: Path = PrivateAttr(default=Path("cell.yaml"))
    _data: bytes = PrivateAttr(default=b"")

    @field_validator("work_volume_mm")
    @classmethod
    def _volume_is_a_box(cls, value: Corners | None) -> Corners | None:
        _require(value is None or all(low < high for low, high in zip(*value, strict=True)), "the lower corner must come first, then the upper one")
        return value

    @model_validator(mode="after")
    def _lengths_name_spheres(self) -> Self:
        known = ", ".join(self.spheres) or "none"
        for i, length in enumerate(self.lengths):
            first, second = length.between
            for name in (first, second):
                _require(name in self.spheres, f"lengths.{i}.between names {name!r}, which is no sphere of this cell (spheres: {known})")
            _require(first != second, f"lengths.{i}.between names {first!r} twice")
        return self

    @property
    def path(self) -> Path:
        """The file this cell was read from."""
        return self._path

    @property
    def folder(self) -> Path:
        """The folder that relative paths in the cell start from."""
        return self._path.parent

    @property
    def data(self) -> bytes:
        """The file's bytes, for verbatim copies."""
        return self._data

    @property
    def sha256(self) -> str:
        """Digest of the file's bytes."""
        return sha256_hex(self._data)

    @property
    def work_volume_box_mm(self) -> NDArray[np.float64] | None:
        """(2, 3) lower and upper corner in the base, or None."""
        return None if self.work_volume_mm is None else np.array(self.work_volume_mm)


def load_cell(path: str | Path) -> Cell:
    """Read and check a cell file.

    Raises:
        FileError: with key path and line, what was found and what is allowed.
    """
    return parse_cell(read_bytes(path), path=Path(path))


def parse_cell(data: bytes, *, path: Path) -> Cell:
    """The cell in the bytes of a cell file; relative paths in it start from the folder of `path`.

    Raises:
        FileError: as `load_cell`.
    """
    text = decode_text(data, file=path)
    plain = parse_yaml(text, file=path)
    if not isinstance(plain, dict):
        raise FileError("holds no keys", file=path, remedy=f"A cell file begins with `format: {CELL_FORMAT}`.")
    cell = check(Cell, plain, file=str(path), text=text)
    cell._path, cell._data = path, data  # noqa: SLF001 - the file it came from is no key of it
    return cell


def cell_of_session(session: Session) -> Cell:
    """The cell that a session was recorded in.

    Raises:
        FileError: as `load_cell`.
    """
    return load_cell(session.cell_path)


def robot_model_of(cell: Cell, session: Session | None = None) -> RobotModel | None:
    """The nominal robot: a session's own copy wins, then the cell's model by shipped name or path; None if it has none.

    Raises:
        FileError: the model is missing or broken.
    """
    if session is not None and session.robot_model_path is not None:
        text = decode_text(read_bytes(session.robot_model_path), file=session.robot_model_path)
        return parse_robot_model(text, file=str(session.robot_model_path))
    return None if cell.robot.model is None else load_robot_model(cell.robot.model, relative_to=cell.folder)


def devices_of(cell: Cell) -> Devices:
    """The robot and the camera of a cell, made but not opened.

    Raises:
        SettingsError: an unknown driver, or settings that it does not take.
        FileError: a file named in the settings is missing or broken.
    """
    return make_devices(
        robot_driver=cell.robot.driver,
        robot_settings=cell.robot.settings,
        camera_driver=cell.camera.driver,
        camera_settings=cell.camera.settings,
        robot_model=robot_model_of(cell),
        folder=cell.folder,
    )


def _require(good: bool, message: str) -> None:
    if not good:
        raise ValueError(message)
