"""What there is to be seen of a recording: the arm, the object, the soft skin, the way; as coloured surfaces in the arm's
base frame. What draws them (picture.py) knows nothing of robots."""

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import sensor_in_contact
from tactip_twin.sim.robot.irb120 import arm_spec
from tactip_twin.sim.robot.recording import PHASES

PORCELAIN, SKIN, TABLE = (232.0, 230, 225), (58.0, 58, 64), (186.0, 188, 192)
"""Colours of the object, the skin and the table, red, green and blue."""

COLOURS = {"surface": (200.0, 30, 30), "edge": (30.0, 70, 210)}
"""Of the way and its normals, red, green and blue."""

_CREASE_RAD = 0.6
"""Angle from which on there is a crease between two faces of a part of the arm, rad."""

_NORMAL_M = 6e-3
_EVERY_M = 2.5e-3
"""Length of the normals that are drawn, and their distance along the way, m."""

_STAND = 0.6
"""Width of what an object stands on, over its own."""

_TABLE_M = (0.9, 0.7)
"""Length and width of the table, m."""


@dataclass(frozen=True)
class ColoredMesh:
    """A surface of one colour."""

    vertices: np.ndarray
    """(n, 3) m."""
    triangles: np.ndarray
    """(k, 3) int."""
    normals: np.ndarray
    """(n, 3), unit."""
    colour: tuple[float, float, float]
    """Red, green and blue, 0 to 255."""

    def moved(self, T):
        """This prop carried by T (4, 4)."""
        turn = T[:3, :3].T
        return ColoredMesh(self.vertices @ turn + T[:3, 3], self.triangles, self.normals @ turn, self.colour)


class SceneGeometry:
    """The props of a recording, each in the frame that carries it."""

    def __init__(self, scenery):
        """scenery: recording.RecordedScene."""
        thing = object_mesh(scenery)
        self.still = [thing, _table(thing)]
        """Props that stay as they are, base frame."""
        self.skin_triangles = scenery.skin_triangles
        """(t, 3) int."""
        self._model = arm_spec(scenery.tip_radius_m).compile()
        self._data = mujoco.MjData(self._model)
        names = [self._model.body(k).name for k in range(1, self._model.nbody)] if scenery.with_arm else []
        self.links = {name: body_props(self._model, name) for name in names if name != "sensor"}
        """Props (lists) by the body of the arm that carries them, in its frame."""
        self.sensor = sensor_props(scenery.tip_radius_m)
        """Props of the sensor but for its skin, sensor frame."""

    def skin(self, skin):
        """The Prop of a recorded skin (s, 3) m, sensor frame."""
        normals = trimesh.Trimesh(skin, self.skin_triangles, process=False).vertex_normals
        return ColoredMesh(np.asarray(skin, float), self.skin_triangles, np.asarray(normals), SKIN)

    def poses(self, angles):
        """T_base_body (4, 4) by body (dict) at joint angles (6,), rad."""
        self._data.qpos[:] = angles
        mujoco.mj_kinematics(self._model, self._data)
        return {self._model.body(k).name: _pose(self._data.xmat[k], self._data.xpos[k]) for k in range(self._model.nbody)}

    def moving(self, angles, T_base_tcp, skin):
        """Props (list) of a step, base frame: angles (6,) rad, not a number without an arm; T_base_tcp (4, 4); skin (s, 3)
        m, sensor frame."""
        # The sensor stands where it is, and not where the angles of a step say: they are the same but for rounding.
        out = [prop.moved(T_base_tcp) for prop in [self.skin(skin), *self.sensor]]
        if self.links and np.isfinite(angles).all():
            poses = self.poses(angles)
            out += [prop.moved(poses[body]) for body, props in self.links.items() for prop in props]
        return out


def _pose(turn, place):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(turn, (3, 3)), place
    return T


def object_mesh(scenery):
    """The Prop of the object of a recording.RecordedScene, in the base frame."""
    solid = SignedDistanceMesh(scenery.object_vertices, scenery.object_triangles)
    corners = solid.vertices[solid.triangles].reshape(-1, 3)
    own = ColoredMesh(corners, np.arange(len(corners)).reshape(-1, 3), solid.corner_normals.reshape(-1, 3), PORCELAIN)
    return own.moved(scenery.T_base_object)


def felt_frames(arrays, end=None):
    """Where the surface is felt to be at the steps of the phase `follow` up to step `end`: contact frames (n, 4, 4), base
    frame, and which steps (n,) they are of. arrays: of tactip_twin.sim.robot.recording."""
    steps = np.flatnonzero((arrays["phase"] == PHASES.index("follow"))[:end])
    frames = [arrays["T_base_tcp"][k] @ np.linalg.inv(sensor_in_contact(arrays["felt"][k])) for k in steps]
    return np.array(frames).reshape(-1, 4, 4), steps


def way(arrays, task, end=None):
    """Props (list) of the way of a recording and the normals that were felt on it, up to step `end`.

    arrays: of tactip_twin.sim.robot.recording. task: surface or edge.
    """
    places, chosen, ends = _way(felt_frames(arrays, end)[0])
    if len(places) < 2:
        return []
    normals = [tube(np.stack(pair), 0.3e-3, COLOURS[task]) for pair in zip(places[chosen], ends, strict=True)]
    return [tube(places, 0.7e-3, COLOURS[task]), *normals]


