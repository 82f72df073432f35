"""Curved surfaces as formulas, for drawn training contacts: the mesh of each would take longer than its slide."""

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.curved_surface import Curvatures, Profile
from tactip_twin.sim.contact.signed_distance import Nearest

_ROUNDS = 8
"""Maximum number of Newton steps to the nearest point; two or three suffice but where the curvature jumps [M]."""

_CONVERGED_M = 1e-8
"""Largest last Newton step, m."""

_MIN_HESSIAN = 0.2
"""Lower limit of the second derivatives of half the squared distance, -, which fall to 0 at the centre of curvature [?]."""


class SmoothSurface:
    """A solid whose top is z = -(k1 u^2 + k2 v^2) / 2, or that of two profiles, without end: a DistanceField."""

    def __init__(self, curvatures: Curvatures) -> None:
        """Take the curvatures of the top."""
        cos, sin = np.cos(curvatures.turn_rad), np.sin(curvatures.turn_rad)
        self._axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        constant = (Profile((), (k,)) for k in (curvatures.first_per_m, curvatures.second_per_m))
        self._tops = [_Top(curvatures.profiles[k] if curvatures.profiles else flat) for k, flat in enumerate(constant)]

    def nearest(self, points: np.ndarray, /) -> Nearest:
        """Return the nearest surface points of points (n, 3) m that are less deep than the radius of curvature."""
        local = points @ self._axes.T
        place, slopes = self._foot(local)
        normal = np.column_stack([-slopes, np.ones(len(place))])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        distance = ((local - place) * normal).sum(1)
        return Nearest(distance, place @ self._axes, normal @ self._axes)

    def distance(self, points: ArrayLike, /) -> np.ndarray:
        """Return the signed distance (...) m of points (..., 3) m; negative inside."""
        points = np.asarray(points, float)
        return self.nearest(points.reshape(-1, 3)).distance.reshape(points.shape[:-1])

    def smooth_normal(self, points: np.ndarray, /) -> np.ndarray:
        """Return outward unit normals (n, 3) at the surface points nearest to points (n, 3) m."""
        return self.nearest(points).normal

    def _foot(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (n, 3) nearest to points (n, 3), in the axes u, v and z, and their slopes (n, 2)."""
        at = points[:, :2].copy()
        for _ in range(_ROUNDS):
            heights, slopes, bends = self._derivatives(at)
            above = heights - points[:, 2]
            gradient = at - points[:, :2] + above[:, None] * slopes
            a, b = np.maximum(1 + slopes**2 + above[:, None] * bends, _MIN_HESSIAN).T
            cross = slopes[:, 0] * slopes[:, 1]
            determinant = np.maximum(a * b - cross**2, _MIN_HESSIAN**2)
            along_u = (b * gradient[:, 0] - cross * gradient[:, 1]) / determinant
            along_v = (a * gradient[:, 1] - cross * gradient[:, 0]) / determinant
            move = np.column_stack([along_u, along_v])
            at -= move
            if np.abs(move).max(initial=0.0) < _CONVERGED_M:
                break
        heights, slopes, _ = self._derivatives(at)
        return np.column_stack([at, heights]), slopes

    def _derivatives(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights (n,) m, slopes (n, 2) and second derivatives (n, 2) 1/m at places (n, 2) m along u and v."""
        first, second = (top.derivatives(at[:, k]) for k, top in enumerate(self._tops))
        return first[0] + second[0], np.column_stack([first[1], second[1]]), np.column_stack([first[2], second[2]])


class _Top:
    """Heights along one direction, as parabolas between the changes of a profile."""

    def __init__(self, profile: Profile) -> None:
        self._changes, self._curvatures = np.array(profile.changes_m), np.array(profile.per_m)
        # Heights and slopes at the start of each stretch; the first is counted from its end.
        self._starts = np.array([*profile.changes_m[:1], *profile.changes_m]) if profile.changes_m else np.zeros(1)
        self._heights = profile.top(self._starts)
        slopes = [0.0]
        for start, end, k in zip(self._starts[:-1], self._starts[1:], profile.per_m, strict=False):
            slopes.append(slopes[-1] - k * (end - start))
        # Level at s = 0, as the profile is.
        self._slopes = np.array(slopes)
        at_zero = int(np.searchsorted(self._changes, 0.0, side="right"))
        self._slopes -= self._slopes[at_zero] - self._curvatures[at_zero] * (0.0 - self._starts[at_zero])

    def derivatives(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights (n,) m, slopes (n,) and second derivatives (n,) 1/m at positions (n,) m."""
        k = np.searchsorted(self._changes, s, side="right")
        curvature, beyond = self._curvatures[k], s - self._starts[k]
        slope = self._slopes[k] - curvature * beyond
        return self._heights[k] + (self._slopes[k] + slope) / 2 * beyond, slope, -curvature
