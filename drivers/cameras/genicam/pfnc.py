"""Pixel formats of the GenICam Pixel Format Naming Convention (PFNC 2.4), as far as 3D cameras send them.

Packed formats (10p, 12p) are not among them: a camera is set to another one.
"""

from __future__ import annotations

from dataclasses import dataclass

_BYTES = {"u1": 1, "<u2": 2, "<f4": 4}


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """How the bytes of one part are laid out, little-endian."""

    name: str
    code: int
    dtype: str
    channels: int = 1
    planar: bool = False
    bits: int = 8
    """Significant bits of brightness."""

    @property
    def n_bytes_per_pixel(self) -> int:
        """Over all channels."""
        return _BYTES[self.dtype] * self.channels


_ALL = (
    PixelFormat("Coord3D_ABC8", 0x021800B2, "u1", 3),
    PixelFormat("Coord3D_ABC8_Planar", 0x021800B3, "u1", 3, planar=True),
    PixelFormat("Coord3D_ABC16", 0x023000B9, "<u2", 3),
    PixelFormat("Coord3D_ABC16_Planar", 0x023000BA, "<u2", 3, planar=True),
    PixelFormat("Coord3D_ABC32f", 0x026000C0, "<f4", 3),
    PixelFormat("Coord3D_ABC32f_Planar", 0x026000C1, "<f4", 3, planar=True),
    *(PixelFormat(f"Coord3D_{axis}8", 0x010800AF + i, "u1") for i, axis in enumerate("ABC")),
    *(PixelFormat(f"Coord3D_{axis}16", 0x011000B6 + i, "<u2") for i, axis in enumerate("ABC")),
    *(PixelFormat(f"Coord3D_{axis}32f", 0x012000BD + i, "<f4") for i, axis in enumerate("ABC")),
    PixelFormat("Confidence8", 0x010800C6, "u1"),
    PixelFormat("Confidence16", 0x011000C7, "<u2"),
    PixelFormat("Confidence32f", 0x012000C8, "<f4"),
    PixelFormat("Mono8", 0x01080001, "u1"),
    PixelFormat("Mono10", 0x01100003, "<u2", bits=10),
    PixelFormat("Mono12", 0x01100005, "<u2", bits=12),
    PixelFormat("Mono14", 0x01100025, "<u2", bits=14),
    PixelFormat("Mono16", 0x01100007, "<u2", bits=16),
    PixelFormat("RGB8", 0x02180014, "u1", 3),
    PixelFormat("BGR8", 0x02180015, "u1", 3),
    PixelFormat("RGBa8", 0x02200016, "u1", 4),
    PixelFormat("BGRa8", 0x02200017, "u1", 4),
)

FORMATS = {pixel_format.name: pixel_format for pixel_format in _ALL}
_NAMES = {pixel_format.code: pixel_format.name for pixel_format in _ALL}


def name_of(code: int) -> str:
    """The name of a format's code, the code in hex where it is none of these."""
    return _NAMES.get(code, f"0x{code:08X}")
