"""A replay in MuJoCo's own window, for machines with a display: the same scene as in the browser.

Nothing is simulated: the model has no joints, and its bodies are placed as recorded. Keys: space plays and pauses, the
arrows move one step forward or back, Home and End to the first and last step, N and P to the next and previous event.
"""

import os
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

import glfw
import mujoco
import mujoco.viewer
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.sim.robot.recording import PHASES, RecordedScene
from tactip_twin.sim.view.curves import position_errors_mm
from tactip_twin.sim.view.geometry import ColoredMesh, SceneGeometry, object_moves, path_lines
from tactip_twin.sim.view.palette import SKIN_COLOR, scale_end
from tactip_twin.sim.view.playback import Playback
from tactip_twin.tactip_model.errors import TactipError

_PICTURES_HZ = 30.0

_PATH_RADIUS_M = 0.4e-3
"""Radius of the lines that show the path, m."""

_CLOSING_S = 10.0
"""Time limit for the window's threads to end, s."""

_WITHOUT_PANELS = {"show_left_ui": False, "show_right_ui": False}

_IMAGE = 160
"""Width of the tactile image in the corner, px."""


class ReplayWindow:
    """A window that shows one recording."""

    def __init__(self, record: Mapping[str, Any], arrays: Mapping[str, np.ndarray], scenery: RecordedScene) -> None:
        """Build the model that is shown.

        Args:
            record: Record of the recording (tactip_twin.sim.robot.recording.read_recording).
            arrays: Its arrays.
            scenery: Its scene.

        Raises:
            TactipError: If there is no step to show, or no display.
        """
        if not record["steps"]:
            raise TactipError("the recording has no steps to show")
        if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise TactipError("MuJoCo's window needs a display: leave --window out to use a browser page instead")
        self._record, self._arrays = record, arrays
        self._geometry = SceneGeometry(scenery, object_moves(arrays))
        self.playback = Playback(record["steps"], [event["step"] for event in record["events"]])
        """State of the replay."""
        self.model = self._compile()
        """The model that is shown."""
        self.data = mujoco.MjData(self.model)
        errors = position_errors_mm(arrays, record["task"])
        self._lines, self._line_colors, self._line_counts = path_lines(arrays, errors, scale_end(errors))
        self._shown = -1
        self.show()

    def run(self, seconds: float | None = None) -> None:
        """Show the window until it is closed, or for some seconds."""
        end, before = None if seconds is None else time.monotonic() + seconds, set(threading.enumerate())
        with mujoco.viewer.launch_passive(self.model, self.data, key_callback=self.key, **_WITHOUT_PANELS) as handle:
            self._set_view(handle.cam)
            while handle.is_running() and (end is None or time.monotonic() < end):
                began = time.monotonic()
                self.playback.tick(began)
                with handle.lock():
                    changed = self.show()
                if changed:
                    handle.update_mesh(self._skin)
                    self.draw_path(handle.user_scn)
                    self._annotate(handle)
                handle.sync()
                time.sleep(max(0.001, 1 / _PICTURES_HZ - (time.monotonic() - began)))
        # The window's thread outlives its handle, and a program that ends before the thread crashes.
        for thread in set(threading.enumerate()) - before:
            thread.join(_CLOSING_S)

    def key(self, code: int) -> None:
        """Handle a pressed key, by its GLFW code."""
        replay = self.playback
        actions = {
            glfw.KEY_SPACE: replay.toggle,
            glfw.KEY_RIGHT: lambda: replay.forward(1),
            glfw.KEY_LEFT: lambda: replay.forward(-1),
            glfw.KEY_HOME: lambda: replay.forward(-(10**9)),
            glfw.KEY_END: lambda: replay.forward(10**9),
            glfw.KEY_N: lambda: replay.jump(1),
            glfw.KEY_P: lambda: replay.jump(-1),
        }
        if code in actions:
            actions[code]()

    def show(self) -> bool:
        """Place everything as at the current step of the replay. Return whether the step has changed."""
        k, a = self.playback.step, self._arrays
        if k == self._shown:
            return False
        self._shown = k
        poses = {"tip": a["T_base_tcp"][k], "object": a["T_base_object"][k]}
        if self._geometry.links:
            poses |= self._geometry.body_poses(a["angles_rad"][k])
        for name, mocap in self._bodies.items():
            self.data.mocap_pos[mocap] = poses[name][:3, 3]
            self.data.mocap_quat[mocap] = Rotation.from_matrix(poses[name][:3, :3]).as_quat(scalar_first=True)
        self._update_skin(a["skin_m"][k])
        mujoco.mj_kinematics(self.model, self.data)
        return True

    def draw_path(self, scene: mujoco.MjvScene) -> None:
        """Add the path so far and the normals predicted on it to a scene, as far as it has room."""
        count, kind = min(int(self._line_counts[self._shown]), scene.maxgeom), mujoco.mjtGeom.mjGEOM_CAPSULE
        rgba = np.concatenate([self._line_colors / np.float32(255), np.ones((len(self._lines), 1), np.float32)], 1)
        chosen = slice(scene.ngeom, count)
        for geom, (start, end), color in zip(scene.geoms[chosen], self._lines[chosen], rgba[chosen], strict=True):
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), color)
            mujoco.mjv_connector(geom, kind, _PATH_RADIUS_M, start.astype(float), end.astype(float))
        scene.ngeom = count

    def _compile(self) -> mujoco.MjModel:
        spec, geometry = mujoco.MjSpec(), self._geometry
        spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
        spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35, 0.35, 0.35], [0.3, 0.3, 0.3]
        spec.visual.headlight.specular = [0, 0, 0]
        sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        spec.worldbody.add_light(pos=[0.5, -0.8, 1.5], dir=[-0.2, 0.4, -1], type=sun, diffuse=[0.4] * 3, specular=[0.1] * 3)
        sky, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        spec.add_texture(type=sky, builtin=gradient, width=64, height=384, rgb1=[1, 1, 1], rgb2=[0.8, 0.82, 0.86])
        _add(spec, spec.worldbody, "table", geometry.table)
        moving = {**geometry.links, "tip": geometry.sensor, "object": [geometry.object]}
        for name, meshes in moving.items():
            body = spec.worldbody.add_body(name=name, mocap=True)
            for n, mesh in enumerate(meshes):
                _add(spec, body, f"{name}/{n}", mesh)
        skin = np.asarray(self._arrays["skin_m"][0], float)
        _add(spec, spec.body("tip"), "skin", ColoredMesh(skin, geometry.skin_triangles, np.zeros_like(skin), SKIN_COLOR))
        model = spec.compile()
        self._bodies = {name: int(model.body(name).mocapid[0]) for name in moving}
        mesh = model.mesh("skin")
        self._skin = mesh.id
        self._vertices = slice(int(mesh.vertadr[0]), int(mesh.vertadr[0] + mesh.vertnum[0]))
        self._normals = slice(int(model.mesh_normaladr[mesh.id]), int(model.mesh_normaladr[mesh.id] + mesh.vertnum[0]))
        if mesh.vertnum[0] != len(skin) or model.mesh_normalnum[mesh.id] != len(skin):
            raise TactipError(
                "MuJoCo merged vertices of the skin: use a browser page, because its window cannot show this recording"
            )
        return model

    def _update_skin(self, skin: np.ndarray) -> None:
        """Give the skin's mesh new vertices (s, 3) m, sensor frame: MuJoCo keeps them in a frame of the mesh's own."""
        model = self.model
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[self._skin])
        own = turn.reshape(3, 3)
        model.mesh_vert[self._vertices] = (skin - model.mesh_pos[self._skin]) @ own
        normals = trimesh.Trimesh(skin, self._geometry.skin_triangles, process=False).vertex_normals
        model.mesh_normal[self._normals] = normals @ own

    def _set_view(self, camera: mujoco.MjvCamera) -> None:
        """Move a camera to where it sees the whole path."""
        poses = self._arrays["T_base_tcp"][:, :3, 3]
        camera.lookat[:] = (poses.min(0) + poses.max(0)) / 2
        camera.distance, camera.azimuth, camera.elevation = 0.7 if self._geometry.links else 0.35, 125.0, -25.0

    def _annotate(self, handle: mujoco.viewer.Handle) -> None:
        """Show the step's text and tactile image beside the scene."""
        a, k = self._arrays, self._shown
        image = a["images"][k]
        if image.size and handle.viewport is not None:
            corner = mujoco.MjrRect(handle.viewport.width - _IMAGE - 12, 12, _IMAGE, _IMAGE)
            at = np.arange(_IMAGE) * len(image) // _IMAGE
            handle.set_images((corner, np.repeat(image[np.ix_(at, at)][..., None], 3, axis=-1)))
        events = [f"{e['kind']}: {e['what']}" for e in self._record["events"] if e["step"] == k]
        force = np.linalg.norm(a["force_n"][k])
        values = [f"{k} of {self._record['steps'] - 1}", PHASES[int(a["phase"][k])], f"{force:.2f} N", *events]
        titles = ["step", "phase", "force", *["event"] * len(events)]
        handle.set_texts((None, None, "\n".join(titles), "\n".join(values)))


def _add(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, mesh: ColoredMesh) -> None:
    """Add a mesh to a body of a spec, in the body's frame."""
    asset = spec.add_mesh(name=name, uservert=mesh.vertices.ravel(), userface=mesh.triangles.ravel())
    asset.inertia, asset.smoothnormal = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, True
    rgba = [*(c / 255 for c in mesh.color), 1.0]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=rgba, contype=0, conaffinity=0)
