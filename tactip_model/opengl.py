"""Choice of the OpenGL platform.

EGL needs no display and is used wherever it is found. Values of PYOPENGL_PLATFORM and MUJOCO_GL that the user has set
stay as they are.
"""

import ctypes
import os
import sys

DEBIAN_PACKAGES = ("libegl1", "libegl-mesa0", "libgl1", "libgl1-mesa-dri")
"""Debian packages that provide headless OpenGL without a graphics card."""


def choose_platform() -> None:
    """Select EGL for PyOpenGL and MuJoCo unless the user has chosen. Call this before either is imported."""
    if sys.platform != "linux":
        return
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # Every job imports MuJoCo, even if it renders nothing, so MuJoCo must not search for a missing EGL.
    os.environ.setdefault("MUJOCO_GL", "egl" if _egl_loads() else "disable")


def _egl_loads() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def remedy() -> str:
    """Return what a user can do where OpenGL does not work."""
    platform = os.environ.get("PYOPENGL_PLATFORM", "egl")
    if platform != "egl":
        return f"unset PYOPENGL_PLATFORM, which is {platform!r}"
    return f"on Debian install it with 'apt-get install -y {' '.join(DEBIAN_PACKAGES)}'"
