"""Containers whose outer top edge is to be followed, and a straight one: a profile swept along a curve."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

_EDGE_FACETS = 12
"""Facets of the rounding of the outer edge: it is 1 µm off a true one."""

_INNER_FACETS = 4

_LONGEST_MM = 3.0
"""Longest side of a triangle along the profile, mm."""


@dataclass(frozen=True)
class Rim:
    """A container: a thick wall along a closed curve, and a floor.

    The curve is the outer edge before it is rounded. Locally it is the edge of a block: the top is square to the wall. x, y
    right and up as seen from above, z out of the opening, mm.
    """

    radius_mm: float
    """Mean radius of the edge; of the sides, where it is square."""
    power: float = 2.0
    """2 is round; 4 a rounded square (a superellipse)."""
    waves: tuple[tuple[int, float, float], ...] = ()
    """Waves of the radius: how many around, share of the radius, phase in rad."""
    heave_mm: tuple[tuple[int, float, float], ...] = ()
    """Waves of the edge's height: how many around, mm, phase in rad."""
    wall_mm: float = 16.0
    """Thickness of the wall: more than the tip feels of it."""
    height_mm: float = 50.0
    """Height of the wall."""
    floor_mm: float = 8.0
    """Thickness of the floor."""
    edge_mm: float = 0.5
    """Rounding of the outer edge: that of the straight edge in training."""
    inner_mm: float = 3.0
    """Rounding of the inner edge."""

    def edge(self, turn):
        """The edge (n, 3), mm, at angles `turn` (n,), rad."""
        c, s = np.cos(turn), np.sin(turn)
        radius = self.radius_mm * (np.abs(c) ** self.power + np.abs(s) ** self.power) ** (-1 / self.power)
        radius = radius * (1 + sum(a * np.cos(k * turn - p) for k, a, p in self.waves))
        height = sum((a * np.cos(k * turn - p) for k, a, p in self.heave_mm), np.zeros_like(turn))
        return np.stack([radius * c, radius * s, height], -1)

    def frames(self, turn):
        """Tangents, outward normals of the top, and directions off the wall, each (n, 3), at angles `turn` (n,), rad."""
        h = 1e-4
        tangent = self.edge(turn + h) - self.edge(turn - h)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        off = np.stack([tangent[:, 1], -tangent[:, 0], np.zeros(len(turn))], -1)
        off /= np.linalg.norm(off, axis=1, keepdims=True)
        return tangent, np.cross(off, tangent), off

    def mesh(self, sectors=480):
        """Vertices (n, 3), mm, and triangles (k, 3) of the container. sectors: int, around."""
        turn = np.arange(sectors) * 2 * np.pi / sectors
        edge, (_, _, off) = self.edge(turn), self.frames(turn)
        low = -self.height_mm
        rings = []
        # From the middle of the floor's underside, outside up, over the top, inside down, to the middle of the floor.
        rings.append(_flat(edge, low))
        for angle in np.linspace(0, np.pi / 2, _EDGE_FACETS + 1):
            inward, down = self.edge_mm * (1 - np.cos(angle)), self.edge_mm * (1 - np.sin(angle))
            rings.append(edge - inward * off - [0, 0, down])
        for angle in np.linspace(0, np.pi / 2, _INNER_FACETS + 1):
            inward, down = self.wall_mm - self.inner_mm * (1 - np.sin(angle)), self.inner_mm * (1 - np.cos(angle))
            rings.append(edge - inward * off - [0, 0, down])
        rings.append(_flat(edge - self.wall_mm * off, low + self.floor_mm))
        rings = _filled(np.array(rings))
        return _closed(rings, np.array([0, 0, low]), np.array([0, 0, low + self.floor_mm]))


RIMS = {
    "rim-round": Rim(60.0),
    "rim-square": Rim(55.0, power=4.0),
    "rim-uneven": Rim(62.0, waves=((2, 0.08, 0.0), (3, 0.05, 1.0)), heave_mm=((2, 4.0, 0.5), (3, 2.0, 0.0))),
}
"""By name: a round one, a rounded square, and one that rises and falls while its curvature changes."""


def block(half_mm, height_mm, edge_mm=0.5):
    """Vertices (n, 3), mm, of a block whose two edges along y are rounded; its top is at z = 0. Convex."""
    angle = np.linspace(0, np.pi / 2, _EDGE_FACETS + 1)
    x, z = half_mm - edge_mm * (1 - np.cos(angle)), -edge_mm * (1 - np.sin(angle))
    profile = np.concatenate([np.stack([x, z], -1), np.stack([-x, z], -1), [[half_mm, -height_mm], [-half_mm, -height_mm]]])
    return np.concatenate([np.insert(profile, 1, y, axis=1) for y in (-half_mm, half_mm)])


def _filled(rings):
    """Rings (r, n, 3), with as many more between them as keep triangles from being long: a search for the nearest one goes
    by their boxes."""
    out = [rings[:1]]
    for one, other in pairwise(rings):
        count = int(np.ceil(np.linalg.norm(other - one, axis=1).max() / _LONGEST_MM))
        share = (np.arange(count) + 1)[:, None, None] / count
        out.append(one + share * (other - one))
    return np.concatenate(out)


def _flat(ring, height):
    return np.column_stack([ring[:, :2], np.full(len(ring), height)])


def _closed(rings, first, last):
    """Vertices and triangles of a grid of rings (r, n, 3), closed at both ends by fans about `first` and `last` (3,)."""
    count, around = rings.shape[:2]
    vertices = np.concatenate([rings.reshape(-1, 3), first[None], last[None]])
    k, j = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = k * around + j, k * around + (j + 1) % around
    c, d = a + around, b + around
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    j = np.arange(around)
    low = np.stack([np.full(around, count * around), (j + 1) % around, j], -1)
    high = np.stack(
        [np.full(around, count * around + 1), j + (count - 1) * around, (j + 1) % around + (count - 1) * around], -1
    )
    return vertices, np.concatenate([sides, low, high])
