"""Make the meshes of this folder: `python -m tactip_twin.assets.meshes.make`.

This takes some minutes and needs scikit-image, from the extra `dev`. Marching cubes triangulates solids (solids.py), and
the vertices are then projected onto the solid's surface; rims (rims.py) are swept. The bust is rounded to suit the
fingertip, because a ball of 20 mm fits into no narrower hollow. Meshes are in metres. An object with an edge to follow also
has a file of the edge: points and the outward normal of the top; a closed edge ends with its first point.
"""

from collections.abc import Callable
from pathlib import Path

import igl
import numpy as np
import trimesh

from tactip_twin.assets.meshes.rims import RIMS, Rim, block
from tactip_twin.assets.meshes.solids import BUST_SCALE, ball, bust, saddle

HERE = Path(__file__).parent

SPHERE_MM = 60.0
"""Radius of the sphere, mm."""

_SPACING_MM = 1.5
"""Width of the cubes of marching cubes, mm."""

HOLLOW_MM, RIDGE_MM = 36.0, 12.5
"""Smallest radii of the bust's hollows and of its ridges, mm: those of the curved surfaces in the training sets."""

_EDGE_POINTS = 720
"""Number of points on an edge."""


def cut(
    solid: Callable[[np.ndarray], np.ndarray], low_mm: np.ndarray, high_mm: np.ndarray, spacing_mm: float = _SPACING_MM
) -> trimesh.Trimesh:
    """Triangulate a solid.

    Args:
        solid: Signed distance (...), mm, of points (..., 3), mm.
        low_mm: Lower corner of the box that contains the solid (3,).
        high_mm: Upper corner (3,).
        spacing_mm: Width of the cubes.

    Returns:
        The mesh, mm.
    """
    from skimage.measure import marching_cubes

    axes = [np.arange(a, b + spacing_mm, spacing_mm) for a, b in zip(low_mm, high_mm, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    vertices, triangles, _, _ = marching_cubes(solid(grid), 0, spacing=(spacing_mm,) * 3)
    vertices = vertices + low_mm
    for _ in range(3):  # marching cubes interpolates linearly; Newton steps reach the surface
        slope = np.stack([solid(vertices + h) - solid(vertices - h) for h in 1e-3 * np.eye(3)], -1) / 2e-3
        size = np.maximum((slope**2).sum(-1, keepdims=True), 0.25)
        vertices = vertices - solid(vertices)[:, None] * slope / size
    mesh = trimesh.Trimesh(vertices, triangles, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.fix_normals()
    # Where a wall is thin, flat slivers can remain beside the solid.
    return max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))


def rounded(mesh: trimesh.Trimesh, hollow_mm: float, ridge_mm: float, spacing_mm: float) -> trimesh.Trimesh:
    """Round the hollows and ridges of a mesh, mm, to minimum radii.

    The mesh is grown and shrunk by the hollows' radius, then shrunk and grown by the ridges'.
    """
    for offset in (hollow_mm, -hollow_mm, -ridge_mm, ridge_mm):
        mesh = grown(mesh, offset, spacing_mm)
    return mesh


def grown(mesh: trimesh.Trimesh, offset_mm: float, spacing_mm: float) -> trimesh.Trimesh:
    """Return the surface at a distance from that of a mesh, mm; outward if positive, inward if negative."""
    from skimage.measure import marching_cubes

    vertices, triangles = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64)

    def distance(points: np.ndarray) -> np.ndarray:
        kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        return np.asarray(igl.signed_distance(np.ascontiguousarray(points), vertices, triangles, sign_type=kind)[0])

    low = vertices.min(0) - max(offset_mm, 0) - 2 * spacing_mm
    high = vertices.max(0) + max(offset_mm, 0) + 2 * spacing_mm
    axes = [np.arange(a, b + spacing_mm, spacing_mm) for a, b in zip(low, high, strict=True)]
    # A coarse field first: distances change by no more than the distance between two points.
    coarse = 4
    rough = distance(np.stack(np.meshgrid(*(a[::coarse] for a in axes), indexing="ij"), -1).reshape(-1, 3))
    field = rough.reshape([len(a[::coarse]) for a in axes])
    for k, axis in enumerate(axes):
        field = np.repeat(field, coarse, axis=k).take(range(len(axis)), axis=k)
    near = np.abs(field - offset_mm) < 2 * coarse * spacing_mm
    field[near] = distance(np.stack([a[i] for a, i in zip(axes, np.nonzero(near), strict=True)], -1))
    points, faces, normals, _ = marching_cubes(field - offset_mm, 0, spacing=(spacing_mm,) * 3, allow_degenerate=False)
    points = points + low
    # Marching cubes interpolates linearly, so move the vertices onto the surface.
    off = np.clip(distance(points) - offset_mm, -spacing_mm / 4, spacing_mm / 4)
    points -= normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9) * off[:, None]
    out = trimesh.Trimesh(points, faces, process=False)
    out.fix_normals()
    return max(out.split(only_watertight=False), key=lambda part: len(part.faces))


def write_rim(name: str, rim: Rim, folder: Path = HERE) -> None:
    """Write the mesh of a rim, and its edge."""
    turn = np.linspace(0, 2 * np.pi, _EDGE_POINTS + 1)
    edge = np.column_stack([rim.edge(turn), rim.frames(turn)[1]])
    write(name, trimesh.Trimesh(*rim.mesh(), process=False), edge, folder)


def write(name: str, mesh: trimesh.Trimesh, edge: np.ndarray | None = None, folder: Path = HERE) -> None:
    """Write a mesh, mm, and its edge (n, 6), points in mm and unit normals, if it has one."""
    mesh = mesh.copy()
    mesh.apply_scale(1e-3)
    if not (mesh.is_watertight and mesh.volume > 0):
        raise ValueError(f"{name} is not closed, or inside out")
    mesh.visual = trimesh.visual.ColorVisuals()
    if edge is not None:
        np.savetxt(folder / f"{name}.edge.csv", edge, "%.5f", ",", header="x_mm,y_mm,z_mm,nx,ny,nz", comments="")
    partial = folder / f"{name}.partial.ply"
    mesh.export(partial, file_type="ply", vertex_normal=False)
    partial.replace(folder / f"{name}.ply")
    print(f"{name}: {len(mesh.faces)} faces, {np.round(1e3 * mesh.extents, 1)} mm")


def main() -> None:
    """Make all meshes."""
    s = BUST_SCALE
    head = cut(bust, np.array([-92, -102, -122]) * s, np.array([78, 102, 124]) * s, 1.5 * s)
    write("bust", rounded(head, HOLLOW_MM, RIDGE_MM, 1.5 * s))
    write("saddle", cut(saddle, np.array([-74, -74, -54]), np.array([74, 74, 32])))
    write("sphere", cut(lambda p: ball(p, (0, 0, 0), SPHERE_MM), np.full(3, -SPHERE_MM - 4), np.full(3, SPHERE_MM + 4)))
    write("plate", trimesh.convex.convex_hull(block(80.0, 20.0)))
    y = np.linspace(-80, 80, 161)
    straight = np.column_stack([np.full(len(y), 60.0), y, np.zeros((len(y), 3)), np.ones(len(y))])
    write("edge", trimesh.convex.convex_hull(block(60.0, 30.0) * [1, 80 / 60, 1]), straight)
    for name, rim in RIMS.items():
        write_rim(name, rim)


if __name__ == "__main__":
    main()
