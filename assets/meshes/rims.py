"""Containers whose outer top edge can be followed, and a block with straight edges: profiles swept along a curve."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

_EDGE_FACETS = 12
"""Facets of the outer edge's rounding, which deviate from an arc by 1 µm."""

_INNER_FACETS = 4
"""Facets of the inner edge's rounding."""

_MAX_SIDE_MM = 3.0
"""Longest side of a triangle along the profile, mm."""


@dataclass(frozen=True)
class Rim:
    """A container: a thick wall along a closed curve, and a floor.

    The curve is the outer edge before rounding. Locally it is the edge of a block, because the top is perpendicular to the
    wall. Seen from above, x points right, y up and z out of the opening.
    """

    radius_mm: float
    """Mean radius of the edge, mm; for a rounded square, half its width."""
    power: float = 2.0
    """Exponent of the superellipse: 2 is round, 4 a rounded square."""
    waves: tuple[tuple[int, float, float], ...] = ()
    """Waves of the radius: number around the edge, amplitude as a fraction of the radius, phase in rad."""
    heave_mm: tuple[tuple[int, float, float], ...] = ()
    """Waves of the edge's height: number around the edge, amplitude in mm, phase in rad."""
    wall_mm: float = 16.0
    """Thickness of the wall, mm; more than the tip touches."""
    height_mm: float = 50.0
    """Height of the wall, mm."""
    floor_mm: float = 8.0
    """Thickness of the floor, mm."""
    edge_mm: float = 0.5
    """Radius of the outer edge's rounding, mm; that of the straight edge in training."""
    inner_mm: float = 3.0
    """Radius of the inner edge's rounding, mm."""

    def edge(self, turn: np.ndarray) -> np.ndarray:
        """Return points of the edge (n, 3), mm, at angles around it (n,), rad."""
        c, s = np.cos(turn), np.sin(turn)
        radius = self.radius_mm * (np.abs(c) ** self.power + np.abs(s) ** self.power) ** (-1 / self.power)
        radius = radius * (1 + sum(a * np.cos(k * turn - p) for k, a, p in self.waves))
        height = sum((a * np.cos(k * turn - p) for k, a, p in self.heave_mm), np.zeros_like(turn))
        return np.stack([radius * c, radius * s, height], -1)

    def frames(self, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tangents, outward normals of the top, and outward normals of the wall, each (n, 3), at angles (n,), rad."""
        h = 1e-4
        tangent = self.edge(turn + h) - self.edge(turn - h)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        off = np.stack([tangent[:, 1], -tangent[:, 0], np.zeros(len(turn))], -1)
        off /= np.linalg.norm(off, axis=1, keepdims=True)
        return tangent, np.cross(off, tangent), off

    def mesh(self, sectors: int = 480) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (n, 3), mm, and triangles (k, 3) of the container, divided into sectors."""
        turn = np.arange(sectors) * 2 * np.pi / sectors
        edge, (_, _, off) = self.top(turn), self.frames(turn)
        low = -self.height_mm
        # From the middle of the floor's underside, outside up, over the top, inside down, to the middle of the floor.
        rings = self._outside(turn)
        for angle in np.linspace(0, np.pi / 2, _INNER_FACETS + 1):
            inward, down = self.wall_mm - self.inner_mm * (1 - np.sin(angle)), self.inner_mm * (1 - np.cos(angle))
            rings.append(edge - inward * off - [0, 0, down])
        rings.append(_flat(edge - self.wall_mm * off, low + self.floor_mm))
        return closed(filled(np.array(rings)), np.array([0, 0, low]), np.array([0, 0, low + self.floor_mm]))

    def top(self, turn: np.ndarray) -> np.ndarray:
        """Return points of the top's outer edge (n, 3), mm, at angles (n,), rad: those of the edge."""
        return self.edge(turn)

    def _outside(self, turn: np.ndarray) -> list[np.ndarray]:
        """Return rings (n, 3), mm, at angles (n,), rad, from the underside over the rounded outer edge."""
        edge, (_, _, off) = self.top(turn), self.frames(turn)
        rings = [np.column_stack([edge[:, :2], np.full(len(edge), -self.height_mm)])]
        for angle in np.linspace(0, np.pi / 2, _EDGE_FACETS + 1):
            inward, down = self.edge_mm * (1 - np.cos(angle)), self.edge_mm * (1 - np.sin(angle))
            rings.append(edge - inward * off - [0, 0, down])
        return rings


RIMS = {
    "rim-round": Rim(60.0),
    "rim-square": Rim(55.0, power=4.0),
    "rim-uneven": Rim(62.0, waves=((2, 0.08, 0.0), (3, 0.05, 1.0)), heave_mm=((2, 4.0, 0.5), (3, 2.0, 0.0))),
}
"""Rims by name: a round one, a rounded square, and one that rises and falls while its curvature changes."""


def block(half_mm: float, height_mm: float, edge_mm: float = 0.5) -> np.ndarray:
    """Return the vertices (n, 3), mm, of a convex block with two rounded edges along y and its top at z = 0.

    Args:
        half_mm: Half of the block's width along x and y.
        height_mm: Height of the block.
        edge_mm: Radius of the rounding.
    """
    angle = np.linspace(0, np.pi / 2, _EDGE_FACETS + 1)
    x, z = half_mm - edge_mm * (1 - np.cos(angle)), -edge_mm * (1 - np.sin(angle))
    profile = np.concatenate([np.stack([x, z], -1), np.stack([-x, z], -1), [[half_mm, -height_mm], [-half_mm, -height_mm]]])
    return np.concatenate([np.insert(profile, 1, y, axis=1) for y in (-half_mm, half_mm)])


def filled(rings: np.ndarray) -> np.ndarray:
    """Insert rings between rings (r, n, 3) until no triangle is long, because nearest-triangle search uses boxes."""
    out = [rings[:1]]
    for one, other in pairwise(rings):
        count = int(np.ceil(np.linalg.norm(other - one, axis=1).max() / _MAX_SIDE_MM))
        fraction = (np.arange(count) + 1)[:, None, None] / count
        out.append(one + fraction * (other - one))
    return np.concatenate(out)


def _flat(ring: np.ndarray, height: float) -> np.ndarray:
    """Return a ring (n, 3) flattened to a height."""
    return np.column_stack([ring[:, :2], np.full(len(ring), height)])


def closed(rings: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a grid of rings (r, n, 3), closed by fans around `first` and `last` (3,)."""
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
