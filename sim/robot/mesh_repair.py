"""Repairs of meshes as scans have them, where these are safe, and the reasons to refuse a mesh otherwise.

A mesh is welded, rid of what is no surface, oriented, closed, and turned outward, in this order, because each step needs
those before it. What a repair did is noted.
"""

import igl
import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tactip_twin.tactip_model.errors import TactipError

MIN_SIZE_M = 5e-3
"""Minimum size of an object and of its separate parts, m: a quarter of the tip."""

_WELD_DIGITS = 6
"""Digits of a coordinate, m, to which vertices of a mesh with open seams are rounded before they are compared."""

_SLIVER_M = 1e-8
"""Height of a triangle over its longest side up to which it has no normal, m."""

_MAX_FLIPS = 30
"""Maximum number of rounds in which slivers give their longest side to a neighbour."""

_FRAGMENT = 0.01
"""Area of a separate part over that of the largest one, below which it is a fragment if it is open or small [?]."""

_MAX_HOLE_UNEVENNESS, _MAX_HOLE_RMS_M = 0.02, 0.3e-3
"""Height of a hole's border over its width (root mean squares), -, or alone, m, up to which a lid closes the hole: it is
flat, or as uneven as scans are [?]."""

_SMALL_HOLE_M = 6e-3
"""Width up to which a lid closes any hole, m: the tip, of 20 mm radius, does not reach into it [?]."""

_PROBES, _PROBE_M = 2000, 10e-6
"""Number of facets beside which the inside is checked, and the distance from them, m."""

_MAX_WRONG_SIDES = 0.01
"""Fraction of these probes that may lie on a wrong side, -."""

_MIN_VOLUME_M3 = 1e-12
"""Volume below which a closed surface counts as empty, m^3: a cubic millimetre is a thousand times more."""

_FLIPPED = "triangles with inconsistent winding were flipped"
"""Note after which a part that had to be turned outward is not noted again."""

_MAX_COMPARED_PARTS = 200
"""Number of separate parts up to which it is checked which lie inside of others."""


def repaired(mesh: trimesh.Trimesh, name: str) -> tuple[trimesh.Trimesh, list[str]]:
    """Repair a mesh if that is safe, and check that it bounds a volume.

    Args:
        mesh: The mesh, in m. It is not changed.
        name: Name of the object, for messages.

    Returns:
        The repaired mesh, and notes on the repairs.

    Raises:
        TactipError: If the mesh is no surface, open beyond repair, or encloses no volume.
    """
    notes: list[str] = []
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices()
    if not mesh.is_watertight:
        mesh.merge_vertices(digits_vertex=_WELD_DIGITS)
    _remove_degenerate(mesh, notes)
    if not len(mesh.faces):
        raise TactipError(f"{name} has no triangles of an area above 0")
    _remove_fragments(mesh, notes)
    _check_edges(mesh, name)
    if not mesh.is_winding_consistent:
        mesh.faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(mesh.faces, np.int64))[0])
        notes.append(_FLIPPED)
    if not mesh.is_watertight:
        notes.append(_fill_holes(mesh, name))
    if not mesh.is_watertight:
        raise TactipError(f"{name} is not a closed surface, also after its holes were filled; repair it first")
    _turn_outward(mesh, notes)
    volume = _volumes(mesh, np.zeros(len(mesh.faces), int), 1)[0]
    if volume < _MIN_VOLUME_M3:
        raise TactipError(f"{name} does not enclose a volume: {1e9 * abs(volume):g} mm^3")
    wrong = _wrong_sides(mesh)
    if wrong > _MAX_WRONG_SIDES:
        united, count = _united(mesh)
        if united is not None and _wrong_sides(united) <= _MAX_WRONG_SIDES:
            return united, [*notes, f"{count} overlapping parts were united"]
        notes.append(
            f"parts of it overlap, or it intersects itself: {wrong:.0%} of its facets are inside of it or doubled, and "
            "depths near them are wrong; unite its parts first"
        )
    return mesh, notes


def _volumes(mesh: trimesh.Trimesh, parts: np.ndarray, count: int) -> np.ndarray:
    """Return the volumes (count,), m^3, inside of the parts of a closed mesh; negative if they are inside out."""
    a, b, c = (mesh.vertices - mesh.vertices.mean(0))[mesh.faces].transpose(1, 0, 2)
    return np.bincount(parts, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)


