"""The true pose of the sensor on an object: what a perfect estimator would say, what scores are held against, and what a
walk (sim/dataset/sliding.py) is labelled by.

On a curved object the local contact frame has its z along the surface's normal where it is nearest to the apex, so that
depth is the distance of the undeformed apex below the surface.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import FACING, label_of, matrix


class SurfaceGroundTruth:
    """Labels on the surface of a solid."""

    def __init__(self, solid):
        """solid: Solid."""
        self._solid = solid

    def frame(self, T_object_sensor):
        """T_object_contact (4, 4) of a sensor: z the normal, turned about it so that the label has no yaw."""
        apex = T_object_sensor[:3, 3]
        at = self._solid.nearest(apex[None])
        normal = self._solid.smooth_normal(apex[None])[0]
        axis = T_object_sensor[:3, 2]
        lean = Rotation.align_vectors([-normal], [axis])[0] if axis @ normal > -1 + 1e-12 else Rotation.identity()
        return matrix(at.place[0], lean * Rotation.from_matrix(T_object_sensor[:3, :3] @ FACING))

    def label(self, T_object_sensor):
        """The label (6,), m and rad, of a sensor; x, y and yaw are zero but for the apex's place beside the normal."""
        frame = self.frame(T_object_sensor)
        label = label_of(np.linalg.inv(frame) @ T_object_sensor)
        label[2] = float(self._solid.distance(T_object_sensor[:3, 3]))
        label[:2] = label[5] = 0.0
        return label


class EdgeGroundTruth:
    """Labels on an edge."""

    def __init__(self, edge):
        """edge: objects.Edge."""
        points = edge.points
        self._starts, self._ways = points[:-1], np.diff(points, axis=0)
        self._lengths = np.linalg.norm(self._ways, axis=1)
        self._normals = edge.normals
        self.closed = edge.closed
        self._before = np.concatenate([[0.0], np.cumsum(self._lengths)])
        tangents = self._ways / self._lengths[:, None]
        # Smooth along the edge: at a point, the mean of both sides of it.
        ends = (tangents[-1] + tangents[0], tangents[-1] + tangents[0]) if edge.closed else (tangents[0], tangents[-1])
        inner = np.concatenate([[ends[0]], tangents[1:] + tangents[:-1], [ends[1]]])
        self._tangents = inner / np.linalg.norm(inner, axis=1, keepdims=True)

    def nearest(self, point):
        """Distance along the edge (m), place (3,), normal (3,) and tangent (3,) where it is nearest to a point (3,)."""
        share = np.clip(((point - self._starts) * self._ways).sum(1) / self._lengths**2, 0, 1)
        places = self._starts + share[:, None] * self._ways
        k = int(((places - point) ** 2).sum(1).argmin())
        a, b = 1 - share[k], share[k]
        normal = a * self._normals[k] + b * self._normals[k + 1]
        tangent = a * self._tangents[k] + b * self._tangents[k + 1]
        tangent /= np.linalg.norm(tangent)
        normal -= (normal @ tangent) * tangent
        return self._before[k] + b * self._lengths[k], places[k], normal / np.linalg.norm(normal), tangent

    def frame(self, T_object_sensor):
        """T_object_contact (4, 4): z the top's normal, x off the object, y along the edge (sim/pose.py)."""
        _, place, normal, tangent = self.nearest(T_object_sensor[:3, 3])
        # Edges run anticlockwise as seen from above: off the object is to the right of the way.
        off = np.cross(tangent, normal)
        return matrix(place, Rotation.from_matrix(np.stack([off, np.cross(normal, off), normal], -1)))

    def label(self, T_object_sensor):
        """The label (6,), m and rad, of a sensor."""
        return label_of(np.linalg.inv(self.frame(T_object_sensor)) @ T_object_sensor)
