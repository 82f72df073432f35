"""Things to follow: the project's own by name, and any mesh from a file, looked over before it is used."""

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.assets import MESHES
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import matrix
from tactip_twin.tactip_model.errors import TactipError, lookup

FORMATS = ("stl", "obj", "ply", "glb")
"""Endings of the files that are read."""

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""What a file's numbers may be in, m."""

SMALLEST_M, LARGEST_M = 5e-3, 2.0
"""Least and greatest size of an object, m: between a quarter of the tip and four times the arm's reach."""

MOST_TRIANGLES = 2_000_000

_LEAST_M3 = 1e-12
"""Volume below which a closed surface has no inside, m^3: a cubic millimetre is a thousand times more."""

_FLAT = 0.02
"""How far from flat, in its width, a hole may be that is closed with a lid, -."""

_FOOT_M = (0.38, 0.0, 0.0)
"""Where the middle of an object's underside stands before the arm, base frame, m."""

_FEET_M = {"bust": (0.40, 0.0, 0.07)}
"""The same where it is elsewhere: on the table, the bust's face brings the wrist to where the arm is singular."""


@dataclass(frozen=True)
class Edge:
    """An edge to follow, in the object's frame."""

    points: np.ndarray
    """(n, 3) m, along it."""
    normals: np.ndarray
    """(n, 3), unit: outward of the top."""
    closed: bool
    """Whether it comes back to its start."""


@dataclass(frozen=True)
class SceneObject:
    """An object where it stands."""

    name: str
    """The project's, or its file's without the ending."""
    solid: SignedDistanceMesh
    """Its shape, in its own frame."""
    T_base_object: np.ndarray
    """(4, 4)."""
    edge: Edge | None
    """Its edge, if that is known."""
    middle_m: np.ndarray
    """(3,) m, in the base frame: over what part of it a route goes, if nothing else is said."""
    notes: tuple[str, ...] = ()
    """What was repaired."""


_TURNS = {"bust": Rotation.from_matrix(np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]], float))}
"""How the project's own lie, where it is not as they are: the bust on its back, its face up, its crown towards the arm."""


_MIDDLES_M = {"bust": (80e-3, 0.0, 55e-3)}
"""What is in the middle of a route, where it is not the middle of the object, in its own frame, m: the bust's face."""


def object_names():
    """Names (list of str) of the project's own objects."""
    return sorted(path.stem for path in MESHES.glob("*.ply"))


def load_object(name, unit=None, scale=1.0, place_mm=None, turn_deg=None):
    """The Thing of one of the project's names, or in a file.

    name: str or Path. unit: str of UNITS_M, what the file's numbers are in; mm if None. scale: float. place_mm: (3,), where
    the middle of its underside is in the arm's base frame; in front of the arm if None. turn_deg: (3,), rotation vector
    before that.
    Raises TactipError on what cannot be used, with the reason.
    """
    own = str(name) in object_names()
    path = MESHES / f"{name}.ply" if own else Path(name)
    if not own and not path.is_file():
        raise TactipError(f"there is no object {str(name)!r}: choose one of {', '.join(object_names())}, or name a file")
    if own and unit is not None:
        raise TactipError(f"the object {str(name)!r} comes with its size, and --unit {unit} is of files: leave it out")
    size = (1.0 if own else lookup("unit", unit or "mm", UNITS_M)) * scale
    if not np.isfinite(size) or size <= 0:
        raise TactipError(f"the scale is {scale}: it must be above 0")
    mesh = _read(path)
    mesh.apply_scale(size)
    mesh, notes = checked(mesh, str(name))
    turn = Rotation.from_rotvec(np.radians(turn_deg)) if turn_deg is not None else _TURNS.get(str(name), Rotation.identity())
    low, high = (f(mesh.vertices @ turn.as_matrix().T, axis=0) for f in (np.min, np.max))
    foot = np.array(_FEET_M.get(str(name), _FOOT_M)) if place_mm is None else np.array(place_mm, float) / 1e3
    T = matrix(foot - [*(low + high)[:2] / 2, low[2]], turn)
    edge = _edge(MESHES / f"{name}.edge.csv", scale) if own else None
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    if own and name in _MIDDLES_M:
        middle = scale * np.array(_MIDDLES_M[name])
    return SceneObject(
        Path(name).stem, SignedDistanceMesh(mesh.vertices, mesh.faces), T, edge, (T @ [*middle, 1])[:3], tuple(notes)
    )


