"""The settings of the driver `genicam`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.cameras.genicam.transport import Transport
from drivers.cameras.settings import AxesSetting, CameraSettings
from drivers.files.schema import Text

Scalar = str | int | float | bool


class GenicamSettings(CameraSettings):
    """Which camera, and what is set before it is used."""

    address: Annotated[Text | None, Field(description="IPv4 address of a GigE Vision camera (through Aravis); this or producer")] = None
    producer: Annotated[Text | None, Field(description="a GenTL producer, PATH.cti (through harvesters); needs serial")] = None
    producer_may_broadcast: Annotated[bool, Field(description="allow a GigE Vision producer to look for cameras on the network")] = False
    user_set: Annotated[Text | None, Field(description="user set of the camera that is loaded first, e.g. Default or UserSet1")] = None
    features: Annotated[dict[Text, Scalar], Field(description="further features, set in this order")] = Field(default_factory=dict)
    pixel_format: Annotated[Text | None, Field(description="Coord3D_ABC32f where the camera has it; None leaves it")] = "Coord3D_ABC32f"
    trigger: Annotated[
        Literal["software", "start"], Field(description="software: TriggerSoftware; start: every capture starts and stops the acquisition")
    ] = "software"
    axes: Annotated[AxesSetting, Field(description="optical (default), graphics, unity, robot, or what is right, down and out as [x, -y, -z]")] = (
        "optical"
    )
    packet_size: Annotated[int | None, Field(ge=220, le=16000, description="bytes of a GigE Vision stream packet, 220 to 16000")] = None
    packet_delay_ns: Annotated[int | None, Field(ge=0, le=10_000_000, description="pause between GigE Vision stream packets, ns")] = None

    @model_validator(mode="after")
    def _one_way(self) -> GenicamSettings:
        if (self.address is None) == (self.producer is None):
            msg = "exactly one of address (GigE Vision) and producer (GenTL) is needed"
            raise ValueError(msg)
        if self.producer is not None and self.serial is None:
            msg = "a producer needs the camera's serial number"
            raise ValueError(msg)
        return self


def transport_of(settings: GenicamSettings, folder: Path) -> Transport:
    """The way to the camera; nothing is loaded or connected yet."""
    if settings.address is not None:
        from drivers.cameras.genicam.aravis import AravisTransport

        return AravisTransport(settings.address, packet_size=settings.packet_size, packet_delay_ns=settings.packet_delay_ns)
    from drivers.cameras.genicam.gentl import GentlTransport

    return GentlTransport(folder / str(settings.producer), str(settings.serial), may_broadcast=settings.producer_may_broadcast)
