"""The drivers' own keys of a cell file's `camera` section, checked by pydantic models and told as SettingsErrors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, TypeVar

from pydantic import BeforeValidator, Field, ValidationError

from drivers.errors import SettingsError
from drivers.files.schema import StrictModel, Text

Unit = Literal["mm", "m", "um", "inch"]


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


AxesSetting = Annotated[Text | tuple[Text, Text, Text], BeforeValidator(_as_tuple)]
TextList = Annotated[tuple[Text, ...], BeforeValidator(_as_tuple)]
Size = Annotated[tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]], BeforeValidator(_as_tuple)]
Seconds = Annotated[float, Field(ge=0, le=60)]


class CameraSettings(StrictModel):
    """What every driver's section may say of things that the device does not tell by itself."""

    serial: Text | None = None
    model: Text | None = None
    preset: Text | None = None
    """A name for what was set in the vendor's own software; part of the identity."""
    onboard_correction: Text | None = None


Model = TypeVar("Model", bound=CameraSettings)


def parse_settings(model: type[Model], settings: Mapping[str, object], driver: str) -> Model:
    """Checked settings.

    Raises:
        SettingsError: an unknown key, a missing one or a wrong value, with what is allowed.
    """
    try:
        return model.model_validate(dict(settings))
    except ValidationError as error:
        first = min(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
        key = str(first["loc"][0]) if first["loc"] else ""
        where = f"camera.{key}" if key else f"camera (driver {driver})"
        raise SettingsError(_found(first["type"], first["msg"], key, driver), where=where, remedy=_remedy(model, first["type"], key)) from error


def _found(kind: str, text: str, key: str, driver: str) -> str:
    if kind == "extra_forbidden":
        return f"unknown setting {key!r} of the driver {driver}"
    if kind == "missing":
        return f"the driver {driver} needs the setting {key!r}"
    return text.removeprefix("Value error, ").replace("Input should be", "it must be")


def _remedy(model: type[CameraSettings], kind: str, key: str) -> str:
    if kind == "extra_forbidden":
        return f"Allowed: {', '.join(model.model_fields)}."
    told = model.model_fields[key].description if key in model.model_fields else None
    return f"{key}: {told}." if told else "Correct the value."
