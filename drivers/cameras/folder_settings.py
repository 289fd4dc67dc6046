"""The settings of the driver `folder`."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import Annotated

from pydantic import Field, model_validator

from drivers.cameras.settings import AxesSetting, CameraSettings, Seconds, Size, TextList, Unit
from drivers.files.schema import Text


class FolderSettings(CameraSettings):
    """Where scans appear, what they hold, and how one is triggered."""

    folder: Annotated[Text, Field(description="the folder that the camera's software exports to, relative to the cell file")]
    unit: Annotated[Unit, Field(description="the unit of the exported files: mm, m, um or inch (nothing in a file tells it)")]
    axes: Annotated[AxesSetting, Field(description="optical (default), graphics, unity, robot, or what is right, down and out as [x, -y, -z]")] = (
        "optical"
    )
    pattern: Annotated[Text | TextList, Field(description="names of the scans, e.g. '*.ply'; by default any PLY, PCD or NPZ")] = (
        "*.ply",
        "*.pcd",
        "*.npz",
    )
    grid: Annotated[Size | None, Field(description="[width, height] of organised scans whose files do not tell it")] = None
    stable_s: Annotated[Seconds, Field(description="how long a file must not have changed to count as whole, 0 to 60 s (default 0.5)")] = 0.5
    command: Annotated[TextList | None, Field(description="program and arguments that trigger a scan; {path} is where it shall be written")] = None
    trigger_file: Annotated[Text | None, Field(description="a file that is written to trigger a scan, relative to the folder")] = None

    @model_validator(mode="after")
    def _one_trigger(self) -> FolderSettings:
        if self.command is not None and (self.trigger_file is not None or not self.command):
            msg = "one trigger is allowed: a command with its arguments, or a trigger_file"
            raise ValueError(msg)
        if self.trigger_file is not None and any(fnmatch(self.trigger_file.lower(), pattern.lower()) for pattern in self.patterns):
            msg = f"the trigger_file {self.trigger_file} would be taken for a scan"
            raise ValueError(msg)
        return self

    @property
    def patterns(self) -> tuple[str, ...]:
        """The patterns, one or several, as a tuple."""
        return (self.pattern,) if isinstance(self.pattern, str) else self.pattern

    @property
    def names_its_file(self) -> bool:
        """Whether the trigger says where the scan shall be written."""
        return self.command is not None and any("{path}" in word for word in self.command)
