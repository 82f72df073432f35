"""The deepest point of a triangle mesh in a solid, found by halving the triangles that may have it."""

from collections.abc import Callable

import numpy as np


def deepest_m(
    depth: Callable[[np.ndarray], np.ndarray], vertices: np.ndarray, triangles: np.ndarray, spacing_m: float, error_m: float
) -> float:
    """Return the maximum depth of a mesh's surface, m; at least 0.

    The depths of two points differ by no more than the distance between them, and no point of a triangle is farther from its
    nearest corner than its longest side over √3. So triangles whose corners are less deep than the deepest point so far, by
    that much, are left out. The others are divided into four until their sides are shorter than `spacing_m`.

    Args:
        depth: Depths (n,), m, of points (n, 3), m; negative outside of the solid.
        vertices: (n, 3) m.
        triangles: (k, 3) int.
        spacing_m: Distance at which the depth between samples no longer matters, m.
        error_m: Depth by which a point that is left out may be deeper, m.
    """
    depths = depth(vertices)
    deepest = max(0.0, float(depths.max()))
    while True:
        corners = vertices[triangles]
        side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        near = (side > spacing_m) & (depths[triangles].max(1) + side / np.sqrt(3) > deepest + error_m)
        if not near.any():
            return deepest
        a, b, c = triangles[near].T
        # Middles of the sides ab, bc and ca. Neighbours share them; a number per side sorts faster than a row.
        sides = np.sort(np.stack([[a, b], [b, c], [c, a]]), axis=1)
        number, middle = np.unique(sides[:, 0].astype(np.int64) * len(vertices) + sides[:, 1], return_inverse=True)
        middles = (vertices[number // len(vertices)] + vertices[number % len(vertices)]) / 2
        ab, bc, ca = middle.reshape(3, -1) + len(vertices)
        triangles = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices, depths = np.concatenate([vertices, middles]), np.concatenate([depths, depth(middles)])
        deepest = max(deepest, float(depths.max()))
