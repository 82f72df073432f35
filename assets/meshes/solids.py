"""Signed distances of the solids from which the meshes in this folder are made.

A solid is a function of points (..., 3), mm, to distances (...), mm, negative inside. Distances are correct to first order
near the surface.
"""

import numpy as np
from numpy.typing import ArrayLike


def ball(points: np.ndarray, centre: ArrayLike, radius: float) -> np.ndarray:
    """Return the distance to a sphere."""
    return np.linalg.norm(points - np.asarray(centre, float), axis=-1) - radius


def ellipsoid(points: np.ndarray, centre: ArrayLike, radii: ArrayLike) -> np.ndarray:
    """Return the distance to an ellipsoid, to first order."""
    own, radii = points - np.asarray(centre, float), np.asarray(radii, float)
    size = np.linalg.norm(own / radii, axis=-1)
    return size * (size - 1) / np.maximum(np.linalg.norm(own / radii**2, axis=-1), 1e-9)


def limb(points: np.ndarray, start: ArrayLike, end: ArrayLike, radius: float, end_radius: float) -> np.ndarray:
    """Return the distance to a rod with round ends whose radius changes along it."""
    start = np.asarray(start, float)
    along = np.asarray(end, float) - start
    fraction = np.clip(((points - start) @ along) / (along @ along), 0, 1)
    return np.linalg.norm(points - start - fraction[..., None] * along, axis=-1) - (
        radius + (end_radius - radius) * fraction
    )


def joined(one: np.ndarray, other: np.ndarray, blend: float) -> np.ndarray:
    """Return the distance to the union of two solids, blended over `blend` mm."""
    fraction = np.clip(0.5 + 0.5 * (other - one) / blend, 0, 1)
    return other + (one - other) * fraction - blend * fraction * (1 - fraction)


def without(one: np.ndarray, other: np.ndarray, blend: float) -> np.ndarray:
    """Return the distance to one solid minus another, blended over `blend` mm."""
    return -joined(-one, other, blend)


BUST_SCALE = 1.5
"""Scale of the bust relative to the numbers in `bust`, which describe a head 130 mm tall."""


def bust(points_mm: np.ndarray) -> np.ndarray:
    """Return the distance to a bust with a face: nose, eye sockets, lips, cheeks, neck, shoulders.

    x points out of the face, y to its left, z up; the origin is between the jaws.
    """
    p = points_mm / BUST_SCALE
    m = np.concatenate([p[..., :1], np.abs(p[..., 1:2]), p[..., 2:]], -1)  # both sides alike
    d = joined(ellipsoid(p, [-12, 0, 62], [62, 50, 56]), ellipsoid(p, [8, 0, 35], [42, 40, 52]), 18)  # skull, face
    d = joined(d, ellipsoid(p, [30, 0, 2], [17, 19, 14]), 14)  # chin
    d = joined(d, ellipsoid(m, [26, 26, 28], [17, 14, 15]), 14)  # cheeks
    d = joined(d, limb(m, [40, 4, 66], [35, 30, 64], 6, 5), 9)  # brows
    d = without(d, ellipsoid(m, [52, 19, 53], [13, 12, 8]), 8)  # eye sockets
    d = joined(d, ball(m, [35, 18, 53], 9.5), 2.5)  # eyes
    d = joined(d, limb(p, [45, 0, 60], [60, 0, 35], 4.5, 7), 7)  # nose
    d = joined(d, ellipsoid(m, [53, 7, 33], [7, 5, 5]), 5)  # its wings
    d = joined(d, limb(m, [49, 0, 19], [42, 15, 17], 3.6, 2.4), 4)  # upper lip
    d = joined(d, limb(m, [48, 0, 12], [42, 13, 13.5], 3.8, 2.4), 4)  # lower lip
    d = without(d, limb(m, [53, 0, 15.6], [44, 16, 15.6], 1, 1), 2)  # mouth
    d = joined(d, ellipsoid(m, [-8, 50, 45], [9, 5, 16]), 6)  # ears
    d = without(d, ellipsoid(m, [-4, 56, 46], [5, 4, 9]), 4)
    d = joined(d, limb(p, [-16, 0, 10], [-22, 0, -50], 32, 33), 14)  # neck
    d = joined(d, ellipsoid(p, [-20, 0, -72], [44, 88, 32]), 22)  # shoulders
    foot = np.maximum(np.linalg.norm(p[..., :2] - [-20, 0], axis=-1) - 44, np.abs(p[..., 2] + 105) - 14)
    return BUST_SCALE * joined(d, foot, 10)


SADDLE_RADII_MM = (120.0, 150.0)
"""Radii of curvature of the saddle at its middle, mm: of the ridge along x and of the valley along y."""


def saddle(points_mm: np.ndarray) -> np.ndarray:
    """Return the distance to a block 140 mm wide whose top is a saddle with its middle at the origin."""
    x, y, z = np.moveaxis(points_mm, -1, 0)
    ridge, valley = SADDLE_RADII_MM
    top = -(x**2) / (2 * ridge) + y**2 / (2 * valley)
    slope = np.sqrt(1 + (x / ridge) ** 2 + (y / valley) ** 2)
    block = np.stack([np.abs(x) - 66, np.abs(y) - 66, -z - 46], -1)
    rounded = np.linalg.norm(np.maximum(block, 0), axis=-1) + np.minimum(block.max(-1), 0) - 4
    return -joined((top - z) / slope, -rounded, 3.0)
