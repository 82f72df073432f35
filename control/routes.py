"""Routes over a surface and along an edge, in the arm's base frame, from measured poses and estimates only."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

_LOOKAHEAD_M = 3e-3
"""Distance to the point of the line that a route aims at, m: three steps."""

MIN_TILT_COSINE = 0.25
"""Smallest cosine between the sensor's axis and the direction of projection, -: on steeper surfaces, a direction in the
plane has no useful counterpart on the surface."""


class Route(ABC):
    """A route, step by step."""

    part = 0
    """Index of the present part."""
    ended = ""
    """Why it ended; empty until then."""
    closed = False
    """Whether it returned to its start."""
    wrist_rad = 0.0
    """Desired angle of joint 6 at the start, rad."""

    @abstractmethod
    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction (3,), a unit vector in the base frame, square to the sensor's axis; None at the end.

        Args:
            T_base_tcp: (4, 4), measured pose of the sensor.
            T_base_contact: (4, 4), estimated contact frame (sim/pose.py).
        """


class PlanarPath(Route):
    """A route along a line in a plane, projected onto the object below."""

    def __init__(self, points: ArrayLike, up: ArrayLike) -> None:
        """Project a line.

        Args:
            points: (n, 3), corners of the line in the base frame, m.
            up: (3,), outward normal of the plane, unit.
        """
        up = np.asarray(up, float)
        flat = np.asarray(points, float)
        self._up, self._points = up, flat - np.outer(flat @ up, up)
        self._before = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self._points, axis=0), axis=1))])
        self._at = 0.0

    @property
    def length_m(self) -> float:
        """Length of the line, m."""
        return float(self._before[-1])

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        place, axis = T_base_tcp[:3, 3], T_base_tcp[:3, 2]
        place = place - (place @ self._up) * self._up
        # Forward only, and within a few steps, because the line may pass close to itself.
        candidates = np.linspace(self._at, min(self._at + 2 * _LOOKAHEAD_M, self.length_m), 25)
        self._at = float(candidates[np.linalg.norm(self._point(candidates) - place, axis=1).argmin()])
        self.part = int(np.clip(np.searchsorted(self._before, self._at + 1e-9, "right") - 1, 0, len(self._before) - 2))
        if self.length_m - self._at < _LOOKAHEAD_M / 6:
            self.ended = "route completed"
            return None
        if axis @ -self._up < MIN_TILT_COSINE:
            slope = np.degrees(np.arccos(axis @ -self._up))
            self.ended = f"the surface is too steep: {slope:.0f} degrees from the plane of the route"
            return None
        heading = self._point(np.array([min(self._at + _LOOKAHEAD_M, self.length_m)]))[0] - place
        heading = heading - (heading @ axis) / (self._up @ axis) * self._up
        return heading / np.linalg.norm(heading)

    def _point(self, distances: np.ndarray) -> np.ndarray:
        """Return the points (n, 3) at distances (n,) along the line."""
        return np.stack([np.interp(distances, self._before, c) for c in self._points.T], -1)


class Geodesic(Route):
    """A route straight ahead: a constant direction in the sensor's frame, which turns with the surface only."""

    def __init__(self, heading_rad: float, length_m: float) -> None:
        """Set the heading, from the sensor's x axis towards its y axis, and the length."""
        self._heading = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
        self._left = length_m
        self._last: np.ndarray | None = None

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        if self._last is not None:
            self._left -= float(np.linalg.norm(T_base_tcp[:3, 3] - self._last))
        self._last = T_base_tcp[:3, 3].copy()
        if self._left <= 0:
            self.ended = "route completed"
            return None
        return T_base_tcp[:3, :3] @ self._heading


class EdgePath(Route):
    """A route along an estimated edge, until it returns to its start or is too long."""

    def __init__(self, backward: bool = False, max_length_m: float = 1.0, step_m: float = 1e-3) -> None:
        """Start a route.

        Args:
            backward: Whether it runs in the negative y direction of the contact frame.
            max_length_m: Limit of its length, m.
            step_m: Tangential step of the servo, m.
        """
        self._sense, self._limit, self._close = (-1.0 if backward else 1.0), max_length_m, 1.5 * step_m
        # A full loop turns the sensor once, and joint 6, which points down, in the opposite direction.
        self.wrist_rad = self._sense * np.pi
        self._start: np.ndarray | None = None
        self._last = np.zeros(3)
        self._gone, self._farthest = 0.0, 0.0

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        place = T_base_tcp[:3, 3].copy()
        if self._start is None:
            self._start = self._last = place
        self._gone += float(np.linalg.norm(place - self._last))
        self._last = place
        away = float(np.linalg.norm(place - self._start))
        self._farthest = max(self._farthest, away)
        if self._farthest > 4 * self._close and away < self._close and self._gone > 2 * self._farthest:
            self.closed, self.ended = True, "loop closed"
            return None
        if self._gone > self._limit:
            self.ended = f"stopped at the path limit of {1e3 * self._limit:.0f} mm"
            return None
        axis = T_base_tcp[:3, 2]
        heading = self._sense * T_base_contact[:3, 1]
        heading = heading - (heading @ axis) * axis
        return heading / np.linalg.norm(heading)


def serpentine(
    middle: ArrayLike, along: ArrayLike, across: ArrayLike, length_m: float, width_m: float, spacing_m: float
) -> np.ndarray:
    """Return the corners (n, 3), m, of a serpentine line over a rectangle. Even parts are passes, odd ones lead to the next.

    Args:
        middle: (3,), middle of the rectangle, m.
        along: (3,), direction of the passes, unit.
        across: (3,), direction from pass to pass, unit.
        length_m: Length of a pass, m.
        width_m: Width of the rectangle, m.
        spacing_m: Distance between passes, m.
    """
    count = max(1, round(width_m / spacing_m) + 1)
    offsets = np.linspace(-width_m / 2, width_m / 2, count) if count > 1 else np.zeros(1)
    middle, along, across = (np.asarray(x, float) for x in (middle, along, across))
    corners = []
    for k, offset in enumerate(offsets):
        ends = (-1, 1) if k % 2 == 0 else (1, -1)
        corners += [middle + e * length_m / 2 * along + offset * across for e in ends]
    return np.array(corners)
