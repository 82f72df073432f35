"""Geometry of a recording as colored meshes in the arm's base frame: arm, object, soft skin and the path of the contact.

The renderers (offscreen.py, viser_utils.py, replay_window.py) know nothing of robots.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import trimesh
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import sensor_in_contact
from tactip_twin.sim.robot.irb120 import arm_spec
from tactip_twin.sim.robot.recording import PHASES, RecordedScene
from tactip_twin.sim.view.palette import ERROR_RAMP, HOUSING_COLOR, OBJECT_COLOR, SKIN_COLOR, TABLE_COLOR, Color, ramp_colors

_CREASE_RAD = 0.6
"""Angle between two faces of an arm part above which their border is a crease, rad."""

_NORMAL_M = 3e-3
_NORMAL_SPACING_M = 2.5e-3
"""Length of the normals that are shown, and their spacing along the path, m."""

_PEDESTAL = 0.6
"""Width of an object's pedestal over its own, -."""

_TABLE_M = (0.9, 0.7)
"""Length and width of the table, m."""


@dataclass(frozen=True)
class ColoredMesh:
    """A colored surface."""

    vertices: np.ndarray
    """(n, 3) m."""
    triangles: np.ndarray
    """(k, 3) int."""
    normals: np.ndarray
    """(n, 3), unit."""
    color: Color
    """Red, green and blue, 0 to 255."""
    vertex_colors: np.ndarray | None = None
    """(n, 3), 0 to 255, colors of the vertices; None if all have `color`."""
    lit: bool = True
    """Whether it is shaded; a mesh whose colors are read by a scale is not."""

    def transformed(self, T: np.ndarray) -> "ColoredMesh":
        """Return this mesh transformed by T (4, 4)."""
        turn = T[:3, :3].T
        return replace(self, vertices=self.vertices @ turn + T[:3, 3], normals=self.normals @ turn)


class SceneGeometry:
    """The meshes of a recording, each in the frame that it is fixed to."""

    def __init__(self, scenery: RecordedScene, held: bool = False) -> None:
        """Build the meshes of a recorded scene.

        Args:
            scenery: The scene.
            held: Whether something that is not shown holds the object, and moves it, so it has no pedestal.
        """
        self.object = solid_mesh(SignedDistanceMesh(scenery.object_vertices, scenery.object_triangles))
        """Mesh of the object, in its own frame."""
        self.table = _table(None if held else self.object.transformed(scenery.T_base_object))
        """Mesh of the table, base frame."""
        self.skin_triangles = scenery.skin_triangles
        """(t, 3) int."""
        self._model = arm_spec(scenery.tip_radius_m).compile()
        self._data = mujoco.MjData(self._model)
        names = [self._model.body(k).name for k in range(1, self._model.nbody)] if scenery.with_arm else []
        self.links = {name: body_meshes(self._model, name) for name in names if name != "sensor"}
        """Meshes of each body of the arm, in the body's frame; empty without an arm."""
        self.sensor = sensor_meshes(scenery.tip_radius_m)
        """Meshes of the sensor without its skin, sensor frame."""

    def skin_mesh(self, skin: np.ndarray, colors: np.ndarray | None = None) -> ColoredMesh:
        """Return the mesh of recorded skin vertices (s, 3) m, sensor frame, with colors (s, 3) or all alike."""
        return ColoredMesh(
            np.asarray(skin, float), self.skin_triangles, skin_normals(skin, self.skin_triangles), SKIN_COLOR, colors
        )

    def body_poses(self, angles: ArrayLike) -> dict[str, np.ndarray]:
        """Return T_base_body (4, 4) of each body at joint angles (6,), rad."""
        self._data.qpos[:] = angles
        mujoco.mj_kinematics(self._model, self._data)
        return {self._model.body(k).name: _pose(self._data.xmat[k], self._data.xpos[k]) for k in range(self._model.nbody)}

    def moving_meshes(
        self, angles: np.ndarray, T_base_tcp: np.ndarray, skin: np.ndarray, skin_colors: np.ndarray | None = None
    ) -> list[ColoredMesh]:
        """Return the meshes of sensor and arm at a step, base frame.

        Args:
            angles: (6,) rad; NaN without an arm.
            T_base_tcp: (4, 4).
            skin: (s, 3) m, sensor frame.
            skin_colors: (s, 3), 0 to 255; None for one color.
        """
        # The sensor is placed by its own pose instead of the joint angles: the two agree up to rounding.
        out = [mesh.transformed(T_base_tcp) for mesh in [self.skin_mesh(skin, skin_colors), *self.sensor]]
        if self.links and np.isfinite(angles).all():
            poses = self.body_poses(angles)
            out += [mesh.transformed(poses[body]) for body, meshes in self.links.items() for mesh in meshes]
        return out


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.reshape(rotation, (3, 3)), position
    return T


def object_moves(arrays: Mapping[str, np.ndarray]) -> bool:
    """Return whether the object of a recording (tactip_twin.sim.robot.recording.ARRAYS) moves."""
    return bool(np.ptp(arrays["T_base_object"], axis=0).any()) if len(arrays["T_base_object"]) else False


