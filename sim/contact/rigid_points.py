"""Signed distances of a rigid set of points to an object, computed only where they can matter."""

from collections.abc import Callable

import numpy as np


class RigidPoints:
    """Points that move together, in groups: the distance of a group's centre bounds those of its points."""

    def __init__(self, points: np.ndarray, groups: int) -> None:
        """Group points (k, 3), m, about `groups` of them that lie far from each other."""
        self._points = points
        chosen = [0]
        nearest = np.linalg.norm(points - points[0], axis=1)
        for _ in range(min(groups, len(points)) - 1):
            chosen.append(int(nearest.argmax()))
            nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
        self._centers = points[chosen]
        self._group = np.linalg.norm(points[:, None] - self._centers, axis=2).argmin(1)
        reach = np.linalg.norm(points - self._centers[self._group], axis=1)
        self._radii = np.array([reach[self._group == g].max() for g in range(len(chosen))])

    def distances(self, distance: Callable[[np.ndarray], np.ndarray], T: np.ndarray, near_m: float) -> np.ndarray:
        """Return distances (k,), m: exact up to `near_m` and for the nearest point, otherwise a lower bound above `near_m`.

        Args:
            distance: Signed distance (n,), m, to the object at points (n, 3), m, in its frame.
            T: (4, 4), pose of the points in that frame.
            near_m: Distance up to which distances are exact, m.
        """
        at_centers = distance(self._centers @ T[:3, :3].T + T[:3, 3])
        # A distance changes by no more than the way between two points.
        least = at_centers - self._radii
        wanted = (least <= max(near_m, at_centers.min()))[self._group]
        out = least[self._group]
        out[wanted] = distance(self._points[wanted] @ T[:3, :3].T + T[:3, 3])
        return out
