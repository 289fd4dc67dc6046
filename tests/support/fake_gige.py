"""Aravis' fake GigE Vision camera on loopback, made to send 3D coordinates and to misbehave on order.

Its GenICam description is Aravis' own with Coord3D_ABC32f and the Scan3dControl features added, and its pixels come from
a callback of ours. It listens on 127.0.0.1, at the one port of the protocol: a lock keeps test processes apart.
"""

from __future__ import annotations

import ctypes
import fcntl
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import CFUNCTYPE, byref, c_char_p, c_double, c_int, c_size_t, c_uint32, c_void_p
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras.genicam.aravis_library import load
from drivers.errors import CameraSdkMissing

ADDRESS = "127.0.0.1"
ABC32F = 0x026000C0
_LOCK = Path(tempfile.gettempdir()) / "spherecal-fake-gige.lock"
_FILL = CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
_WIDTH, _HEIGHT, _ACQUISITION, _PIXEL_FORMAT, _SOFTWARE_TRIGGER = 0x100, 0x104, 0x124, 0x128, 0x30C
_UNIT, _REFERENCE, _MODE, _INVALID_FLAG = 0x8000, 0x8004, 0x8008, 0x800C
_SCALE, _OFFSET, _INVALID, _TEMPERATURE, _STEP = 0x8100, 0x8200, 0x8300, 0x8400, 0x20
_GENICAM = 'NameSpace="Standard"'


def _enumeration(name: str, address: int, entries: tuple[str, ...]) -> str:
    values = "".join(f'<EnumEntry Name="{entry}" {_GENICAM}><Value>{i}</Value></EnumEntry>' for i, entry in enumerate(entries))
    register = f'<IntReg Name="{name}Register"><Address>{address:#x}</Address><Length>4</Length><AccessMode>RW</AccessMode>'
    register += "<pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    return f'<Enumeration Name="{name}" {_GENICAM}>{values}<pValue>{name}Register</pValue></Enumeration>{register}'


def _float(name: str, address: int) -> str:
    register = f'<FloatReg Name="{name}Register"><Address>{address:#x}</Address><pIndex Offset="{_STEP:#x}">Scan3dAxis</pIndex><Length>8</Length>'
    register += "<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></FloatReg>"
    return f'<Float Name="{name}" {_GENICAM}><pValue>{name}Register</pValue></Float>{register}'


def _description(plain: str) -> str:
    axes = "".join(f'<EnumEntry Name="Coordinate{axis}" {_GENICAM}><Value>{i}</Value></EnumEntry>' for i, axis in enumerate("ABC"))
    nodes = [
        _enumeration("Scan3dDistanceUnit", _UNIT, ("Millimeter", "Inch", "Pixel")),
        _enumeration("Scan3dCoordinateSystemReference", _REFERENCE, ("Anchor", "Transformed")),
        _enumeration("Scan3dOutputMode", _MODE, ("CalibratedABC_Grid", "UncalibratedC")),
        _enumeration("Scan3dInvalidDataFlag", _INVALID_FLAG, ("false", "true")),
        f'<Enumeration Name="Scan3dCoordinateSelector" {_GENICAM}>{axes}<pValue>Scan3dAxis</pValue></Enumeration>',
        '<Integer Name="Scan3dAxis"><Value>0</Value></Integer>',
        _float("Scan3dCoordinateScale", _SCALE),
        _float("Scan3dCoordinateOffset", _OFFSET),
        _float("Scan3dInvalidDataValue", _INVALID),
        f'<Float Name="DeviceTemperature" {_GENICAM}><pValue>DeviceTemperatureRegister</pValue></Float>',
        f'<FloatReg Name="DeviceTemperatureRegister"><Address>{_TEMPERATURE:#x}</Address><Length>8</Length><AccessMode>RO</AccessMode>'
        "<pPort>Device</pPort><Endianess>BigEndian</Endianess></FloatReg>",
    ]
    entry = f'<EnumEntry Name="Coord3D_ABC32f" {_GENICAM}><Value>{ABC32F}</Value></EnumEntry>'
    with_format = plain.replace("<pValue>PixelFormatRegister</pValue>", f"{entry}<pValue>PixelFormatRegister</pValue>")
    return with_format.replace("<!-- Port -->", "".join(nodes))


