"""Objects to follow: the project's own by name, and any mesh from a file or from memory, validated before use."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.assets import MESHES
from tactip_twin.sim.contact.patch_normals import PATCH_M, scatter_deg
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import matrix
from tactip_twin.sim.robot.mesh_repair import MIN_SIZE_M, repaired
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.input_files import read_file

FORMATS = ("stl", "obj", "ply", "glb")
"""File formats that can be read, by ending."""

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 25.4e-3}
"""Units of a file's coordinates, m."""

MAX_SIZE_M = 2.0
"""Maximum size of an object, m: four times the arm's reach."""

MAX_TRIANGLES = 2_000_000

_MAX_FILE_BYTES = 2**30
"""Maximum size of a mesh file, bytes: several times that of MAX_TRIANGLES as text."""

_NOISY_DEG = 3.0
"""Scatter of the normals, degrees, from which a mesh counts as noisy; smooth objects with details have less than 0.4 [M]."""

_FOOT_M = (0.38, 0.0, 0.0)
"""Default position of the middle of an object's underside, base frame, m."""

_FEET_M = {"bust": (0.40, 0.0, 0.07)}
"""The same for objects that need another: on the table, the bust's face would bring the wrist close to singular."""


@dataclass(frozen=True)
class Edge:
    """An edge to follow, in the object's frame."""

    points: np.ndarray
    """(n, 3) m, along the edge."""
    normals: np.ndarray
    """(n, 3), unit, outward normals of the top surface."""
    closed: bool
    """Whether the edge is a loop."""


@dataclass(frozen=True)
class SceneObject:
    """An object and its pose."""

    name: str
    """The project's name, the file's name without its ending, or `mesh` for a mesh in memory."""
    solid: SignedDistanceMesh
    """Shape, in the object's frame."""
    T_base_object: np.ndarray
    """(4, 4)."""
    edge: Edge | None
    """Edge, if it is known."""
    middle_m: np.ndarray
    """(3,) m, base frame: the default middle of a route."""
    notes: tuple[str, ...] = ()
    """Repairs of the mesh, and doubts about it, as sentences."""

    @property
    def summary(self) -> str:
        """Size and number of triangles, for the user to check the unit."""
        size = np.ptp(self.solid.vertices @ self.T_base_object[:3, :3].T, axis=0)
        return f"{' × '.join(f'{1e3 * s:.0f}' for s in size)} mm, {len(self.solid.triangles)} triangles"


_ROTATIONS = {"bust": Rotation.from_matrix(np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]], float))}
"""Default rotations of the project's own objects: the bust lies on its back, face up, with its crown towards the arm."""


_MIDDLES_M = {"bust": (80e-3, 0.0, 55e-3)}
"""Middle of a route, if not the middle of the object, in the object's frame, m: the bust's face."""


_MAX_EDGE_DISTANCE_M, _PROBE_M = 1e-3, 0.5e-3
"""Largest median distance of an edge from its mesh, which may be rounded there, and distance from the edge at which the
object is looked for beside it, m [?]."""


def object_names() -> list[str]:
    """Return the names of the project's own objects."""
    return sorted(path.stem for path in MESHES.glob("*.ply"))


