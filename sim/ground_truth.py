"""True labels of a sensor on an object, used to score a servo and to label sliding contacts (sim/dataset/sliding.py).

On a curved object the local contact frame has its z along the surface normal at the point nearest to the apex, so depth is
the distance of the undeformed apex below the surface. In a wall thinner than twice the depth, the nearest point may lie on
the far side; then the frame is at the point of the near side whose normal runs through the apex.
"""

from typing import TYPE_CHECKING, Protocol

import numpy as np

from tactip_twin.sim.contact.signed_distance import DistanceField
from tactip_twin.sim.pose import FACING, inverse, label_of, matrix, rotation_of, shortest_turn

if TYPE_CHECKING:
    from tactip_twin.sim.robot.objects import Edge


class GroundTruth(Protocol):
    """True labels of a sensor on one object."""

    def frame(self, T_object_sensor: np.ndarray, /) -> np.ndarray:
        """Return T_object_contact (4, 4) of a sensor (4, 4)."""
        ...

    def label(self, T_object_sensor: np.ndarray, /) -> np.ndarray:
        """Return the label (6,), m and rad, of a sensor (4, 4)."""
        ...


class SurfaceGroundTruth:
    """Labels on the surface of a solid."""

    def __init__(self, solid: DistanceField) -> None:
        self._solid = solid
        self._last: tuple[np.ndarray, np.ndarray, float] | None = None
        """The last sensor (4, 4), and its frame and height: a step of a servo run asks for them several times."""

    def frame(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return T_object_contact (4, 4) of a sensor (4, 4): z is the normal, rotated about it so that yaw is zero."""
        return self._frame_and_height(T_object_sensor)[0]

    def label(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return the label (6,), m and rad, of a sensor (4, 4). x, y and yaw are zero: a surface does not define them."""
        T_object_contact, height_m = self._frame_and_height(T_object_sensor)
        label = label_of(inverse(T_object_contact) @ T_object_sensor)
        label[2] = height_m
        label[:2] = label[5] = 0.0
        return label

    def _frame_and_height(self, T_object_sensor: np.ndarray) -> tuple[np.ndarray, float]:
        """Return T_object_contact (4, 4) of a sensor (4, 4), and the height of its apex above the surface, m."""
        if self._last is None or not np.array_equal(self._last[0], T_object_sensor):
            place, normal, height_m = self._foot(T_object_sensor)
            turn = shortest_turn(T_object_sensor[:3, 2], -normal)
            frame = matrix(place, turn * rotation_of(T_object_sensor[:3, :3] @ FACING))
            self._last = np.array(T_object_sensor), frame, height_m
        return self._last[1].copy(), self._last[2]

    def _foot(self, T_object_sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the point (3,) of the surface below the apex, its normal (3,), and the apex's height above it, m."""
        apex, axis = T_object_sensor[:3, 3], T_object_sensor[:3, 2]
        at, normal = self._solid.nearest(apex[None]), self._solid.smooth_normal(apex[None])[0]
        if normal @ axis <= (0 if at.distance[0] < 0 else _MIN_FACING):
            return at.place[0], normal, float(at.distance[0])
        # The nearest point is on the far side of a wall, out of which the apex of a deep press comes again if the wall is
        # thin. Seen from outside, on the normal that runs through the apex, the
        # near side is nearest; that normal is a fixed point.
        normal = -axis
        for _ in range(_FOOT_ROUNDS):
            outside = (apex + _OUTSIDE_M * normal)[None]
            at, normal = self._solid.nearest(outside), self._solid.smooth_normal(outside)[0]
        return at.place[0], normal, float((apex - at.place[0]) @ normal)


_MIN_FACING = 0.5
"""Cosine between the sensor's axis and the normal at the nearest point from which a surface behind an apex outside is that
of a wall that was pressed through: the tip is there [?]."""

_OUTSIDE_M = 10e-3
"""Distance from the apex at which a point is outside of a wall that the tip presses, m: more than any depth [?]."""

_FOOT_ROUNDS = 10
"""Number of rounds of the fixed point; each leaves a third of the error or less on ridges of more than 5 mm radius."""


class EdgeGroundTruth:
    """Labels on an edge."""

    def __init__(self, edge: "Edge") -> None:
        points = edge.points
        self._starts, self._segments = points[:-1], np.diff(points, axis=0)
        self._lengths = np.linalg.norm(self._segments, axis=1)
        self._normals = edge.normals
        self.closed = edge.closed
        self._distances = np.concatenate([[0.0], np.cumsum(self._lengths)])
        tangents = self._segments / self._lengths[:, None]
        # Smooth along the edge: the tangent at a point is the mean of the segments on both sides of it.
        ends = (tangents[-1] + tangents[0], tangents[-1] + tangents[0]) if edge.closed else (tangents[0], tangents[-1])
        inner = np.concatenate([[ends[0]], tangents[1:] + tangents[:-1], [ends[1]]])
        self._tangents = inner / np.linalg.norm(inner, axis=1, keepdims=True)

    def nearest(self, point: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Return where the edge is nearest to a point (3,) m.

        Returns:
            Distance along the edge (m), place (3,) m, unit normal (3,) and unit tangent (3,).
        """
        fraction = np.clip(((point - self._starts) * self._segments).sum(1) / self._lengths**2, 0, 1)
        places = self._starts + fraction[:, None] * self._segments
        k = int(((places - point) ** 2).sum(1).argmin())
        a, b = 1 - fraction[k], fraction[k]
        normal = a * self._normals[k] + b * self._normals[k + 1]
        tangent = a * self._tangents[k] + b * self._tangents[k + 1]
        tangent /= np.linalg.norm(tangent)
        normal -= (normal @ tangent) * tangent
        return self._distances[k] + b * self._lengths[k], places[k], normal / np.linalg.norm(normal), tangent

    def frame(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return T_object_contact (4, 4) of a sensor (4, 4): z is the normal of the top, x points off the object, y runs
        along the edge (sim/pose.py)."""
        _, place, normal, tangent = self.nearest(T_object_sensor[:3, 3])
        # Edges run anticlockwise as seen from above, so the right-hand side of the tangent is off the object.
        off = np.cross(tangent, normal)
        return matrix(place, rotation_of(np.stack([off, np.cross(normal, off), normal], -1)))

    def label(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return the label (6,), m and rad, of a sensor (4, 4)."""
        return label_of(inverse(self.frame(T_object_sensor)) @ T_object_sensor)
