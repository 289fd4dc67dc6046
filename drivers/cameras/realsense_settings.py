"""The settings of the driver `realsense`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from drivers.cameras.settings import CameraSettings, Size
from drivers.files.schema import Text


class RealsenseSettings(CameraSettings):
    """The settings of the driver `realsense`."""

    recording: Annotated[Text | None, Field(description="a recording (.db3) that is replayed instead of a camera")] = None
    size: Annotated[Size | None, Field(description="[width, height] of the depth stream; the camera's default otherwise")] = None
    fps: Annotated[int | None, Field(gt=0, description="frames per second of the depth stream")] = None
    depth_unit_mm: Annotated[float | None, Field(gt=0, le=1, description="step of the depths in mm, above 0 and up to 1; 0.1 or finer is wanted")] = (
        None
    )
    options: Annotated[dict[Text, float], Field(description="options of the depth sensor by their names, e.g. exposure: 8500")] = Field(
        default_factory=dict
    )
    discard_frames: Annotated[int, Field(ge=1, le=60, description="frames to let pass before one is taken, 1 to 60 (default 4)")] = 4

    @model_validator(mode="after")
    def _which(self) -> RealsenseSettings:
        if self.serial is None and self.recording is None:
            msg = "the camera's serial number is needed, or a recording"
            raise ValueError(msg)
        return self
