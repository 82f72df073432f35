"""Solids with features that are smaller, deeper or steeper than the fingertip, to test how a servo gets over them.

Conventions are those of solids.py.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.assets.meshes.solids import BUST_SCALE, ball, bust, ellipsoid, joined, limb, without


def head(points_mm: np.ndarray) -> np.ndarray:
    """Return the distance to a head, 270 mm tall, with deep eye sockets, a narrow nose and an undercut chin.

    x points out of the face, y to its left, z up; the origin is between the jaws.
    """
    p = points_mm
    m = np.concatenate([p[..., :1], np.abs(p[..., 1:2]), p[..., 2:]], -1)  # both sides alike
    d = joined(ellipsoid(p, [-15, 0, 60], [88, 70, 85]), ellipsoid(p, [18, 0, 8], [62, 56, 74]), 25)  # skull, face
    d = joined(d, ellipsoid(p, [62, 0, -54], [21, 25, 16]), 14)  # chin
    d = joined(d, ellipsoid(m, [52, 38, 6], [20, 18, 18]), 16)  # cheeks
    d = joined(d, limb(m, [72, 6, 48], [62, 44, 44], 8, 6), 10)  # brows
    d = without(d, ellipsoid(m, [80, 27, 30], [26, 17, 13]), 6)  # eye sockets
    d = joined(d, ball(m, [54, 26, 30], 11), 3)  # eyes
    d = joined(d, limb(p, [74, 0, 44], [97, 0, 4], 6, 10), 8)  # nose
    d = joined(d, ellipsoid(m, [87, 11, 1], [10, 7, 7]), 5)  # its wings
    d = joined(d, limb(m, [80, 0, -20], [70, 23, -23], 5, 3), 5)  # upper lip
    d = joined(d, limb(m, [79, 0, -31], [70, 20, -29], 5.5, 3), 5)  # lower lip
    d = without(d, limb(m, [86, 0, -25.5], [70, 24, -26], 1.2, 1.2), 2)  # mouth
    d = joined(d, ellipsoid(m, [-18, 72, 40], [15, 8, 27]), 7)  # ears
    d = without(d, ellipsoid(m, [-10, 80, 42], [8, 6, 15]), 4)
    d = joined(d, limb(p, [-18, 0, -30], [-24, 0, -130], 44, 50), 10)  # neck
    return np.maximum(d, -p[..., 2] - 125)


RELIEF_RIDGES_MM = ((-23.0, 3.0), (0.0, 6.0), (25.0, 10.0))
"""Position y and radius of the relief's ridges, mm."""


def relief(points_mm: np.ndarray) -> np.ndarray:
    """Return the distance to a plate, 120 × 120 × 16 mm with its top at z = 0, with three half-round ridges along x."""
    p = points_mm
    outside = np.abs(p - [0, 0, -8]) - [60, 60, 8]
    d = np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(-1), 0)
    for y, radius in RELIEF_RIDGES_MM:
        d = joined(d, limb(p, [-45, y, 0], [45, y, 0], radius, radius), 1.0)
    return d


def vase(points_mm: np.ndarray) -> np.ndarray:
    """Return the distance to a vase 170 mm tall around z, with a lip 4 mm thick and a handle at x > 0.

    The origin is on its axis, in the middle of its height.
    """
    p = points_mm
    r, z = np.linalg.norm(p[..., :2], axis=-1), p[..., 2]
    belly = 34 + 11 * np.cos(np.clip((z + 25) / 62, -1.4, 1.4) * np.pi / 1.4)
    outer = belly + 10 * np.clip((z - 55) / 30, 0, 1) ** 2
    wall = np.maximum(r - outer, np.abs(z) - 85)
    hollow = np.maximum(r - outer + 4, -z - 75)
    d = without(wall, hollow, 1.5)
    arc = [[36, 0, 42], [60, 0, 40], [68, 0, 10], [58, 0, -22], [40, 0, -30]]
    for start, end in pairwise(arc):
        handle = limb(p, start, end, 6, 6)
        d = joined(d, np.maximum(handle, outer - 3 - r), 3.0)
    return d


HARD_SOLIDS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], ArrayLike, ArrayLike, float]] = {
    "bust-sharp": (bust, BUST_SCALE * np.array([-92, -102, -122]), BUST_SCALE * np.array([78, 102, 124]), 2.0),
    "head": (head, [-112, -90, -134], [118, 90, 152], 2.0),
    "relief": (relief, [-68, -68, -20], [68, 68, 14], 1.2),
    "vase": (vase, [-66, -66, -92], [84, 66, 92], 1.2),
}
"""Signed distance, lower and upper corner of the box around it, mm, and width of the cubes of marching cubes, mm.
`bust-sharp` is the bust before its hollows and ridges are rounded for the fingertip."""
