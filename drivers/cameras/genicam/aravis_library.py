"""The C library Aravis 0.8, by ctypes: no PyGObject and no compiler needed, the system's package is enough.

ctypes lets go of the interpreter's lock during every call, so the application's other threads run on. Only functions of
Aravis' stable 0.8 interface are used, and all objects are opaque pointers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import POINTER, Structure, byref, c_char_p, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from typing import Any

from drivers.errors import CameraSdkMissing

NAMES = ("libaravis-0.8.so.0", "libaravis-0.8.0.dylib", "libaravis-0.8-0.dll")
REMEDY = "Install Aravis 0.8: `apt install libaravis-0.8-0` on Debian and Ubuntu."
TRANSPORT_CODES = frozenset({2, 3, 4, 5})
"""ArvDeviceError: not connected, protocol error, transfer error, timeout."""
NOT_CONTROLLER = 10

_ERROR_AT = object()
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_gv_device_new": (c_void_p, (c_void_p, c_void_p, _ERROR_AT)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_gv_device_get_packet_size": (c_uint, (c_void_p, _ERROR_AT)),
    "arv_gv_device_set_packet_size": (None, (c_void_p, c_int, _ERROR_AT)),
    "arv_gv_device_set_stream_options": (None, (c_void_p, c_int)),
    "arv_camera_new_with_device": (c_void_p, (c_void_p, _ERROR_AT)),
    "arv_camera_get_payload": (c_uint, (c_void_p, _ERROR_AT)),
    "arv_camera_gv_set_packet_delay": (None, (c_void_p, ctypes.c_int64, _ERROR_AT)),
    "arv_camera_start_acquisition": (None, (c_void_p, _ERROR_AT)),
    "arv_camera_stop_acquisition": (None, (c_void_p, _ERROR_AT)),
    "arv_device_is_feature_available": (c_int, (c_void_p, c_char_p, _ERROR_AT)),
    "arv_device_get_feature": (c_void_p, (c_void_p, c_char_p)),
    "arv_device_execute_command": (None, (c_void_p, c_char_p, _ERROR_AT)),
    "arv_device_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, _ERROR_AT)),
    "arv_gc_feature_node_get_value_as_string": (c_char_p, (c_void_p, _ERROR_AT)),
    "arv_gc_feature_node_set_value_from_string": (None, (c_void_p, c_char_p, _ERROR_AT)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_gv_stream_get_port": (ctypes.c_uint16, (c_void_p,)),
    "arv_gv_stream_get_statistics": (None, (c_void_p, POINTER(c_uint64), POINTER(c_uint64))),
    "arv_stream_get_statistics": (None, (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64))),
    "arv_stream_get_info_uint64_by_name": (c_uint64, (c_void_p, c_char_p)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_n_parts": (c_uint, (c_void_p,)),
    "arv_buffer_get_part_data": (c_void_p, (c_void_p, c_uint, POINTER(c_size_t))),
    "arv_buffer_get_part_pixel_format": (c_uint32, (c_void_p, c_uint)),
    "arv_buffer_get_part_width": (c_int, (c_void_p, c_uint)),
    "arv_buffer_get_part_height": (c_int, (c_void_p, c_uint)),
    "arv_buffer_get_part_padding": (None, (c_void_p, c_uint, POINTER(c_int), POINTER(c_int))),
    "arv_get_major_version": (c_uint, ()),
    "arv_get_minor_version": (c_uint, ()),
    "arv_get_micro_version": (c_uint, ()),
    "g_inet_address_new_from_string": (c_void_p, (c_char_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_error_free": (None, (c_void_p,)),
}

__all__ = ["NOT_CONTROLLER", "TRANSPORT_CODES", "AravisError", "AravisLibrary", "load"]


class _GError(Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


class AravisError(Exception):
    """A GError of Aravis."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class AravisLibrary:
    """Aravis' functions by name; those that can fail raise AravisError instead of taking a GError."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        self._ready: dict[str, Callable[..., Any]] = {}

    def call(self, name: str, *arguments: object) -> Any:
        """Call a function of `_SIGNATURES`; its GError argument is left out.

        Raises:
            AravisError: the function reported one.
        """
        result, kinds = _SIGNATURES[name]
        can_fail = bool(kinds) and kinds[-1] is _ERROR_AT
        function = self._ready.get(name)
        if function is None:
            raw = getattr(self._library, name)
            raw.restype, raw.argtypes = result, [POINTER(POINTER(_GError)) if kind is _ERROR_AT else kind for kind in kinds]
            function = self._ready[name] = raw
        if not can_fail:
            return function(*arguments)
        error = POINTER(_GError)()
        value = function(*arguments, byref(error))
        if error:
            told = AravisError(error.contents.code, error.contents.message.decode("utf-8", errors="replace"))
            self.call("g_error_free", error)
            raise told
        return value

    @property
    def version(self) -> str:
        """For example 0.8.26."""
        return ".".join(str(self.call(f"arv_get_{part}_version")) for part in ("major", "minor", "micro"))


def load() -> AravisLibrary:
    """The system's Aravis.

    Raises:
        CameraSdkMissing: there is none.
    """
    for name in NAMES:
        try:
            return AravisLibrary(ctypes.CDLL(name))
        except OSError:
            continue
    raise CameraSdkMissing("the library Aravis 0.8 is not installed", remedy=REMEDY)
