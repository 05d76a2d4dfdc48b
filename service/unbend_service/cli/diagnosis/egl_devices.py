"""The EGL devices of this machine, asked of libEGL itself: before any context, and before any wrapper's opinion."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_EXTENSIONS = 0x3055
_VENDOR = 0x3053
_VERSION = 0x3054
_DRM_DEVICE_FILE = 0x3233
_DRM_RENDER_NODE_FILE = 0x3377
_PLATFORM_DEVICE = 0x313F
_MOST_DEVICES = 64


@dataclass(frozen=True, slots=True)
class EglDevice:
    """One device as its driver describes it.

    Attributes:
        index: as the setting ``egl_device`` counts.
        driver: vendor and EGL version of its driver; empty if it could not be started.
        node: its file under /dev/dri; empty for one without.
        software: whether it calls itself a software device.
    """

    index: int
    driver: str
    node: str
    software: bool


def list_devices() -> list[EglDevice]:
    """Every device that libEGL lists, in its order. To be called in a process that may be lost: drivers may crash.

    Raises:
        OSError: there is no libEGL, or it cannot list devices.
    """
    library = ctypes.CDLL("libEGL.so.1")
    library.eglGetProcAddress.restype = ctypes.c_void_p
    library.eglQueryString.restype = ctypes.c_char_p
    library.eglQueryString.argtypes = [ctypes.c_void_p, ctypes.c_int]
    query = _function(library, "eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    describe = _function(library, "eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)
    display = _function(
        library, "eglGetPlatformDisplayEXT", ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
    )
    devices = (ctypes.c_void_p * _MOST_DEVICES)()
    count = ctypes.c_int(0)
    if not query(_MOST_DEVICES, devices, ctypes.byref(count)):
        raise OSError("libEGL cannot list its devices")
    return [_look_at(library, describe, display, index, devices[index]) for index in range(count.value)]


def _look_at(
    library: ctypes.CDLL, describe: Callable[..., Any], display: Callable[..., Any], index: int, device: int | None
) -> EglDevice:
    extensions = _text(describe(device, _EXTENSIONS)).split()
    node = ""
    if "EGL_EXT_device_drm_render_node" in extensions:
        node = _text(describe(device, _DRM_RENDER_NODE_FILE))
    if not node and "EGL_EXT_device_drm" in extensions:
        node = _text(describe(device, _DRM_DEVICE_FILE))
    driver = ""
    opened = display(_PLATFORM_DEVICE, device, None)
    if opened and library.eglInitialize(ctypes.c_void_p(opened), None, None):
        driver = (
            f"{_text(library.eglQueryString(opened, _VENDOR))}, EGL {_text(library.eglQueryString(opened, _VERSION))}"
        )
        library.eglTerminate(ctypes.c_void_p(opened))
    return EglDevice(index, driver, node, "EGL_MESA_device_software" in extensions)


def _function(library: ctypes.CDLL, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
    address = library.eglGetProcAddress(name.encode())
    if not address:
        raise OSError(f"libEGL has no {name}")
    return ctypes.CFUNCTYPE(result, *arguments)(address)


def _text(value: bytes | None) -> str:
    return "" if value is None else value.decode(errors="replace")