class FakeGige:
    """A camera whose every frame is what `expose` gives at that moment: points (height, width, 3) in mm, NaN for holes."""

    def __init__(self, expose: Callable[[], NDArray[np.float32]], *, serial: str = "FAKE3D-1") -> None:
        self.expose = expose
        self.serial = serial
        self.delay_s = 0.0
        self._shape: tuple[int, ...] = ()
        self.library = ctypes.CDLL("libaravis-0.8.so.0")
        self._camera: int | None = None
        self._filled = threading.Event()
        self._fill = _FILL(self._on_fill)

    @property
    def running(self) -> bool:
        """Whether it listens."""
        return self._camera is not None

    def start(self) -> None:
        """Begin to listen."""
        self._shape = self.expose().shape
        height, width = self._shape[:2]
        with tempfile.NamedTemporaryFile("w", suffix=".xml", delete=False) as stream:
            stream.write(self._xml())
        make = self._function("arv_gv_fake_camera_new_full", c_void_p, c_char_p, c_char_p, c_char_p)
        self._camera = make(ADDRESS.encode(), self.serial.encode(), stream.name.encode())
        Path(stream.name).unlink()
        assert self._function("arv_gv_fake_camera_is_running", c_int, c_void_p)(self._camera), "somebody else is at 127.0.0.1:3956"
        for address, value in ((_WIDTH, width), (_HEIGHT, height), (_PIXEL_FORMAT, 0x01080001), (_UNIT, 0), (_REFERENCE, 0), (_MODE, 0)):
            self.write(address, value)
        for i in range(3):
            self._write_double(_SCALE + i * _STEP, 1.0)
        self._function("arv_fake_camera_set_fill_pattern", None, c_void_p, _FILL, c_void_p)(self._inner(), self._fill, None)

    def stop(self) -> None:
        """Vanish, without a word to clients."""
        if self._camera is not None:
            self._function("g_object_unref", None, c_void_p)(self._camera)
            self._camera = None

    def write(self, address: int, value: int) -> None:
        """Set a register."""
        self._function("arv_fake_camera_write_register", c_int, c_void_p, c_uint32, c_uint32)(self._inner(), address, value)

    def transform(self) -> None:
        """Somebody switches a transform on."""
        self.write(_REFERENCE, 1)

    def measure_in_pixels(self) -> None:
        """Somebody sets another unit."""
        self.write(_UNIT, 2)

    def warm_to(self, temperature_c: float) -> None:
        """Its housing has this temperature."""
        self._write_double(_TEMPERATURE, temperature_c)

    def lose(self, ratio: float) -> None:
        """A part of the stream's packets is never sent."""
        if self._camera is not None:
            self.library.g_object_set(c_void_p(self._camera), b"gvsp-lost-ratio", c_double(ratio), None)

    def hush(self) -> None:
        """Triggers are heard, and no frame is sent."""
        self.write(_ACQUISITION, 0)

    def trigger(self) -> None:
        """Somebody else triggers; returns when the frame has been sent."""
        self._filled.clear()
        self.write(_SOFTWARE_TRIGGER, 1)
        assert self._filled.wait(3.0)
        time.sleep(0.2)

    def _inner(self) -> int:
        assert self._camera is not None
        inner: int = self._function("arv_gv_fake_camera_get_fake_camera", c_void_p, c_void_p)(self._camera)
        return inner

    def _xml(self) -> str:
        plain = self._function("arv_fake_camera_new", c_void_p, c_char_p)(b"XML")
        size = c_size_t()
        text = self._function("arv_fake_camera_get_genicam_xml", c_void_p, c_void_p, ctypes.POINTER(c_size_t))(plain, byref(size))
        found = ctypes.string_at(text, size.value).decode()
        self._function("g_object_unref", None, c_void_p)(plain)
        return _description(found)

    def _write_double(self, address: int, value: float) -> None:
        write = self._function("arv_fake_camera_write_memory", c_int, c_void_p, c_uint32, c_uint32, c_char_p)
        write(self._inner(), address, 8, struct.pack(">d", value))

    def _on_fill(self, buffer: int, _data: int, _exposure: int, _gain: int, pixel_format: int) -> None:
        time.sleep(self.delay_s)
        address = self._function("arv_buffer_get_data", c_void_p, c_void_p, ctypes.POINTER(c_size_t))(buffer, byref(c_size_t()))
        if pixel_format == ABC32F:
            points = np.ascontiguousarray(self.expose(), dtype="<f4")
            assert points.shape == self._shape  # what the buffer was made for
            ctypes.memmove(address, points.tobytes(), points.nbytes)
        self._filled.set()

    def _function(self, name: str, result: object, *kinds: object) -> Callable[..., int]:
        function = getattr(self.library, name)
        function.restype, function.argtypes = result, kinds
        return function  # type: ignore[no-any-return]


@contextmanager
def the_port() -> Iterator[None]:
    """Nobody else's test is at 127.0.0.1:3956 meanwhile; skips where Aravis is not installed."""
    try:
        load()
    except CameraSdkMissing as error:
        pytest.skip(str(error))
    with _LOCK.open("w") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


@contextmanager
def fake_gige(expose: Callable[[], NDArray[np.float32]]) -> Iterator[FakeGige]:
    """A running camera."""
    with the_port():
        camera = FakeGige(expose)
        camera.start()
        try:
            yield camera
        finally:
            camera.stop()
