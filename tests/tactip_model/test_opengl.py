"""OpenGL is chosen in one place, is not needed by those who do without, and says what to do where it fails."""

import os
import subprocess
import sys


def python(code, **environment):
    """Run code in a fresh interpreter; a value of None takes a variable away."""
    env = {**os.environ, **{k: v for k, v in environment.items() if v is not None}}
    for name in [k for k, v in environment.items() if v is None]:
        env.pop(name, None)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=env)


SHOW = "import os, tactip_twin.tactip_model; print(os.environ['PYOPENGL_PLATFORM'], os.environ['MUJOCO_GL'])"
MAIN = "import sys; from tactip_twin.commands.main import main"
UNUSABLE = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"}


def test_egl_is_chosen_without_a_display():
    assert python(SHOW, PYOPENGL_PLATFORM=None, MUJOCO_GL=None, DISPLAY=None).stdout.split() == ["egl", "egl"]


def test_the_users_choice_stands():
    result = python(SHOW, PYOPENGL_PLATFORM="osmesa", MUJOCO_GL="disable")
    assert result.stdout.split() == ["osmesa", "disable"]


def test_it_is_chosen_before_anything_imports_opengl():
    """The sensor's package sets it without importing OpenGL or MuJoCo; a renderer made afterwards has its EGL."""
    code = "import sys, tactip_twin.tactip_model.design; assert not {'OpenGL', 'mujoco', 'pyrender'} & set(sys.modules)"
    code += "; from tactip_twin.tactip_model.pyrender_renderer import check_opengl; check_opengl()"
    result = python(code, PYOPENGL_PLATFORM=None, MUJOCO_GL=None, DISPLAY=None)
    assert result.returncode == 0, result.stderr


def test_unusable_opengl_gives_one_sentence_and_the_way_on(tmp_path):
    code = f"{MAIN}; sys.exit(main(['dataset', 'make', '--samples', '1', '--out', {str(tmp_path / 'a')!r}]))"
    result = python(code, **UNUSABLE)
    assert result.returncode == 1
    told = [line for line in result.stderr.splitlines() if line.startswith("tactip:")]
    assert len(told) == 1
    assert "OpenGL cannot be used here" in told[0]
    assert "--renderer raster" in told[0]
    assert "apt-get install" in told[0]
    assert "Traceback" not in result.stderr


def test_the_raster_needs_no_opengl(tmp_path):
    options = ["--samples", "1", "--fidelity", "draft", "--renderer", "raster"]
    code = f"{MAIN}; sys.exit(main(['dataset', 'make', '--out', {str(tmp_path / 'a')!r}, *{options!r}]))"
    result = python(code, **UNUSABLE)
    assert result.returncode == 0, result.stderr


def test_the_check_of_make_setup():
    command = [sys.executable, "-m", "tactip_twin.tactip_model.pyrender_renderer"]
    assert subprocess.run(command, timeout=120).returncode == 0
    broken = subprocess.run(command, timeout=120, env={**os.environ, **UNUSABLE}, capture_output=True, text=True)
    assert broken.returncode == 1
    assert "OpenGL cannot be used here" in broken.stderr