def load_object(
    source: str | PathLike[str] | trimesh.Trimesh,
    unit: str | None = None,
    scale: float = 1.0,
    position_mm: Sequence[float] | None = None,
    rotation_deg: Sequence[float] | None = None,
) -> SceneObject:
    """Load an object, validate its mesh and place it before the arm.

    Args:
        source: One of the project's names, a mesh file, or a mesh in memory (which is not changed).
        unit: Unit of the coordinates, of UNITS_M. By default m for a mesh in memory, and mm for a file, unless it would be
            too small: then it is taken as m, as glTF files are, and this is noted.
        scale: Scale factor.
        position_mm: (3,) mm, position of the middle of the object's underside, base frame; in front of the arm if None.
        rotation_deg: (3,) degrees, rotation vector, applied before that.

    Returns:
        The object.

    Raises:
        TactipError: If the object cannot be used, with the reason.
    """
    in_memory = isinstance(source, trimesh.Trimesh)
    name = "mesh" if in_memory else str(source)
    own = not in_memory and name in object_names()
    path = MESHES / f"{name}.ply" if own else Path(name)
    if not in_memory and not own and not path.is_file():
        if path.suffix:
            raise TactipError(f"there is no mesh file {name}")
        raise TactipError(f"unknown object {name!r}: choose one of {', '.join(object_names())}, or give a mesh file")
    if own and unit is not None:
        raise TactipError(f"unit applies to mesh files only, and {name!r} is a built-in object: leave --unit out")
    require(np.isfinite(scale) and scale > 0, "scale", scale, "above 0")
    for what, values in (("position_mm", position_mm), ("rotation_deg", rotation_deg)):
        require(values is None or np.isfinite(values).all(), what, values, "finite")
    if unit is not None:
        lookup("unit", unit, UNITS_M)
    mesh = source.copy() if in_memory else _read(path)
    taken = []
    if unit is None:
        unit = "m" if own or in_memory else _likely_unit(mesh, scale)
        if unit == "m" and not own and not in_memory:
            taken = [f"its coordinates are taken as metres: as millimetres, it would be below {1e3 * MIN_SIZE_M:g} mm"]
    mesh, notes = validate_mesh(mesh.apply_scale(UNITS_M[unit] * scale), name)
    notes = taken + notes
    turn = (
        Rotation.from_rotvec(np.radians(rotation_deg))
        if rotation_deg is not None
        else _ROTATIONS.get(name, Rotation.identity())
    )
    low, high = (f(mesh.vertices @ turn.as_matrix().T, axis=0) for f in (np.min, np.max))
    foot = np.array(_FEET_M.get(name, _FOOT_M)) if position_mm is None else np.array(position_mm, float) / 1e3
    T = matrix(foot - [*(low + high)[:2] / 2, low[2]], turn)
    edge = None if in_memory else _read_edge(path.with_suffix(".edge.csv"), scale)
    middle = turn.inv().apply((low + high) / 2)
    if own and name in _MIDDLES_M:
        middle = scale * np.array(_MIDDLES_M[name])
    solid = SignedDistanceMesh(mesh.vertices, mesh.faces)
    scatter = 0.0 if own else scatter_deg(solid)
    if scatter > _NOISY_DEG:
        notes.append(
            f"its normals scatter by {scatter:.0f}° within {1e3 * PATCH_M:g} mm, as those of a noisy scan: angles to the "
            "normal at a point mean little; smooth it first"
        )
    if edge is not None:
        _check_edge(edge, solid, path.with_suffix(".edge.csv"))
    return SceneObject(path.stem, solid, T, edge, (T @ [*middle, 1])[:3], tuple(notes))


def _likely_unit(mesh: trimesh.Trimesh, scale: float) -> str:
    """Return the unit of a file's coordinates: mm, or m if only that gives an allowed size."""
    size = float(mesh.extents.max()) * scale if len(mesh.faces) and np.isfinite(mesh.vertices).all() else np.nan
    return "m" if size * UNITS_M["mm"] < MIN_SIZE_M <= size * UNITS_M["m"] <= MAX_SIZE_M else "mm"


def validate_mesh(mesh: trimesh.Trimesh, name: str) -> tuple[trimesh.Trimesh, list[str]]:
    """Check that a mesh, in m, is finite and of an allowed size, and repair it. Arguments and results are those of
    `repaired`.

    Raises:
        TactipError: If the mesh is empty, not finite, of a wrong size, too fine, or cannot be repaired.
    """
    if not len(mesh.faces):
        raise TactipError(f"{name} has no triangles: the file is empty or truncated")
    if not np.isfinite(mesh.vertices).all():
        raise TactipError(f"{name} has vertices that are not finite")
    if len(mesh.faces) > MAX_TRIANGLES:
        raise TactipError(f"{name} must have at most {MAX_TRIANGLES} triangles, got {len(mesh.faces)}: simplify it first")
    size = float(mesh.extents.max())
    if not MIN_SIZE_M <= size <= MAX_SIZE_M:
        raise TactipError(
            f"the size of {name} must be between {1e3 * MIN_SIZE_M:g} and {1e3 * MAX_SIZE_M:g} mm, got {1e3 * size:g} mm: "
            f"check its unit (one of {', '.join(UNITS_M)}) and its scale"
        )
    return repaired(mesh, name)