def _remove_degenerate(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    """Remove doubled triangles and those without area, in place, without opening the surface."""
    before = len(mesh.faces)
    a, b, c = mesh.faces.T
    mesh.update_faces((a != b) & (b != c) & (c != a) & mesh.unique_faces())
    _flip_slivers(mesh)
    if not mesh.is_watertight:
        mesh.update_faces(_heights(mesh) > _SLIVER_M)
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < before:
        notes.append(f"{before - len(mesh.faces)} degenerate or duplicate triangles were removed")


def _heights(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the heights (k,), m, of triangles over their longest sides."""
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return area / np.maximum(longest, 1e-300)


def _flip_slivers(mesh: trimesh.Trimesh) -> None:
    """Give triangles with three points on a line another longest side, in place: with the neighbour there, they form a
    quadrangle, which is cut along its other diagonal. So the surface stays closed."""
    for _ in range(_MAX_FLIPS):
        slivers = np.flatnonzero(_heights(mesh) <= _SLIVER_M)
        if not len(slivers):
            return
        faces = mesh.faces.copy()
        corners = mesh.vertices[faces[slivers]]
        # Side k is opposite to corner k: from corner k + 1 to corner k + 2.
        top = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2).argmax(1)
        m, a, b = (faces[slivers, (top + k) % 3] for k in range(3))
        count = len(mesh.vertices)
        sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
        keys, owner = sides[:, 0] * count + sides[:, 1], np.tile(np.arange(len(faces)), 3)
        order = np.argsort(keys, kind="stable")
        wanted = b.astype(np.int64) * count + a
        at = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
        neighbour = np.where(keys[order][at] == wanted, owner[order][at], -1)
        used = np.zeros(len(faces), bool)
        for k in np.flatnonzero(neighbour >= 0):
            one, other = slivers[k], neighbour[k]
            if used[one] or used[other] or one == other:
                continue
            used[[one, other]] = True
            d = next(v for v in faces[other] if v not in (a[k], b[k]))
            faces[one], faces[other] = (a[k], d, m[k]), (d, b[k], m[k])
        if not used.any():
            return
        mesh.faces = faces


def _parts(mesh: trimesh.Trimesh) -> tuple[int, np.ndarray]:
    """Return the number of separate parts, and the part (k,) of each triangle."""
    a, b, c = mesh.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_matrix((np.ones(2 * len(a), bool), ends), (len(mesh.vertices),) * 2)
    _, of_vertex = connected_components(links, directed=False)
    used, parts = np.unique(of_vertex[a], return_inverse=True)
    return len(used), parts


def _extents(mesh: trimesh.Trimesh, parts: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (count, 3) and (count, 3), m, of the boxes around the parts."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in mesh.faces.T:
        np.minimum.at(low, parts, mesh.vertices[corner])
        np.maximum.at(high, parts, mesh.vertices[corner])
    return low, high


def _remove_fragments(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    """Remove separate parts of little area that are open or smaller than an object may be, in place: dirt of a scan."""
    count, parts = _parts(mesh)
    if count == 1:
        return
    area = np.bincount(parts, mesh.area_faces, count)
    low, high = _extents(mesh, parts, count)
    _, inverse, uses = np.unique(_sides(mesh), return_inverse=True, return_counts=True)
    is_open = np.bincount(np.repeat(parts, 3), uses[inverse] == 1, count) > 0
    small = (high - low).max(1) < MIN_SIZE_M
    removed = (area < _FRAGMENT * area.max()) & (is_open | small)
    if removed.any():
        mesh.update_faces(~removed[parts])
        mesh.remove_unreferenced_vertices()
        notes.append(f"{int(removed.sum())} loose fragment(s) were removed")


def _sides(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return a number (3 k,) for each side of each triangle, the same for the two directions."""
    sides = mesh.edges_sorted.astype(np.int64)
    return sides[:, 0] * len(mesh.vertices) + sides[:, 1]


def _check_edges(mesh: trimesh.Trimesh, name: str) -> None:
    """Raise TactipError if edges belong to more than two triangles."""
    if mesh.is_watertight:
        return
    _, count = np.unique(_sides(mesh), return_counts=True)
    if (count > 2).any():
        raise TactipError(
            f"{name} is not a surface: {int((count > 2).sum())} edges belong to more than two triangles; repair it first"
        )


def _fill_holes(mesh: trimesh.Trimesh, name: str) -> str:
    """Fill the holes of an oriented mesh that are flat or small, in place, and return a note. Raises TactipError if other
    holes remain."""
    _, first, count = np.unique(_sides(mesh), return_index=True, return_counts=True)
    loops = _loops(mesh.edges[first[count == 1]])
    if not loops:
        raise TactipError(f"{name} is open, and its open edges do not form closed loops: close it first")
    lids, vertices, widths, refused = [], [mesh.vertices], [], []
    for loop in loops:
        points = mesh.vertices[loop]
        width = float(np.ptp(points, axis=0).max())
        spread = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
        flat = spread[2] <= max(_MAX_HOLE_UNEVENNESS * spread[0], _MAX_HOLE_RMS_M)
        if not flat and width > _SMALL_HOLE_M:
            refused.append(width)
            continue
        new = len(mesh.vertices) + len(widths)
        vertices.append(points.mean(0)[None])
        lids += [[b, a, new] for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
        widths.append(width)
    if refused:
        raise TactipError(
            f"{name} is open: {len(refused)} of its {len(loops)} hole(s), up to {1e3 * max(refused):.0f} mm wide, cannot be "
            f"filled, because a hole wider than {1e3 * _SMALL_HOLE_M:g} mm must be flat; close them first"
        )
    mesh.vertices, mesh.faces = np.concatenate(vertices), np.concatenate([mesh.faces, np.array(lids)])
    return f"{len(widths)} flat or small hole(s) were filled, up to {1e3 * max(widths):.1f} mm wide"


def _loops(sides: np.ndarray) -> list[list[int]] | None:
    """Return the closed loops, without a vertex twice, of directed sides (n, 2); None if some side is in none."""
    following: dict[int, list[int]] = {}
    for a, b in sides.tolist():
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        path: list[int] = []
        place: dict[int, int] = {}
        here = next(iter(following))
        while True:
            if here in place:  # a loop ends; where holes touch, the path before it continues
                start = place[here]
                loops.append(path[start:])
                for vertex in path[start:]:
                    del place[vertex]
                path = path[:start]
                if not path and here not in following:
                    break
            place[here] = len(path)
            path.append(here)
            if here not in following:
                return None
            after = following[here].pop()
            if not following[here]:
                del following[here]
            here = after
    return loops


def _turn_outward(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    """Turn the separate parts of a closed mesh outward, and remove those inside of others, which nothing can touch, in
    place."""
    count, parts = _parts(mesh)
    inward = _volumes(mesh, parts, count) < 0
    if inward.any():
        faces = mesh.faces.copy()
        faces[inward[parts]] = faces[inward[parts]][:, ::-1]
        mesh.faces = faces
    inside = _inside_others(mesh, parts, count) if 1 < count <= _MAX_COMPARED_PARTS else np.zeros(count, bool)
    if (inward & ~inside).any() and _FLIPPED not in notes:
        notes.append("triangles faced inward and were flipped")
    if inside.any():
        mesh.update_faces(~inside[parts])
        mesh.remove_unreferenced_vertices()
        notes.append(f"{int(inside.sum())} closed surface(s) inside of it were removed")


def _inside_others(mesh: trimesh.Trimesh, parts: np.ndarray, count: int) -> np.ndarray:
    """Return which parts (count,) bool of a closed mesh lie inside of another one, as a whole."""
    low, high = _extents(mesh, parts, count)
    out = np.zeros(count, bool)
    for k in range(count):
        vertices = np.unique(mesh.faces[parts == k])
        points = mesh.vertices[vertices[:: max(1, len(vertices) // 50)]]
        for other in np.flatnonzero((low <= low[k]).all(1) & (high >= high[k]).all(1)):
            if other != k and (_winding(mesh.vertices, mesh.faces[parts == other], points) > 0.5).all():
                out[k] = True
                break
    return out


def _united(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh | None, int]:
    """Return the union of the separate parts of a closed mesh, None if there is none, and the number of parts."""
    import manifold3d

    count, parts = _parts(mesh)
    if not 1 < count <= _MAX_COMPARED_PARTS:
        return None, count
    solids = []
    for k in range(count):
        used, faces = np.unique(mesh.faces[parts == k], return_inverse=True)
        faces = np.ascontiguousarray(faces.reshape(-1, 3), np.uint64)
        solids.append(manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(mesh.vertices[used]), faces)))
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    if whole.status() != manifold3d.Error.NoError or whole.is_empty():
        return None, count
    found = whole.to_mesh64()
    out = trimesh.Trimesh(found.vert_properties[:, :3], found.tri_verts.astype(np.int64), process=False)
    return (out if out.is_watertight else None), count


def _wrong_sides(mesh: trimesh.Trimesh) -> float:
    """Return the fraction of facets that do not have the inside on one side and the outside on the other."""
    chosen = np.unique(np.linspace(0, len(mesh.faces) - 1, _PROBES).astype(int))
    chosen = chosen[_heights(mesh)[chosen] > 10 * _PROBE_M]
    if not len(chosen):
        return 0.0
    middles, normals = mesh.vertices[mesh.faces[chosen]].mean(1), mesh.face_normals[chosen]
    probes = np.concatenate([middles + _PROBE_M * normals, middles - _PROBE_M * normals])
    outside, inside = _winding(mesh.vertices, mesh.faces, probes).reshape(2, -1)
    return float(np.mean((np.abs(outside) > 0.5) | (np.abs(inside - 1) > 0.5)))


def _winding(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how often a mesh winds round points (n, 3): 1 inside of a closed surface, 0 outside."""
    V, F = np.ascontiguousarray(vertices, float), np.ascontiguousarray(faces, np.int64)
    return np.atleast_1d(igl.fast_winding_number(V, F, np.ascontiguousarray(points, float)))
