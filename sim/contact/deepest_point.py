"""The deepest point of a triangle mesh in a solid, found by halving the triangles that may have it."""

from collections.abc import Callable

import numpy as np

_STEP_M = 1e-7
"""Distance between the points from which the gradient of a depth is computed, m."""


def deepest_m(
    depth: Callable[[np.ndarray], np.ndarray],
    vertices: np.ndarray,
    triangles: np.ndarray,
    spacing_m: float,
    error_m: float,
    convex: bool = False,
) -> float:
    """Return the maximum depth of a mesh's surface, m; at least 0.

    The depths of two points differ by no more than the distance between them, and no point of a triangle is farther from its
    nearest corner than its longest side over √3. So triangles whose corners are less deep than the deepest point so far, by
    that much, are left out. In a convex solid, no point is deeper than a tangent of the depth says, so triangles on a flat
    side are left out, too. The others are divided into four until their sides are shorter than `spacing_m`.

    Args:
        depth: Depths (n,), m, of points (n, 3), m; negative outside of the solid.
        vertices: (n, 3) m.
        triangles: (k, 3) int.
        spacing_m: Distance at which the depth between samples no longer matters, m.
        error_m: Depth by which a point that is left out may be deeper, m.
        convex: Whether the solid is convex.
    """
    depths = depth(vertices)
    deepest = max(0.0, float(depths.max()))
    corners = vertices[triangles]
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    while True:
        # Corner by corner, because numpy is slow along short axes.
        highest = np.maximum.reduce([depths[corner] for corner in triangles.T])
        near = (side > spacing_m) & (highest + side / np.sqrt(3) > deepest + error_m)
        if convex and near.any():
            near[near] = _highest_tangent(depth, [vertices[corner] for corner in triangles[near].T]) > deepest + error_m
        if not near.any():
            return deepest
        a, b, c = triangles[near].T
        # Middles of the sides ab, bc and ca. Neighbours share them; a number per side sorts faster than a row.
        ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
        number = np.minimum(*ends).astype(np.int64) * len(vertices) + np.maximum(*ends)
        number, middle = np.unique(number, return_inverse=True)
        middles = (vertices[number // len(vertices)] + vertices[number % len(vertices)]) / 2
        ab, bc, ca = middle.reshape(3, -1) + len(vertices)
        triangles = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        side = np.tile(side[near] / 2, 4)
        vertices, depths = np.concatenate([vertices, middles]), np.concatenate([depths, depth(middles)])
        deepest = max(deepest, float(depths.max()))


def _highest_tangent(depth: Callable[[np.ndarray], np.ndarray], corners: list[np.ndarray]) -> np.ndarray:
    """Return the maximum depths (k,), m, in triangles with three corners (k, 3) m each, by the tangents at their middles."""
    middle = sum(corners) / 3
    steps = np.concatenate([np.zeros((1, 3)), _STEP_M * np.eye(3), -_STEP_M * np.eye(3)])
    there = depth((middle + steps[:, None]).reshape(-1, 3)).reshape(7, -1)
    gradient = (there[1:4] - there[4:]) / (2 * _STEP_M)
    return there[0] + np.maximum.reduce([np.einsum("jk,kj->k", gradient, corner - middle) for corner in corners])