def _read(path: Path) -> trimesh.Trimesh:
    """Return the mesh in a file, unchecked. Raises TactipError if there is none."""
    if path.suffix.lower().lstrip(".") not in FORMATS:
        raise TactipError(f"a mesh file must end in one of {', '.join(FORMATS)}, got {path}")
    data = read_file(path, _MAX_FILE_BYTES)
    try:
        # trimesh has no specific error for a damaged file; what it raises depends on the format. Without the file's
        # folder it opens no materials that the file names, and textures in the file are not unpacked.
        kind = path.suffix.lower().lstrip(".")
        mesh = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False, skip_materials=True)
    except Exception as error:
        raise TactipError(f"{path} cannot be read as a mesh: {error!r}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise TactipError(f"{path} contains no triangle mesh")
    if mesh.vertices.shape[1:] != (3,) or mesh.faces.shape[1:] != (3,):
        raise TactipError(f"{path} is damaged: its vertices have {mesh.vertices.shape[-1]} coordinates instead of 3")
    # Compiled libraries that get the mesh do not check its indices.
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise TactipError(f"{path} is damaged: it has triangles of vertices that it lacks")
    return mesh


_EDGE_COLUMNS, _MIN_EDGE_POINTS = 6, 2
"""Columns of an edge's table, and its minimum number of rows."""

_MAX_NORMAL_ERROR = 1e-3
"""Maximum difference of a normal's length from 1, because of the digits in the table."""


def _read_edge(path: Path, scale: float) -> Edge | None:
    """Return the edge in a file beside a mesh file; None if there is none. Raises TactipError if it is damaged.

    Rows of points in mm and unit normals of the top, anticlockwise from above; a closed edge ends with its first point.
    """
    if not path.exists():
        return None
    try:
        rows = np.array([[float(cell) for cell in line.split(",")] for line in read_file(path).decode().split()[1:]])
    except ValueError as error:
        raise TactipError(f"{path} is damaged: its cells must be numbers, six in each row: {error}") from error
    if rows.shape[1:] != (_EDGE_COLUMNS,) or len(rows) < _MIN_EDGE_POINTS or not np.isfinite(rows).all():
        raise TactipError(f"{path} is damaged: it must have at least {_MIN_EDGE_POINTS} rows of six finite numbers")
    if np.abs(rows).max() > 1e3 * MAX_SIZE_M:
        raise TactipError(f"{path} is damaged: its numbers must be from -{1e3 * MAX_SIZE_M:g} to {1e3 * MAX_SIZE_M:g}")
    if np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1).max() > _MAX_NORMAL_ERROR:
        raise TactipError(f"{path} is damaged: its normals must have the length 1")
    points = scale * rows[:, :3] / 1e3
    closed = bool(np.allclose(points[0], points[-1], atol=1e-6))
    return Edge(points, rows[:, 3:], closed)


def _check_edge(edge: Edge, solid: SignedDistanceMesh, path: Path) -> None:
    """Raise TactipError if an edge is not on its object, or runs round it the other way.

    Half of its points may be elsewhere: an edge may bridge gaps.
    """
    away_m = float(np.median(np.abs(solid.distance(edge.points))))
    if away_m > _MAX_EDGE_DISTANCE_M:
        raise TactipError(
            f"the edge in {path} must be on the mesh beside it, got {1e3 * away_m:.1f} mm from it in the median: its points "
            "must be in mm, in the mesh's axes"
        )
    tangents = np.gradient(edge.points, axis=0)
    off = np.cross(tangents, edge.normals)
    off *= _PROBE_M / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-12)
    below = edge.points - _PROBE_M * edge.normals
    if np.mean(solid.distance(below + off) > solid.distance(below - off)) < 0.5:
        raise TactipError(
            f"the edge in {path} must run anticlockwise as seen from above, with the object on its left: reverse its rows"
        )
