"""Where to go on an object: ways along a surface, and along an edge. All in the arm's base frame, from what the arm
knows."""

from abc import ABC, abstractmethod

import numpy as np

_AHEAD_M = 3e-3
"""How far ahead on its line a route looks, m: three steps."""

STEEPEST = 0.25
"""Least cosine between the sensor's axis and the direction that a route is seen from, -: steeper, a way on the plan is
none on the surface."""


class Route(ABC):
    """A way to go, a step at a time."""

    part = 0
    """Which part of the route it is on, int."""
    ended = ""
    """Why it is over; empty while it is not."""
    closed = False
    """Whether it came back to where it began."""
    wrist_rad = 0.0
    """Where joint 6 is to be at its start, rad."""

    @abstractmethod
    def along(self, T_base_tcp, T_base_contact):
        """Direction (3,), unit, in the base frame and square to the sensor's axis; None where the route is over.

        T_base_tcp: (4, 4), the sensor. T_base_contact: (4, 4), the contact frame as it is felt (sim/pose.py).
        """


class PlanarPath(Route):
    """Along a line that is drawn on a plane, and goes over the object below it."""

    def __init__(self, points, up):
        """points: (n, 3) m, corners of the line in the base frame. up: (3,), unit: from where the plane is seen, outward."""
        up = np.asarray(up, float)
        flat = np.asarray(points, float)
        self._up, self._points = up, flat - np.outer(flat @ up, up)
        self._before = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(self._points, axis=0), axis=1))])
        self._at = 0.0

    @property
    def length_m(self):
        """Length (m) of the line."""
        return float(self._before[-1])

    def along(self, T_base_tcp, T_base_contact):
        """See Route."""
        place, axis = T_base_tcp[:3, 3], T_base_tcp[:3, 2]
        place = place - (place @ self._up) * self._up
        # On from where it was, to the nearest place within some steps.
        ways = np.linspace(self._at, min(self._at + 2 * _AHEAD_M, self.length_m), 25)
        self._at = float(ways[np.linalg.norm(self._point(ways) - place, axis=1).argmin()])
        self.part = int(np.clip(np.searchsorted(self._before, self._at + 1e-9, "right") - 1, 0, len(self._before) - 2))
        if self.length_m - self._at < _AHEAD_M / 6:
            self.ended = "the route is done"
            return None
        if axis @ -self._up < STEEPEST:
            self.ended = f"the surface is too steep: {np.degrees(np.arccos(axis @ -self._up)):.0f} degrees from the plan"
            return None
        way = self._point(np.array([min(self._at + _AHEAD_M, self.length_m)]))[0] - place
        way = way - (way @ axis) / (self._up @ axis) * self._up
        return way / np.linalg.norm(way)

    def _point(self, ways):
        return np.stack([np.interp(ways, self._before, c) for c in self._points.T], -1)


class Geodesic(Route):
    """Straight ahead as the sensor feels it: always the same way in its own frame, which turns with the surface alone."""

    def __init__(self, heading_rad, length_m):
        """heading_rad: float, from the sensor's x axis towards its y axis. length_m: float."""
        self._way = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
        self._left, self._last = length_m, None

    def along(self, T_base_tcp, T_base_contact):
        """See Route."""
        if self._last is not None:
            self._left -= float(np.linalg.norm(T_base_tcp[:3, 3] - self._last))
        self._last = T_base_tcp[:3, 3].copy()
        if self._left <= 0:
            self.ended = "the route is done"
            return None
        return T_base_tcp[:3, :3] @ self._way


class EdgePath(Route):
    """Along an edge as it is felt, until it comes back to its start or is too long."""

    def __init__(self, backward=False, most_m=1.0, step_m=1e-3):
        """backward: bool, against the y axis of the contact frame. most_m: float, longest way. step_m: float, of the
        servo."""
        self._sense, self._most, self._close = (-1.0 if backward else 1.0), most_m, 1.5 * step_m
        # Once round turns the sensor once round, and joint 6, which looks down, the other way.
        self.wrist_rad = self._sense * np.pi
        self._start = self._last = None
        self._gone, self._farthest = 0.0, 0.0

    def along(self, T_base_tcp, T_base_contact):
        """See Route."""
        place = T_base_tcp[:3, 3].copy()
        if self._start is None:
            self._start = self._last = place
        self._gone += float(np.linalg.norm(place - self._last))
        self._last = place
        away = float(np.linalg.norm(place - self._start))
        self._farthest = max(self._farthest, away)
        if self._farthest > 4 * self._close and away < self._close and self._gone > 2 * self._farthest:
            self.closed, self.ended = True, "the loop is closed"
            return None
        if self._gone > self._most:
            self.ended = f"the way is longer than {1e3 * self._most:.0f} mm"
            return None
        axis = T_base_tcp[:3, 2]
        way = self._sense * T_base_contact[:3, 1]
        way = way - (way @ axis) * axis
        return way / np.linalg.norm(way)


def serpentine(middle, along, across, length_m, width_m, spacing_m):
    """Corners (n, 3), m, of a line to and fro over a rectangle.

    middle: (3,) m. along, across: (3,), unit: of the passes, and from pass to pass. length_m, width_m: of the rectangle.
    spacing_m: between passes. Even parts of the line are passes, odd ones lead to the next.
    """
    count = max(1, round(width_m / spacing_m) + 1)
    offsets = np.linspace(-width_m / 2, width_m / 2, count) if count > 1 else np.zeros(1)
    middle, along, across = (np.asarray(x, float) for x in (middle, along, across))
    corners = []
    for k, offset in enumerate(offsets):
        ends = (-1, 1) if k % 2 == 0 else (1, -1)
        corners += [middle + e * length_m / 2 * along + offset * across for e in ends]
    return np.array(corners)
