"""MuJoCo's window: bodies and skin at their recorded poses, keys, and the error without a display."""

import shutil
import subprocess
import sys
from pathlib import Path

import glfw
import mujoco
import numpy as np
import pytest

from helpers.recordings import RECORD, STEPS, arrays_of, scenery
from tactip_twin.sim.view.geometry import path_lines
from tactip_twin.sim.view.replay_window import ReplayWindow
from tactip_twin.tactip_model.errors import TactipError


@pytest.fixture
def window(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")  # nothing is opened
    return ReplayWindow(RECORD, arrays_of(), scenery())


def _skin(window):
    """Vertices of the skin as MuJoCo draws them, base frame."""
    model, data = window.model, window.data
    geom = next(k for k in range(model.ngeom) if model.geom_dataid[k] == window._skin)
    return model.mesh_vert[window._vertices] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def test_skin_and_links_are_where_the_recording_has_them(window):
    arrays = arrays_of()
    for step in (0, 5, STEPS - 1):
        window.playback.go(step)
        window.show()
        T = arrays["T_base_tcp"][step]
        assert np.allclose(_skin(window), arrays["skin_m"][step] @ T[:3, :3].T + T[:3, 3], atol=1e-6)
        poses = window._geometry.body_poses(arrays["angles_rad"][step])
        link = window.data.body("link_4")
        assert np.allclose(link.xpos, poses["link_4"][:3, 3])
        assert np.allclose(link.xmat.reshape(3, 3), poses["link_4"][:3, :3])
    assert window.model.njnt == 0  # nothing can move by itself


def test_normals_of_the_skin_are_outward_and_unit(window):
    normals = window.model.mesh_normal[window._normals]
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    centred = window.model.mesh_vert[window._vertices]
    assert ((normals * (centred - centred.mean(0))).sum(1) > 0).mean() > 0.95


def test_path_grows_and_shrinks_with_the_steps(window):
    lines, _, counts = path_lines(arrays_of(), np.zeros(STEPS), 1.0)
    scene = mujoco.MjvScene(window.model, maxgeom=100)
    for step in (5, STEPS - 1, 3):
        window.playback.go(step)
        window.show()
        window.draw_path(scene)
        assert scene.ngeom == counts[step]
        for geom, (start, end) in zip(scene.geoms[: scene.ngeom], lines, strict=False):
            assert np.allclose(geom.pos, (start + end) / 2, atol=1e-6)
    small = mujoco.MjvScene(window.model, maxgeom=2)
    window.playback.go(STEPS - 1)
    window.show()
    window.draw_path(small)
    assert small.ngeom == 2


def test_keys_move_it(window):
    window.key(glfw.KEY_RIGHT)
    window.key(glfw.KEY_RIGHT)
    assert window.playback.step == 2
    window.key(glfw.KEY_LEFT)
    assert window.playback.step == 1
    window.key(glfw.KEY_N)
    assert window.playback.step == 7
    window.key(glfw.KEY_END)
    assert window.playback.step == STEPS - 1
    window.key(glfw.KEY_P)
    assert window.playback.step == 7
    window.key(glfw.KEY_SPACE)
    assert window.playback.playing
    window.key(glfw.KEY_F1)  # means nothing


def test_without_a_display_it_is_said(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(TactipError, match="needs a display"):
        ReplayWindow(RECORD, arrays_of(), scenery())


_SHOW = """
import sys
sys.path.insert(0, {tests!r})
from helpers.recordings import RECORD, arrays_of, scenery
from tactip_twin.sim.view.replay_window import ReplayWindow
window = ReplayWindow(RECORD, arrays_of(), scenery())
window.playback.toggle()
window.run(3)
print("shown", window._shown)
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="there is no display, nor Xvfb to stand in for one")
def test_window_opens_and_plays():
    program = _SHOW.format(tests=str(Path(__file__).parents[2]))
    run = ["xvfb-run", "-a", "-s", "-screen 0 1024x768x24", sys.executable, "-c", program]
    done = subprocess.run(run, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) > 3
