"""libaravis by ctypes: exactly the functions that are used, and a GError as a CameraError.

Every call lets go of the interpreter lock, so that a camera that answers slowly holds nobody else up.
"""

import ctypes
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint64, c_void_p
from enum import IntEnum
from functools import cache
from typing import Any

from capture.errors import CameraError

LIBRARY = "libaravis-0.8.so.0"
_ASYNC_USB_SINCE = (0, 8, 31)  # before, the asynchronous thread spins when it has no buffer to fill
_CONNECT_SWAPPED = 2


class BufferStatus(IntEnum):
    """ArvBufferStatus."""

    UNKNOWN = -1
    SUCCESS = 0
    CLEARED = 1
    TIMEOUT = 2
    MISSING_PACKETS = 3
    WRONG_PACKET_ID = 4
    SIZE_MISMATCH = 5
    FILLING = 6
    ABORTED = 7
    PAYLOAD_NOT_SUPPORTED = 8


class UsbMode(IntEnum):
    """ArvUvUsbMode."""

    SYNC = 0
    ASYNC = 1


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


_FAILING: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_camera_new": (c_void_p, (c_char_p,)),
    "arv_camera_new_with_device": (c_void_p, (c_void_p,)),
    "arv_fake_device_new": (c_void_p, (c_char_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p,)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p,)),
    "arv_camera_is_feature_available": (c_int, (c_void_p, c_char_p)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p)),
    "arv_camera_get_integer": (c_int64, (c_void_p, c_char_p)),
    "arv_camera_set_integer": (None, (c_void_p, c_char_p, c_int64)),
    "arv_camera_get_integer_bounds": (None, (c_void_p, c_char_p, POINTER(c_int64), POINTER(c_int64))),
    "arv_camera_get_float": (c_double, (c_void_p, c_char_p)),
    "arv_camera_get_boolean": (c_int, (c_void_p, c_char_p)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_int)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p,)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_get_gain": (c_double, (c_void_p,)),
    "arv_camera_set_gain": (None, (c_void_p, c_double)),
    "arv_camera_get_gain_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_is_black_level_available": (c_int, (c_void_p,)),
    "arv_camera_get_black_level": (c_double, (c_void_p,)),
    "arv_camera_set_black_level": (None, (c_void_p, c_double)),
    "arv_camera_get_black_level_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double))),
    "arv_camera_dup_available_enumerations_as_strings": (POINTER(c_char_p), (c_void_p, c_char_p, POINTER(c_uint))),
    "arv_camera_get_payload": (c_uint, (c_void_p,)),
    "arv_chunk_parser_get_float_value": (c_double, (c_void_p, c_void_p, c_char_p)),
    "arv_chunk_parser_get_integer_value": (c_int64, (c_void_p, c_void_p, c_char_p)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p)),
    "arv_camera_start_acquisition": (None, (c_void_p,)),
    "arv_camera_stop_acquisition": (None, (c_void_p,)),
}
"""Result and arguments of what can fail; the GError that ends the argument list is added by ``call``."""

_PLAIN: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_get_major_version": (c_uint, ()),
    "arv_get_minor_version": (c_uint, ()),
    "arv_get_micro_version": (c_uint, ()),
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_get_device_protocol": (c_char_p, (c_uint,)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_int, (c_void_p,)),
    "arv_camera_is_uv_device": (c_int, (c_void_p,)),
    "arv_camera_create_chunk_parser": (c_void_p, (c_void_p,)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_camera_uv_set_usb_mode": (None, (c_void_p, c_int)),
    "arv_buffer_new_full": (c_void_p, (c_size_t, c_void_p, c_void_p, c_void_p)),
    "arv_buffer_has_chunks": (c_int, (c_void_p,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_user_data": (c_void_p, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
}


class AravisLibrary:
    """The loaded library. Pointers to its objects are plain integers; ``None`` is the null pointer."""

    def __init__(self) -> None:
        """Load it.

        Raises:
            CameraError: it is not installed.
        """
        try:
            library = ctypes.CDLL(LIBRARY)
            self._gobject = ctypes.CDLL("libgobject-2.0.so.0")
            self._glib = ctypes.CDLL("libglib-2.0.so.0")
        except OSError as error:
            raise CameraError(
                f"{LIBRARY}: cannot be loaded ({error}): install Aravis (Debian: libaravis-0.8-0)"
            ) from error
        self._functions = {}
        for name, (result, arguments) in (_FAILING | _PLAIN).items():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = (*arguments, POINTER(POINTER(_GError))) if name in _FAILING else arguments
            self._functions[name] = function
        self._gobject.g_object_unref.argtypes = (c_void_p,)
        self._gobject.g_object_unref.restype = None
        connect = self._gobject.g_signal_connect_data
        connect.argtypes = (c_void_p, c_char_p, c_void_p, c_void_p, c_void_p, c_int)
        connect.restype = ctypes.c_ulong
        self._gobject.g_signal_handler_disconnect.argtypes = (c_void_p, ctypes.c_ulong)
        self._gobject.g_signal_handler_disconnect.restype = None
        self._glib.g_error_free.argtypes = (POINTER(_GError),)
        self._glib.g_free.argtypes = (c_void_p,)
        self._glib.g_free.restype = None
        self.version = tuple(int(self.call(f"arv_get_{part}_version")) for part in ("major", "minor", "micro"))

    @property
    def usb_mode(self) -> UsbMode:
        """How this version reads USB cameras without a known fault."""
        return UsbMode.ASYNC if self.version >= _ASYNC_USB_SINCE else UsbMode.SYNC

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function.

        Raises:
            CameraError: it says that it failed; the message is the library's.
        """
        function = self._functions[name]
        if name not in _FAILING:
            return function(*arguments)
        error = POINTER(_GError)()
        result = function(*arguments, byref(error))
        if error:
            message = (error.contents.message or b"").decode(errors="replace")
            self._glib.g_error_free(error)
            raise CameraError(message)
        return result

    def free(self, array: Any) -> None:
        """Give back an array that a function has made."""
        self._glib.g_free(array)

    def unref(self, instance: int) -> None:
        """Let go of an object; with the last reference it is gone, and a stream's thread has ended."""
        self._gobject.g_object_unref(instance)

    def count_signal(self, instance: int, signal: str, counter: c_int) -> int:
        """Have ``counter`` raised by one whenever ``signal`` is sent; the handler's number, for ``disconnect``.

        The handler is GLib's own ``g_atomic_int_inc``, called in whatever thread sends the signal: no Python runs
        there. ``counter`` must live until ``disconnect``.
        """
        handler = ctypes.cast(self._glib.g_atomic_int_inc, c_void_p)
        number: int = self._gobject.g_signal_connect_data(
            instance, signal.encode(), handler, ctypes.addressof(counter), None, _CONNECT_SWAPPED
        )
        return number

    def disconnect(self, instance: int, handler: int) -> None:
        """End ``count_signal``."""
        self._gobject.g_signal_handler_disconnect(instance, handler)


@cache
def load_library() -> AravisLibrary:
    """The library, loaded once for the process.

    Raises:
        CameraError: it is not installed.
    """
    return AravisLibrary()
