"""Routes over a surface and along an edge, in the arm's base frame, from measured poses and estimates only."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.control.obstacles import Obstacle
from tactip_twin.sim.pose import matrix

_LOOKAHEAD_M = 3e-3
"""Distance to the point of the line that a route aims at, m: three steps."""

_STRETCH_M, _FOUND_M, _AT_OBSTACLE_M = 60e-3, 15e-3, 5e-3
"""Longest stretch of an edge from which its arc is estimated, the shortest after which an obstacle counts as past, and the
end before an obstacle that is not used, m [?]."""

_MAX_LEAN_RAD = np.radians(30.0)
"""Angle to the sensor before an obstacle beyond which what was found behind it is no continuation of the edge, rad: the end
of a wall, felt by the flank of a tip that hangs in a gap [?]."""

_LEANING_RAD = np.radians(4.0)
"""Angle of the sensor's axis to its mean over a stretch from which it counts as leaning into an obstacle, rad [?]."""

_TO_CORNER_M = 4e-3
"""Distance to the corner that is assumed where the edge is lost, and step behind it, m [?]."""

MIN_TILT_COSINE = 0.12
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
    travelled_m = 0.0
    """Distance along the route, m."""
    approach: np.ndarray | None = None
    """(3,) unit, the direction in the base frame from which any place on the route can be approached; None: unknown."""

    @abstractmethod
    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction (3,), a unit vector in the base frame, square to the sensor's axis; None at the end.

        Args:
            T_base_tcp: (4, 4), measured pose of the sensor.
            T_base_contact: (4, 4), estimated contact frame (sim/pose.py).

        Raises:
            Obstacle: The route has no direction on a surface as steep as this.
        """

    @abstractmethod
    def skip(self, distance_m: float, T_base_tcp: np.ndarray) -> np.ndarray | None:
        """Skip a piece of the route.

        Args:
            distance_m: Length of the piece, m; infinite for the rest of the present part.
            T_base_tcp: (4, 4), measured pose at which the tip last followed the route.

        Returns:
            That pose (4, 4), moved to where the route continues, as far as this is known; None at the end.
        """

    def places(self, distances_m: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the places (n, 3), m, base frame, at distances (n,) along a stretch that was left out.

        Args:
            distances_m: From the start of the stretch to its end, along the route.
            start: (3,) m, place where the tip last followed the route.
            end: (3,) m, place where it continues.
        """
        span = max(float(np.ptp(distances_m)), 1e-9)
        return start + ((distances_m - distances_m[0]) / span)[:, None] * (end - start)


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
        self.approach = -up

    @property
    def length_m(self) -> float:
        """Length of the line, m."""
        return float(self._before[-1])

    @property
    def _part_now(self) -> int:
        return int(np.clip(np.searchsorted(self._before, self.travelled_m + 1e-9, "right") - 1, 0, len(self._before) - 2))

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        place, axis = T_base_tcp[:3, 3], T_base_tcp[:3, 2]
        place = place - (place @ self._up) * self._up
        # Forward only, and within a few steps, because the line may pass close to itself.
        candidates = np.linspace(self.travelled_m, min(self.travelled_m + 2 * _LOOKAHEAD_M, self.length_m), 25)
        self.travelled_m = float(candidates[np.linalg.norm(self._point(candidates) - place, axis=1).argmin()])
        self.part = self._part_now
        if self.length_m - self.travelled_m < _LOOKAHEAD_M / 6:
            self.ended = "route completed"
            return None
        if axis @ -self._up < MIN_TILT_COSINE:
            slope = np.degrees(np.arccos(axis @ -self._up))
            raise Obstacle("too steep", f"the surface is {slope:.0f} degrees from the plane of the route")
        heading = self._point(np.array([min(self.travelled_m + _LOOKAHEAD_M, self.length_m)]))[0] - place
        heading = heading - (heading @ axis) / (self._up @ axis) * self._up
        return heading / np.linalg.norm(heading)

    def skip(self, distance_m: float, T_base_tcp: np.ndarray) -> np.ndarray | None:
        """Skip a piece; see Route."""
        # A part ends where the next begins.
        end = float(self._before[self._part_now + 1])
        self.travelled_m = min(end + 1e-6 if np.isinf(distance_m) else self.travelled_m + distance_m, self.length_m)
        if self.length_m - self.travelled_m < _LOOKAHEAD_M / 6:
            self.ended = "route completed"
            return None
        self.part = self._part_now
        T, place = T_base_tcp.copy(), T_base_tcp[:3, 3]
        T[:3, 3] = self._point(np.array([self.travelled_m]))[0] + (place @ self._up) * self._up
        return T

    def places(self, distances_m: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return places on the line, at heights between those of start and end; see Route."""
        heights = super().places(distances_m, start, end) @ self._up
        return self._point(distances_m) + heights[:, None] * self._up

    def _point(self, distances: np.ndarray) -> np.ndarray:
        """Return the points (n, 3) at distances (n,) along the line."""
        return np.stack([np.interp(distances, self._before, c) for c in self._points.T], -1)


class Geodesic(Route):
    """A route straight ahead: a constant direction in the sensor's frame, which turns with the surface only."""

    def __init__(self, heading_rad: float, length_m: float) -> None:
        """Set the heading, from the sensor's x axis towards its y axis, and the length."""
        self._heading = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
        self._length = length_m
        self._last: np.ndarray | None = None

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        if self._last is not None:
            self.travelled_m += float(np.linalg.norm(T_base_tcp[:3, 3] - self._last))
        self._last = T_base_tcp[:3, 3].copy()
        if self.travelled_m >= self._length:
            self.ended = "route completed"
            return None
        return T_base_tcp[:3, :3] @ self._heading

    def skip(self, distance_m: float, T_base_tcp: np.ndarray) -> np.ndarray | None:
        """Skip a piece; see Route."""
        self.travelled_m = min(self.travelled_m + distance_m, self._length)
        if self.travelled_m >= self._length:
            self.ended = "the rest of the route was left out" if np.isinf(distance_m) else "route completed"
            return None
        T = T_base_tcp.copy()
        T[:3, 3] += distance_m * (T[:3, :3] @ self._heading)
        self._last = None
        return T


class EdgePath(Route):
    """A route along an estimated edge, until it returns to its start or is too long.

    Where the edge is lost, it is expected on the arc of its last stretch; then round a corner.
    """

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
        self._heading, self._farthest = np.zeros(3), 0.0
        self._stretch: list[np.ndarray] = []
        self._new: list[np.ndarray] = []
        self._skipped, self._cornering = 0.0, False

    def direction(self, T_base_tcp: np.ndarray, T_base_contact: np.ndarray) -> np.ndarray | None:
        """Return the next direction; see Route."""
        place = T_base_tcp[:3, 3].copy()
        if self._start is None:
            self._start = place
        stretch = self._new if self._skipped else self._stretch
        if stretch:
            self.travelled_m += float(np.linalg.norm(place - stretch[-1][:3, 3]))
        stretch.append(T_base_tcp.copy())
        if self._skipped:
            self._check_lean(T_base_tcp)
        if self._skipped and _length(self._new) > _FOUND_M:  # the obstacle is behind
            self._stretch, self._new, self._skipped, self._cornering = self._new, [], 0.0, False
        while _length(self._stretch) > _STRETCH_M:
            self._stretch.pop(0)
        away = float(np.linalg.norm(place - self._start))
        self._farthest = max(self._farthest, away)
        if self._farthest > 4 * self._close and away < self._close and self.travelled_m > 2 * self._farthest:
            self.closed, self.ended = True, "loop closed"
            return None
        if self.travelled_m > self._limit:
            self.ended = f"stopped at the path limit of {1e3 * self._limit:.0f} mm"
            return None
        axis = T_base_tcp[:3, 2]
        heading = self._sense * T_base_contact[:3, 1]
        heading = heading - (heading @ axis) * axis
        self._heading = heading / np.linalg.norm(heading)
        return self._heading

    def _check_lean(self, T_base_tcp: np.ndarray) -> None:
        """Raise Obstacle if a sensor that found an edge behind an obstacle leans far from how it leaned before."""
        cosine = float(T_base_tcp[:3, 2] @ self._last_stretch(T_base_tcp)[0][:3, 2])
        if cosine < np.cos(_MAX_LEAN_RAD):
            lean = np.degrees(np.arccos(max(cosine, -1.0)))
            raise Obstacle("too steep", f"what was found leans {lean:.0f} degrees from the edge before the obstacle")

    def skip(self, distance_m: float, T_base_tcp: np.ndarray) -> np.ndarray | None:
        """Skip a piece, from where the edge was last followed for some time; see Route."""
        if np.isinf(distance_m):
            if self._cornering or not self._heading.any():
                self.ended = f"the edge was not found again within {1e3 * self._skipped:.0f} mm"
                return None
            self.travelled_m, self._skipped, self._cornering = self.travelled_m - self._skipped, 0.0, True
            distance_m = _TO_CORNER_M
        self.travelled_m, self._skipped, self._new = self.travelled_m + distance_m, self._skipped + distance_m, []
        T, heading, bend, to_obstacle = self._last_stretch(T_base_tcp)
        axis, length = T[:3, 2], to_obstacle + self._skipped
        inward = self._sense * np.cross(heading, axis)
        if self._cornering:  # the object lies inward, so that is where an outer corner leads
            angle, ahead, aside = np.pi / 2, to_obstacle + _TO_CORNER_M, self._skipped
        else:
            angle, ahead, aside = bend * length, length * np.sinc(bend * length / np.pi), 0.5 * bend * length**2
        turn = Rotation.from_rotvec(-self._sense * angle * axis)
        place = T[:3, 3] + ahead * heading + aside * inward
        return matrix(place, turn * Rotation.from_matrix(T[:3, :3]))

    def _last_stretch(self, T_base_tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Return a pose (4, 4) before the obstacle, the heading (3,) there, how the edge bends inward, rad/m, and the
        distance from there to where the edge was last followed, m.

        At the obstacle the sensor leans, and follows its shape instead of the edge's.
        """
        stretch = self._stretch
        axes = np.array([T[:3, 2] for T in stretch])
        usual = axes[: max(1, len(axes) // 2)].mean(0) if len(axes) else np.zeros(3)
        leaning = np.flatnonzero(axes @ usual < np.cos(_LEANING_RAD) * np.linalg.norm(usual)) if len(axes) else []
        end = int(leaning[0]) if len(leaning) else len(stretch)
        before = stretch[:end]
        while before and _length(stretch[len(before) - 1 : end]) < _AT_OBSTACLE_M:
            before = before[:-1]
        if _length(before) < _AT_OBSTACLE_M:
            return T_base_tcp, self._heading, 0.0, 0.0
        T, axis = before[-1], before[-1][:3, 2]
        places = np.array([one[:3, 3] for one in before])
        middle = len(places) // 2
        chords = np.array([places[middle] - places[0], places[-1] - places[middle]])
        chords -= np.outer(chords @ axis, axis)
        turned = float(np.arctan2(np.cross(chords[0], chords[1]) @ axis, chords[0] @ chords[1]))
        half = 0.5 * float(np.linalg.norm(chords, axis=1).sum())
        heading = Rotation.from_rotvec(0.5 * turned * axis).apply(chords[1] / np.linalg.norm(chords[1]))
        return T, heading, -self._sense * turned / half, _length(stretch[len(before) - 1 :])


def _length(poses: list[np.ndarray]) -> float:
    """Return the length, m, of a line through the places of poses (4, 4)."""
    places = np.array([T[:3, 3] for T in poses]).reshape(-1, 3)
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


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
