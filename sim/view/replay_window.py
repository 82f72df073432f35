"""A replay in MuJoCo's own window, where there is a display: the same scene as in the browser, as bodies that are placed.

Nothing is simulated: the model has no joints, and every body is where the recording has it. Keys: space plays and pauses,
the arrows go a step on and back, Home and End to the first and the last, N and P to the next event and the one before.
"""

import os
import sys
import threading
import time

import glfw
import mujoco
import mujoco.viewer
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.sim.robot.recording import PHASES
from tactip_twin.sim.view.geometry import COLOURS, SKIN, ColoredMesh, SceneGeometry, way_lines
from tactip_twin.sim.view.playback import Playback
from tactip_twin.tactip_model.errors import TactipError

_PICTURES_HZ = 30.0

_WAY_M = 0.4e-3
"""Radius at which the way is drawn, m."""

_CLOSING_S = 10.0
"""How long a window may take to close, s."""

_PLAIN = {"show_left_ui": False, "show_right_ui": False}

_IMAGE = 160
"""Width of the tactile image in the corner, px."""


class Window:
    """A window that shows one recording."""

    def __init__(self, record, arrays, scenery):
        """record, arrays, scenery: of tactip_twin.sim.robot.recording. Raises TactipError where there is nothing to
        show, or no display."""
        if not record["steps"]:
            raise TactipError("there is nothing to be seen in the recording: no step was made")
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise TactipError("there is no display here for MuJoCo's window: leave --window out for a page in a browser")
        self._record, self._arrays, self._stage = record, arrays, SceneGeometry(scenery)
        self.playback = Playback(record["steps"], [event["step"] for event in record["events"]])
        """Where the replay is."""
        self.model = self._compile()
        """mujoco.MjModel of what is shown."""
        self.data = mujoco.MjData(self.model)
        self._lines, self._ends = way_lines(arrays)
        self._shown = -1
        self.show()

    def run(self, seconds=None):
        """Show the window until it is closed, or for some seconds."""
        end, before = None if seconds is None else time.monotonic() + seconds, set(threading.enumerate())
        with mujoco.viewer.launch_passive(self.model, self.data, key_callback=self.key, **_PLAIN) as handle:
            self._look(handle.cam)
            while handle.is_running() and (end is None or time.monotonic() < end):
                began = time.monotonic()
                self.playback.tick(began)
                with handle.lock():
                    changed = self.show()
                if changed:
                    handle.update_mesh(self._skin)
                    self.draw_way(handle.user_scn)
                    self._tell(handle)
                handle.sync()
                time.sleep(max(0.001, 1 / _PICTURES_HZ - (time.monotonic() - began)))
        # The window's thread outlives its handle: a program that ends before it does ends in a crash.
        for thread in set(threading.enumerate()) - before:
            thread.join(_CLOSING_S)

    def key(self, code):
        """A key was pressed. code: int, of GLFW."""
        replay = self.playback
        acts = {
            glfw.KEY_SPACE: replay.toggle,
            glfw.KEY_RIGHT: lambda: replay.forward(1),
            glfw.KEY_LEFT: lambda: replay.forward(-1),
            glfw.KEY_HOME: lambda: replay.forward(-(10**9)),
            glfw.KEY_END: lambda: replay.forward(10**9),
            glfw.KEY_N: lambda: replay.jump(1),
            glfw.KEY_P: lambda: replay.jump(-1),
        }
        if code in acts:
            acts[code]()

    def show(self):
        """Put everything where the replay is. Returns whether that is another step than before (bool)."""
        k, a = self.playback.step, self._arrays
        if k == self._shown:
            return False
        self._shown = k
        poses = {"tip": a["T_base_tcp"][k]}
        if self._stage.links:
            poses |= self._stage.poses(a["angles_rad"][k])
        for name, mocap in self._bodies.items():
            self.data.mocap_pos[mocap] = poses[name][:3, 3]
            self.data.mocap_quat[mocap] = Rotation.from_matrix(poses[name][:3, :3]).as_quat(scalar_first=True)
        self._reshape(a["skin_m"][k])
        mujoco.mj_kinematics(self.model, self.data)
        return True

    def draw_way(self, scene):
        """Draw the way so far and the normals that were felt on it into a mujoco.MjvScene, as far as that has room."""
        count, kind = min(int(self._ends[self._shown]), scene.maxgeom), mujoco.mjtGeom.mjGEOM_CAPSULE
        rgba = np.array([*(c / 255 for c in COLOURS[self._record["task"]]), 1.0], np.float32)
        for geom, (start, end) in zip(scene.geoms[scene.ngeom : count], self._lines[scene.ngeom : count], strict=True):
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
            mujoco.mjv_connector(geom, kind, _WAY_M, start.astype(float), end.astype(float))
        scene.ngeom = count

    def _compile(self):
        spec, stage = mujoco.MjSpec(), self._stage
        spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35, 0.35, 0.35], [0.3, 0.3, 0.3]
        spec.visual.headlight.specular = [0, 0, 0]
        sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        spec.worldbody.add_light(pos=[0.5, -0.8, 1.5], dir=[-0.2, 0.4, -1], type=sun, diffuse=[0.4] * 3, specular=[0.1] * 3)
        sky, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        spec.add_texture(type=sky, builtin=gradient, width=64, height=384, rgb1=[1, 1, 1], rgb2=[0.8, 0.82, 0.86])
        for n, prop in enumerate(stage.still):
            _add(spec, spec.worldbody, f"still/{n}", prop)
        names = [*stage.links, "tip"]
        for name in names:
            body = spec.worldbody.add_body(name=name, mocap=True)
            for n, prop in enumerate(stage.links.get(name, stage.sensor)):
                _add(spec, body, f"{name}/{n}", prop)
        skin = np.asarray(self._arrays["skin_m"][0], float)
        _add(spec, spec.body("tip"), "skin", ColoredMesh(skin, stage.skin_triangles, np.zeros_like(skin), SKIN))
        model = spec.compile()
        self._bodies = {name: int(model.body(name).mocapid[0]) for name in names}
        mesh = model.mesh("skin")
        self._skin = mesh.id
        self._vertices = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
        self._normals = slice(int(model.mesh_normaladr[mesh.id]), int(model.mesh_normaladr[mesh.id] + mesh.vertnum[0]))
        if mesh.vertnum[0] != len(skin) or model.mesh_normalnum[mesh.id] != len(skin):
            raise TactipError("MuJoCo does not keep the skin's vertices apart: the recording cannot be shown in its window")
        return model

    def _reshape(self, skin):
        """Give the skin's mesh other vertices (s, 3) m, sensor frame: MuJoCo keeps them in a frame of the mesh's own."""
        model = self.model
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[self._skin])
        own = turn.reshape(3, 3)
        model.mesh_vert[self._vertices] = (skin - model.mesh_pos[self._skin]) @ own
        normals = trimesh.Trimesh(skin, self._stage.skin_triangles, process=False).vertex_normals
        model.mesh_normal[self._normals] = normals @ own

    def _look(self, camera):
        """Bring a camera (MuJoCo's) to where all of the way is seen."""
        poses = self._arrays["T_base_tcp"][:, :3, 3]
        camera.lookat[:] = (poses.min(0) + poses.max(0)) / 2
        camera.distance, camera.azimuth, camera.elevation = 0.7 if self._stage.links else 0.35, 125.0, -25.0

    def _tell(self, handle):
        """Write beside the scene what there is to tell of the step, and show what is felt."""
        a, k = self._arrays, self._shown
        image = a["images"][k]
        if image.size and handle.viewport is not None:
            corner = mujoco.MjrRect(handle.viewport.width - _IMAGE - 12, 12, _IMAGE, _IMAGE)
            at = np.arange(_IMAGE) * len(image) // _IMAGE
            handle.set_images((corner, np.repeat(image[np.ix_(at, at)][..., None], 3, axis=-1)))
        events = [f"{e['kind']}: {e['what']}" for e in self._record["events"] if e["step"] == k]
        force = np.linalg.norm(a["force_n"][k])
        told = [f"{k} of {self._record['steps'] - 1}", PHASES[int(a["phase"][k])], f"{force:.2f} N", *events]
        titles = ["step", "phase", "force", *["event"] * len(events)]
        handle.set_texts((None, None, "\n".join(titles), "\n".join(told)))


def _add(spec, body, name, prop):
    """Add a Prop to a body of a MjSpec, in its frame."""
    mesh = spec.add_mesh(name=name, uservert=prop.vertices.ravel(), userface=prop.triangles.ravel())
    mesh.inertia, mesh.smoothnormal = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, True
    rgba = [*(c / 255 for c in prop.colour), 1.0]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=rgba, contype=0, conaffinity=0)