def checked(mesh, name):
    """A trimesh.Trimesh, in metres, made fit for use, and a list of notes (str) of what was repaired.

    Raises TactipError where it is empty, not finite, far too large or fine, open beyond repair, or has no inside.
    """
    notes = []
    if not len(mesh.faces):
        raise TactipError(f"{name} has no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise TactipError(f"{name} has vertices that are not finite")
    if len(mesh.faces) > MOST_TRIANGLES:
        raise TactipError(f"{name} has {len(mesh.faces)} triangles: at most {MOST_TRIANGLES} are taken; simplify it first")
    size = float(mesh.extents.max())
    if not SMALLEST_M <= size <= LARGEST_M:
        raise TactipError(
            f"{name} is {1e3 * size:g} mm large: it must be {1e3 * SMALLEST_M:g} to {1e3 * LARGEST_M:g} mm; "
            f"is the unit right (one of {', '.join(UNITS_M)})?"
        )
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices()
    before = len(mesh.faces)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < before:
        notes.append(f"{before - len(mesh.faces)} triangles without an area, or doubled, were left out")
    if not mesh.is_watertight:
        notes += _close(mesh, name)
    if not mesh.is_winding_consistent:
        mesh.faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(mesh.faces, np.int64))[0])
        notes.append("triangles that were wound the wrong way were turned over")
    if not mesh.is_watertight:
        raise TactipError(f"{name} is no closed surface: some borders belong to more than two triangles; repair it first")
    volume = _volume(mesh)
    if volume < 0:
        mesh.invert()
        notes.append("its triangles faced inward and were turned over")
    if abs(volume) < _LEAST_M3:
        raise TactipError(f"{name} has no inside: its volume is {1e9 * abs(volume):g} mm^3")
    return mesh, notes


def _volume(mesh):
    """Volume (m^3) inside of a closed mesh; negative where it is inside out."""
    a, b, c = (mesh.vertices - mesh.vertices.mean(0))[mesh.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _close(mesh, name):
    """Close the flat holes of a mesh with lids. Returns notes."""
    sides = mesh.edges_sorted
    order = np.lexsort(sides.T)
    _, first, count = np.unique(sides[order], axis=0, return_index=True, return_counts=True)
    if (count > 2).any():
        raise TactipError(
            f"{name} is no surface: {int((count > 2).sum())} borders belong to more than two triangles; repair it first"
        )
    open_sides = mesh.edges[order[first[count == 1]]]
    if not len(open_sides):
        return []
    follows = dict(open_sides.tolist())
    if len(follows) < len(open_sides):
        raise TactipError(f"{name} is open, and its holes touch each other: close it first")
    lids, vertices = [], [mesh.vertices]
    new, holes = len(mesh.vertices), 0
    while follows:
        start, here = next(iter(follows.items()))
        loop = [start]
        del follows[start]
        while here != start:
            loop.append(here)
            here = follows.pop(here, None)
            if here is None:
                raise TactipError(
                    f"{name} is open, and the border of a hole does not come back to its start: close it first"
                )
        points = mesh.vertices[loop]
        spread = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
        if spread[2] > _FLAT * spread[0]:
            raise TactipError(
                f"{name} is open: a hole of {len(loop)} sides, {1e3 * np.ptp(points, axis=0).max():.0f} mm wide, is not "
                "flat, and how it goes on there cannot be guessed; close it first"
            )
        vertices.append(points.mean(0)[None])
        lids += [[b, a, new + holes] for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
        holes += 1
    mesh.vertices, mesh.faces = np.concatenate(vertices), np.concatenate([mesh.faces, np.array(lids)])
    return [f"{holes} flat hole(s) were closed with a lid"]


def _read(path):
    """A trimesh.Trimesh of a file."""
    if path.suffix.lower().lstrip(".") not in FORMATS:
        raise TactipError(f"{path} cannot be read: an object's file ends in one of {', '.join(FORMATS)}")
    try:
        # trimesh has no error of its own for a damaged file: what comes up depends on the format.
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:
        raise TactipError(f"{path} cannot be read as a mesh: {error!r}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise TactipError(f"{path} holds no mesh of triangles")
    return mesh


def _edge(path, scale):
    """The Edge in a file of the project's own; None if there is none."""
    if not path.exists():
        return None
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    points = scale * rows[:, :3] / 1e3
    closed = bool(np.allclose(points[0], points[-1], atol=1e-6))
    return Edge(points, rows[:, 3:], closed)
