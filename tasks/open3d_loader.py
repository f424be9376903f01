"""The one place where open3d is imported."""

import ctypes
from functools import cache
from types import ModuleType


@cache
def load_open3d() -> ModuleType:
    """The open3d module; imported on first use, because that takes some three seconds.

    open3d's shared library asks for libusb (for depth cameras that we do not use), which a plain machine does
    not have; the copy in libusb_package is loaded before it, with its symbols visible to it.
    """
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
