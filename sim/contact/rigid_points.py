"""Signed distances of a rigid set of points to an object, computed only where they can matter.

A distance changes by no more than the way between two places. So what a point had at the last pose bounds what it has now,
and a point bounds those around it.
"""

from collections.abc import Callable

import numpy as np

_MANY = 2
"""Number of points that may matter, over that of the groups, from which the groups' centers are measured first [?]."""


class RigidPoints:
    """Points that move together, in groups. It remembers the last distance of each."""

    def __init__(self, points: np.ndarray, groups: int) -> None:
        """Group points (k, 3), m, about `groups` of them that lie far from each other."""
        self._points = points
        chosen = [0]
        nearest = np.linalg.norm(points - points[0], axis=1)
        for _ in range(min(groups, len(points)) - 1):
            chosen.append(int(nearest.argmax()))
            nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
        self._centers = np.array(chosen)
        to_centers = np.linalg.norm(points[:, None] - points[chosen], axis=2)
        self._group = to_centers.argmin(1)
        self._to_center = to_centers[np.arange(len(points)), self._group]
        self._of: Callable[[np.ndarray], np.ndarray] | None = None
        self._reach = float(np.linalg.norm(points, axis=1).max())
        self._nearest: tuple[Callable[[np.ndarray], np.ndarray], np.ndarray, float] | None = None

    def nearest(self, distance: Callable[[np.ndarray], np.ndarray], T: np.ndarray, far_m: float) -> float:
        """Return the distance of the nearest point, m: exact, or a lower bound above `far_m`.

        Args:
            distance: As of `distances`.
            T: As of `distances`.
            far_m: Distance above which a bound is enough, m.
        """
        if self._nearest is not None and self._nearest[0] == distance:
            _, before, nearest = self._nearest
            change = T - before
            bound = nearest - np.linalg.norm(change[:3, 3]) - self._reach * np.linalg.norm(change[:3, :3])
            if bound > far_m:
                return float(bound)
        self._nearest = distance, T, float(self.distances(distance, T, -np.inf).min())
        return self._nearest[2]

    def distances(self, distance: Callable[[np.ndarray], np.ndarray], T: np.ndarray, near_m: float) -> np.ndarray:
        """Return distances (k,), m: exact up to `near_m` and for the nearest point, otherwise a lower bound above `near_m`.

        Args:
            distance: Signed distance (n,), m, to the object at points (n, 3), m, in its frame. The object is rigid.
            T: (4, 4), pose of the points in that frame.
            near_m: Distance up to which distances are exact, m.
        """
        if distance != self._of:
            self._of, self._known = distance, np.zeros(len(self._points))
            self._places = np.full_like(self._points, np.inf)
        places = self._points @ T[:3, :3].T + T[:3, 3]
        way = np.linalg.norm(places - self._places, axis=1)
        least, most = self._known - way, float((self._known + way).min())
        exact = np.zeros(len(places), bool)

        def measure(chosen: np.ndarray) -> None:
            """Measure the distances of points by index."""
            nonlocal most
            self._known[chosen], self._places[chosen] = distance(places[chosen]), places[chosen]
            least[chosen], exact[chosen] = self._known[chosen], True
            most = min(most, float(least[chosen].min(initial=np.inf)))

        if np.count_nonzero(least <= max(near_m, most)) > _MANY * len(self._centers):
            measure(self._centers[least[self._centers] <= max(near_m, most)])
            at_centers = np.where(exact[self._centers], least[self._centers], -np.inf)
            np.maximum(least, at_centers[self._group] - self._to_center, out=least, where=~exact)
        measure(np.flatnonzero((least <= max(near_m, most)) & ~exact))
        return least
