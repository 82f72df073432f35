"""Choice of the OpenGL platform, work without OpenGL, and the error where it fails."""

import os
import subprocess
import sys


def python(code, **environment):
    """Run code in a fresh interpreter; a variable whose value is None is removed."""
    env = {**os.environ, **{k: v for k, v in environment.items() if v is not None}}
    for name in [k for k, v in environment.items() if v is None]:
        env.pop(name, None)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=env)


SHOW = "import os, tactip_twin.tactip_model; print(os.environ['PYOPENGL_PLATFORM'], os.environ['MUJOCO_GL'])"
MAIN = "import sys; from tactip_twin.commands.main import main"
UNUSABLE = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"}


def test_platform_without_display_is_egl():
    assert python(SHOW, PYOPENGL_PLATFORM=None, MUJOCO_GL=None, DISPLAY=None).stdout.split() == ["egl", "egl"]


def test_platform_chosen_by_user_is_kept():
    result = python(SHOW, PYOPENGL_PLATFORM="osmesa", MUJOCO_GL="disable")
    assert result.stdout.split() == ["osmesa", "disable"]


def test_platform_is_chosen_before_opengl_is_imported():
    """The package sets it without importing OpenGL or MuJoCo, and a renderer made afterwards uses EGL."""
    code = "import sys, tactip_twin.tactip_model.design; assert not {'OpenGL', 'mujoco', 'pyrender'} & set(sys.modules)"
    code += "; from tactip_twin.tactip_model.pyrender_renderer import check_opengl; check_opengl()"
    result = python(code, PYOPENGL_PLATFORM=None, MUJOCO_GL=None, DISPLAY=None)
    assert result.returncode == 0, result.stderr


def test_make_without_opengl_gives_one_sentence_with_remedy(tmp_path):
    code = f"{MAIN}; sys.exit(main(['dataset', 'make', '--samples', '1', '--out', {str(tmp_path / 'a')!r}]))"
    result = python(code, **UNUSABLE)
    assert result.returncode == 1
    messages = [line for line in result.stderr.splitlines() if line.startswith("tactip:")]
    assert len(messages) == 1
    assert "OpenGL cannot be used here" in messages[0]
    assert "--renderer raster" in messages[0]
    assert "apt-get install" in messages[0]
    assert "Traceback" not in result.stderr


def test_platform_that_the_user_has_chosen_in_vain_is_named():
    code = "from tactip_twin.tactip_model.pyrender_renderer import renderer; renderer()"
    result = python(code, PYOPENGL_PLATFORM="foo")
    assert "unset PYOPENGL_PLATFORM, which is 'foo', or use --renderer raster" in result.stderr
    assert "apt-get" not in result.stderr


def test_raster_renderer_needs_no_opengl(tmp_path):
    options = ["--samples", "1", "--fidelity", "draft", "--renderer", "raster"]
    code = f"{MAIN}; sys.exit(main(['dataset', 'make', '--out', {str(tmp_path / 'a')!r}, *{options!r}]))"
    result = python(code, **UNUSABLE)
    assert result.returncode == 0, result.stderr


def test_pyrender_renderer_as_program_checks_opengl():
    command = [sys.executable, "-m", "tactip_twin.tactip_model.pyrender_renderer"]
    assert subprocess.run(command, timeout=120).returncode == 0
    broken = subprocess.run(command, timeout=120, env={**os.environ, **UNUSABLE}, capture_output=True, text=True)
    assert broken.returncode == 1
    assert "OpenGL cannot be used here" in broken.stderr