def object_mesh(scenery: RecordedScene) -> ColoredMesh:
    """Return the mesh of a recorded scene's object, base frame, at the start."""
    solid = SignedDistanceMesh(scenery.object_vertices, scenery.object_triangles)
    return solid_mesh(solid).transformed(scenery.T_base_object)


def solid_mesh(solid: SignedDistanceMesh) -> ColoredMesh:
    """Return the mesh of a solid, in its own frame."""
    corners = solid.vertices[solid.triangles].reshape(-1, 3)
    triangles = np.arange(len(corners)).reshape(-1, 3)
    return ColoredMesh(corners, triangles, solid.corner_normals.reshape(-1, 3), OBJECT_COLOR)


def predicted_frames(arrays: Mapping[str, np.ndarray], end: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the predicted contact frames of the steps of the phase `follow`.

    Args:
        arrays: Arrays of a recording (tactip_twin.sim.robot.recording.ARRAYS).
        end: First step that is left out; all steps are taken if None.

    Returns:
        T_base_contact (n, 4, 4) and their steps (n,).
    """
    steps = np.flatnonzero((arrays["phase"] == PHASES.index("follow"))[:end])
    frames = [arrays["T_base_tcp"][k] @ np.linalg.inv(sensor_in_contact(arrays["predicted"][k])) for k in steps]
    return np.array(frames).reshape(-1, 4, 4), steps


def path_meshes(
    arrays: Mapping[str, np.ndarray], errors: np.ndarray, largest: float, end: int | None = None
) -> list[ColoredMesh]:
    """Return meshes of a recording's path and of the normals predicted on it, colored by error.

    Args:
        arrays: Arrays of a recording (tactip_twin.sim.robot.recording.ARRAYS).
        errors: (steps,) errors by which it is colored.
        largest: Error at the end of the color scale.
        end: First step that is left out; all steps are taken if None.
    """
    frames, steps = predicted_frames(arrays, end)
    places, chosen, ends = _path(frames)
    if len(places) < 2:
        return []
    colors = ramp_colors(errors[steps], largest, ERROR_RAMP)
    normals = [tube(np.stack([places[k], ends[n]]), 0.3e-3, colors[[k, k]]) for n, k in enumerate(chosen)]
    return [replace(mesh, lit=False) for mesh in (tube(places, 0.7e-3, colors), *normals)]


def path_lines(
    arrays: Mapping[str, np.ndarray], errors: np.ndarray, largest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a recording's path and normals as line segments, colored by error.

    Args:
        arrays: Arrays of a recording (tactip_twin.sim.robot.recording.ARRAYS).
        errors: (steps,) errors by which it is colored.
        largest: Error at the end of the color scale.

    Returns:
        Segments (m, 2, 3) m, float32, in order of time, their colors (m, 3) uint8, and their number up to each step,
        (steps,) int.
    """
    frames, steps = predicted_frames(arrays)
    places, chosen, ends = _path(frames)
    lines = np.concatenate([np.stack([places[:-1], places[1:]], 1), np.stack([places[chosen], ends], 1)])
    # A piece of the path appears with its second end, a normal with its place.
    appears = np.concatenate([steps[1:], steps[chosen]])
    order = np.argsort(appears, kind="stable")
    counts = np.searchsorted(appears[order], np.arange(len(arrays["phase"])), side="right")
    colors = ramp_colors(errors[appears[order]], largest, ERROR_RAMP).round().astype(np.uint8)
    return lines[order].astype(np.float32), colors, counts


def _path(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, of frames (n, 4, 4), places (n, 3), indices (m,) of those that get a normal, and the normals' ends (m, 3)."""
    places = frames[:, :3, 3] + 0.6e-3 * frames[:, :3, 2]
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    if len(places) > 1:
        chosen = np.unique(np.searchsorted(lengths, np.arange(0, lengths[-1], _NORMAL_SPACING_M)))
    else:
        chosen = np.zeros(0, int)
    return places, chosen, places[chosen] + _NORMAL_M * frames[chosen, :3, 2]


def nearest_to_ray(places: np.ndarray, origin: ArrayLike, direction: ArrayLike, max_rad: float) -> int | None:
    """Return the index of the place that a ray passes at the smallest angle, seen from its origin; None if all are farther
    from it than `max_rad`.

    Args:
        places: (n, 3) m.
        origin: (3,) m.
        direction: (3,), unit.
        max_rad: Largest angle, rad.
    """
    away = places - np.asarray(origin)
    along = away @ np.asarray(direction)
    angles = np.arctan2(np.linalg.norm(away - along[:, None] * direction, axis=1), along)
    if not len(angles) or angles.min() > max_rad:
        return None
    return int(angles.argmin())


def skin_normals(skin: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the normals (s, 3) of a skin with vertices (s, 3) and triangles (t, 3)."""
    return np.asarray(trimesh.Trimesh(skin, triangles, process=False).vertex_normals)


def skin_displacements_mm(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return how far each vertex of the skin is from its place at the first step, where the tip is in the air, (n, s) mm."""
    return 1e3 * np.linalg.norm(arrays["skin_m"] - arrays["skin_m"][:1], axis=2)


def tube(points: np.ndarray, radius_m: float, colors: np.ndarray, sides: int = 8) -> ColoredMesh:
    """Return a tube along points.

    Args:
        points: (n, 3) m, at least two.
        radius_m: Radius, m.
        colors: (n, 3), 0 to 255, colors at the points.
        sides: Number of sides of its cross-section.
    """
    tangents = np.gradient(points, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    u = np.cross(tangents, [0.3, 0.5, 0.81])
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    v = np.cross(tangents, u)
    turn = 2 * np.pi * np.arange(sides) / sides
    normals = np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * v[:, None]
    rings = points[:, None] + radius_m * normals
    k, j = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    a, b = (k * sides + j).ravel(), (k * sides + (j + 1) % sides).ravel()
    triangles = np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    return ColoredMesh(
        rings.reshape(-1, 3), triangles, normals.reshape(-1, 3), OBJECT_COLOR, np.repeat(np.asarray(colors, float), sides, 0)
    )


def _table(placed: ColoredMesh | None) -> ColoredMesh:
    """Return the table, with a pedestal under an object (base frame) that is above it; None: without one."""
    table = trimesh.creation.box([*_TABLE_M, 0.02])
    table.apply_translation([0.3, 0, -0.0101])
    if placed is None:
        return _shaded(table, TABLE_COLOR)
    low, high = placed.vertices.min(0), placed.vertices.max(0)
    if low[2] > 1e-3:
        pedestal = trimesh.creation.box([*(_PEDESTAL * (high - low)[:2]), low[2]])
        pedestal.apply_translation([*(low + high)[:2] / 2, low[2] / 2])
        table = table + pedestal
    return _shaded(table, TABLE_COLOR)


def sensor_meshes(tip_radius_m: float) -> list[ColoredMesh]:
    """Return the meshes of a sensor without its skin, sensor frame. tip_radius_m: radius of the tip, m."""
    model = arm_spec(tip_radius_m).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    site, body = model.site("tcp").id, model.body("sensor").id
    T_base_tcp = _pose(data.site_xmat[site], data.site_xpos[site])
    T_tcp_sensor = np.linalg.inv(T_base_tcp) @ _pose(data.xmat[body], data.xpos[body])
    return [mesh.transformed(T_tcp_sensor) for mesh in body_meshes(model, "sensor", HOUSING_COLOR)]


def body_meshes(model: mujoco.MjModel, name: str, color: Color | None = None) -> list[ColoredMesh]:
    """Return the meshes of a body's geoms, in the body's frame.

    Args:
        model: Model that has the body.
        name: Name of the body.
        color: Color of the meshes; that of each geom's material if None.
    """
    out = []
    for k in _geoms(model, name):
        if model.geom(k).name != "dome":  # the simulated skin is shown instead
            red, green, blue = 255 * model.mat_rgba[model.geom_matid[k], :3] if color is None else color
            out.append(_shaded(_geom_mesh(model, k), (float(red), float(green), float(blue))))
    return out


def body_mesh(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) m and triangles (k, 3) of a body of a model, in the body's frame."""
    whole = trimesh.util.concatenate([_geom_mesh(model, k) for k in _geoms(model, name)])
    return np.asarray(whole.vertices), np.asarray(whole.faces)


def _geoms(model: mujoco.MjModel, name: str) -> list[int]:
    """Return the indices of a body's geoms."""
    return [k for k in range(model.ngeom) if model.body(model.geom_bodyid[k]).name == name]


def _geom_mesh(model: mujoco.MjModel, k: int) -> trimesh.Trimesh:
    """Return the mesh of geom k, in its body's frame."""
    if model.geom_type[k] == mujoco.mjtGeom.mjGEOM_MESH:
        asset = model.mesh(model.geom_dataid[k])
        vertices, faces = _rows(asset.vertadr, asset.vertnum), _rows(asset.faceadr, asset.facenum)
        mesh = trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces])
    else:
        mesh = _primitive(int(model.geom_type[k]), model.geom_size[k])
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[k])
    return mesh.apply_transform(_pose(turn, model.geom_pos[k]))


def _rows(address: np.ndarray, count: np.ndarray) -> slice:
    """Return the rows of a mesh asset, whose first row and number of rows are arrays of one element."""
    return slice(int(address[0]), int(address[0] + count[0]))


def _primitive(kind: int, size: np.ndarray) -> trimesh.Trimesh:
    """Return the mesh of a primitive geom of a type (mjtGeom) and size."""
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


def _shaded(mesh: trimesh.Trimesh, color: Color) -> ColoredMesh:
    """Return a mesh with smooth normals between its creases."""
    smooth = trimesh.graph.smooth_shade(mesh, angle=_CREASE_RAD)
    return ColoredMesh(np.asarray(smooth.vertices), np.asarray(smooth.faces), np.asarray(smooth.vertex_normals), color)
