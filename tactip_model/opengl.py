"""The one place that chooses how OpenGL is reached.

EGL needs no display and is used wherever it is found; a user who has set PYOPENGL_PLATFORM or MUJOCO_GL is left alone.
"""

import ctypes
import os
import sys

DEBIAN_PACKAGES = ("libegl1", "libegl-mesa0", "libgl1", "libgl1-mesa-dri")
"""Debian's packages that give a headless OpenGL without a graphics card."""


def choose_platform():
    """Ask PyOpenGL and MuJoCo for EGL, unless the user has chosen. Call before either is imported."""
    if sys.platform != "linux":
        return
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # MuJoCo itself is imported by every job, drawing or not: it must not look for an EGL that is not there.
    os.environ.setdefault("MUJOCO_GL", "egl" if _egl_loads() else "disable")


def _egl_loads():
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def install_hint():
    """The command (str) that gives a Debian machine a headless OpenGL."""
    return f"apt-get install -y {' '.join(DEBIAN_PACKAGES)}"