def way_lines(arrays):
    """The same as segments (m, 2, 3) m, float32, as they come, and how many (int, (steps,)) there are up to each step."""
    frames, steps = felt_frames(arrays)
    places, chosen, ends = _way(frames)
    lines = np.concatenate([np.stack([places[:-1], places[1:]], 1), np.stack([places[chosen], ends], 1)])
    # A piece of the way is there with its second end, a normal with its place.
    there = np.concatenate([steps[1:], steps[chosen]])
    order = np.argsort(there, kind="stable")
    counts = np.searchsorted(there[order], np.arange(len(arrays["phase"])), side="right")
    return lines[order].astype(np.float32), counts


def _way(frames):
    """Of frames (n, 4, 4): places (n, 3), on which (m,) of them a normal is drawn, and where (m, 3) those end."""
    places = frames[:, :3, 3] + 0.6e-3 * frames[:, :3, 2]
    gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    chosen = np.unique(np.searchsorted(gone, np.arange(0, gone[-1], _EVERY_M))) if len(places) > 1 else np.zeros(0, int)
    return places, chosen, places[chosen] + _NORMAL_M * frames[chosen, :3, 2]


def tube(points, radius_m, colour, sides=8):
    """The Prop of a tube along points (n, 3) m, n at least 2."""
    ways = np.gradient(points, axis=0)
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    across = np.cross(ways, [0.3, 0.5, 0.81])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    other = np.cross(ways, across)
    turn = 2 * np.pi * np.arange(sides) / sides
    normals = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * other[:, None]
    rings = points[:, None] + radius_m * normals
    k, j = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    a, b = (k * sides + j).ravel(), (k * sides + (j + 1) % sides).ravel()
    triangles = np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    return ColoredMesh(rings.reshape(-1, 3), triangles, normals.reshape(-1, 3), colour)


def _table(thing):
    """The table, and what an object stands on that is above it. thing: ColoredMesh, base frame."""
    parts = [trimesh.creation.box([*_TABLE_M, 0.02])]
    parts[0].apply_translation([0.3, 0, -0.0101])
    low, high = thing.vertices.min(0), thing.vertices.max(0)
    if low[2] > 1e-3:
        parts.append(trimesh.creation.box([*(_STAND * (high - low)[:2]), low[2]]))
        parts[-1].apply_translation([*(low + high)[:2] / 2, low[2] / 2])
    return _prop(trimesh.util.concatenate(parts), TABLE)


def sensor_props(tip_radius_m):
    """Props (list) of a sensor but for its skin, sensor frame."""
    model = arm_spec(tip_radius_m).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    site, body = model.site("tcp").id, model.body("sensor").id
    T_base_tcp = _pose(data.site_xmat[site], data.site_xpos[site])
    T_tcp_sensor = np.linalg.inv(T_base_tcp) @ _pose(data.xmat[body], data.xpos[body])
    return [prop.moved(T_tcp_sensor) for prop in body_props(model, "sensor")]


def body_props(model, name, colour=None):
    """Props (list) of a body of a MuJoCo model, in its frame; in their materials' colours where there is no other."""
    out = []
    for k in _geoms(model, name):
        if model.geom(k).name != "dome":  # the skin itself is drawn
            own = 255 * model.mat_rgba[model.geom_matid[k], :3] if colour is None else colour
            out.append(_prop(_of_geom(model, k), tuple(float(c) for c in own)))
    return out


def body_mesh(model, name):
    """Vertices (n, 3) m and triangles (k, 3) of a body of a MuJoCo model, in its frame."""
    whole = trimesh.util.concatenate([_of_geom(model, k) for k in _geoms(model, name)])
    return np.asarray(whole.vertices), np.asarray(whole.faces)


def _geoms(model, name):
    return [k for k in range(model.ngeom) if model.body(model.geom_bodyid[k]).name == name]


def _of_geom(model, k):
    """The trimesh.Trimesh of geom k of a MuJoCo model, in its body's frame."""
    if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH:
        asset = model.mesh(model.geom_dataid[k])
        vertices, faces = (slice(int(a[0]), int(a[0] + n[0])) for a, n in _rows(asset))
        mesh = trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces])
    else:
        mesh = _primitive(int(model.geom_type[k]), model.geom_size[k])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[k])
    return mesh.apply_transform(_pose(turn, model.geom_pos[k]))


def _rows(asset):
    """Where the vertices and the faces of a mesh of a MuJoCo model begin, and how many they are."""
    return (asset.vertadr, asset.vertnum), (asset.faceadr, asset.facenum)


def _primitive(kind, size):
    """The trimesh.Trimesh of a MuJoCo geom."""
    shapes = mujoco.mjtGeom
    if kind == shapes.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == shapes.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=40)
    if kind == shapes.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(2 * size[1], size[0], count=[24, 24])
    if kind == shapes.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(3, size[0])
    raise ValueError(f"no mesh for geom type {kind}")


def _prop(mesh, colour):
    smooth = trimesh.graph.smooth_shade(mesh, angle=_CREASE_RAD)
    return ColoredMesh(np.asarray(smooth.vertices), np.asarray(smooth.faces), np.asarray(smooth.vertex_normals), colour)
