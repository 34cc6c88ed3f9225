"""Detection of what drawing meshes takes on this machine."""

from __future__ import annotations

import sys
from ctypes.util import find_library


def obstacle() -> str | None:
    """Return what keeps VTK from drawing here, looked up without it; None where nothing does."""
    if sys.platform == "linux" and find_library("EGL_mesa") is None and find_library("OSMesa") is None:
        return "no OpenGL without a display: apt-get install libegl1 libgl1-mesa-dri libx11-6"
    return None
