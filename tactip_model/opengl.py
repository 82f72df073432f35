"""The one place that chooses how OpenGL is reached, and that says whether it works.

EGL needs no display and is used wherever it is found; a user who has set PYOPENGL_PLATFORM or MUJOCO_GL is left alone.
Run as a program (`python -m tactip_model.opengl`) it draws one pixel and exits with 0 or, with one sentence, 1.
"""

import os
import sys
from ctypes.util import find_library

DEBIAN_PACKAGES = ("libegl1", "libegl-mesa0", "libgl1", "libgl1-mesa-dri")
"""Debian's packages that give a headless OpenGL without a graphics card."""


def choose_platform():
    """Ask PyOpenGL and MuJoCo for EGL, unless the user has chosen. Call before either is imported."""
    if sys.platform != "linux":
        return
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # MuJoCo itself is imported by every job, drawing or not: it must not look for an EGL that is not there.
    os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")


def install_hint():
    """The command (str) that gives a Debian machine a headless OpenGL."""
    return f"apt-get install -y {' '.join(DEBIAN_PACKAGES)}"


if __name__ == "__main__":
    from tactip_model.camera import check_opengl
    from tactip_model.errors import TactipError

    try:
        check_opengl()
    except TactipError as error:
        sys.exit(str(error))
