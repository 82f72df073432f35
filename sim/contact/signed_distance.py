"""A closed surface of triangles: where it is nearest to a point, on which side the point is, and how far.

Distances are exact, of the triangles themselves, whatever their number: libigl's tree answers 300 points on 300,000
triangles in half a millisecond. Sides are told by pseudonormals (Baerentzen & Aanaes, "Signed distance computation using the
angle weighted pseudonormal", 2005), which are right at edges and corners too.
"""

from dataclasses import dataclass

import igl
import numpy as np

_ON_M = 1e-9
"""Distance below which a point is on the surface, m: its direction is then the surface's."""

_MET_M = 1e-6
"""Distance at which a ray has met the surface, m; it is the least step along a ray, too."""

_STRAIGHT = 1 - 1e-9
"""Cosine to a triangle's normal from which on a point counts as straight above or below it, -."""

_CREASE_DEG = 25.0
"""Angle between neighbouring triangles from which on there is a crease between them, degrees."""

_CORNER = 1e-7
"""Share of a triangle below which a place on it counts as on its border, -."""


@dataclass(frozen=True)
class Nearest:
    """Where a surface is nearest to points, (n, ...)."""

    distance: np.ndarray
    """(n,) m, negative inside."""
    place: np.ndarray
    """(n, 3) m, on the surface."""
    normal: np.ndarray
    """(n, 3), unit: the direction in which the distance grows."""


class SignedDistanceMesh:
    """A solid by its surface."""

    def __init__(self, vertices, triangles):
        """vertices: (n, 3) m. triangles: (k, 3) int, outward; closed (sim/robot/objects.py sees to both)."""
        self.vertices = np.ascontiguousarray(vertices, float)
        self.triangles = np.ascontiguousarray(triangles, np.int64)
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.triangles)
        self._faces = np.asarray(igl.per_face_normals(self.vertices, self.triangles), float)
        angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
        self._corners = np.asarray(igl.per_vertex_normals(self.vertices, self.triangles, angle), float)
        smooth = np.asarray(igl.per_corner_normals(self.vertices, self.triangles, _CREASE_DEG), float)
        self.corner_normals = smooth.reshape(-1, 3, 3)
        """Normals (k, 3, 3) of each triangle's corners; those of a crease are apart."""
        self._edges = _edge_normals(self.triangles, self._faces)

    def nearest(self, points):
        """Nearest of points (n, 3) m."""
        points = np.ascontiguousarray(points, float)
        squared, which, place = self._tree.squared_distance(self.vertices, self.triangles, points)
        which, place = np.atleast_1d(which), np.asarray(place, float)
        away = points - place
        distance = np.sqrt(squared)
        outward = self._faces[which]
        along = np.einsum("nk,nk->n", away, outward)
        # Straight above or below a triangle, its own normal tells the side; elsewhere a border or corner is nearest.
        beside = np.flatnonzero(np.abs(along) < _STRAIGHT * distance)
        beside = np.union1d(beside, np.flatnonzero(distance < _ON_M)) if (distance < _ON_M).any() else beside
        if len(beside):
            outward = outward.copy()
            outward[beside] = self._pseudonormals(which[beside], place[beside])
            along[beside] = np.einsum("nk,nk->n", away[beside], outward[beside])
        distance = np.where(along < 0, -distance, distance)
        on = np.abs(distance) < _ON_M
        normal = np.where(on[:, None], outward, away / np.where(on, 1.0, distance)[:, None])
        normal /= np.sqrt(np.einsum("nk,nk->n", normal, normal))[:, None]
        return Nearest(distance, place, normal)

    def distance(self, points):
        """Signed distance (...) m of points (..., 3) m; negative inside."""
        points = np.asarray(points, float)
        return self.nearest(points.reshape(-1, 3)).distance.reshape(points.shape[:-1])

    def smooth_normal(self, points):
        """Outward normals (n, 3), unit, at the surface's places nearest to points (n, 3) m, without the triangles' facets.

        Normals of corners, interpolated; triangles that meet at more than a crease's angle keep theirs apart.
        """
        points = np.ascontiguousarray(points, float)
        _, which, place = self._tree.squared_distance(self.vertices, self.triangles, points)
        which = np.atleast_1d(which)
        share = self._shares(which, place)
        normal = np.einsum("nc,nck->nk", share, self.corner_normals[which])
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def first_hit(self, origin, direction):
        """Distance (m) along a ray from `origin` (3,) m in `direction` (3,), unit, to the surface; infinite without a
        hit."""
        origin, direction = np.asarray(origin, float), np.asarray(direction, float)
        # By steps that are as long as there is room: libigl's own rays pass through three triangles in a hundred.
        gone, farthest = 0.0, float(np.linalg.norm(self.vertices - origin, axis=1).max())
        while gone <= farthest:
            room = float(self.distance(origin + gone * direction))
            if room < _MET_M:
                return gone + room
            gone += room
        return np.inf

    def _shares(self, which, place):
        """Barycentric coordinates (n, 3) of places (n, 3) on triangles `which` (n,)."""
        a, b, c = self.vertices[self.triangles[which]].transpose(1, 0, 2)
        across, along, own = b - a, c - a, place - a
        aa, ab, bb = (across**2).sum(1), (across * along).sum(1), (along**2).sum(1)
        pa, pb = (own * across).sum(1), (own * along).sum(1)
        size = np.maximum(aa * bb - ab**2, 1e-300)
        v, w = (bb * pa - ab * pb) / size, (aa * pb - ab * pa) / size
        return np.stack([1 - v - w, v, w], 1)

    def _pseudonormals(self, which, place):
        """(n, 3) of the corner, border or triangle on which a place lies; not unit."""
        share = self._shares(which, place)
        out = self._faces[which].copy()
        gone = share < _CORNER
        for k in range(3):
            border = gone[:, k]
            out[border] = self._edges[which[border], k]
        corner = gone.sum(1) >= 2
        out[corner] = self._corners[self.triangles[which[corner], share[corner].argmax(1)]]
        return out


def _edge_normals(triangles, normals):
    """(k, 3, 3): for each triangle and each of its corners, the sum of normals of the two triangles at the opposite side."""
    sides = np.sort(np.stack([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]], 1).reshape(-1, 2), axis=1)
    _, edge = np.unique(sides, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    sums = np.zeros((edge.max() + 1, 3))
    np.add.at(sums, edge, np.repeat(normals, 3, axis=0))
    return sums[edge].reshape(-1, 3, 3)
