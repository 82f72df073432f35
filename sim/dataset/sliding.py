"""A contact that goes on: the tip slides over what it touches, and is looked at again after each stride.

A servo's images are of a tip that has slid for long, this way and that, and has never been lifted: no single press and shear
leads to them. And a stride costs a fraction of a contact of its own, which begins in the air.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.limits import MAX_TILT_RAD, tilt
from tactip_twin.sim.contact.signed_distance import Nearest
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.pose import label_of, matrix, sensor_in_contact

MOST_LOOKS = 1000
"""Most looks at one contact."""

_STRIDE_M = (0.2e-3, 2e-3)
"""Shortest and longest stride, m, drawn evenly in its logarithm: a servo's is 1 mm, and less where it slows down."""

_FARTHEST_M = 16e-3
"""How far from where it began a walk goes before it turns back, m: within the piece of a bent surface
(sim/contact/curved_surface.py)."""

_NEARER = 0.5
"""Greatest share of what lies between its pose and the one that it makes for that a stride takes, -: a servo's poses differ
little from one to the next [?]."""

_NEW_POSE, _NEW_HEADING = 0.3, 0.15
"""Chances that a stride makes for another pose than the one before, and that it takes another heading, - [?]."""

_SWAY_RAD, _YAW_RAD = 0.15, 0.02
"""How far heading and yaw go astray in a stride, rad, standard deviations [?]."""


_ALONG = {"surface": [0, 1, 5], "edge": [1]}
"""Components of a pose, by task, that only say where on the object a sensor is: a stride changes them, and no label has
them."""


class _Flat:
    """The plane z = 0, asked as a Solid is."""

    def nearest(self, points):
        """Nearest of points (n, 3) m."""
        place = points * [1.0, 1.0, 0.0]
        return Nearest(points[:, 2], place, self.smooth_normal(points))

    def distance(self, points):
        """Signed distance (...) m of points (..., 3) m."""
        return np.asarray(points)[..., 2]

    def smooth_normal(self, points):
        """Normals (n, 3), unit, below points (n, 3) m."""
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))


class _StraightTruth:
    """Labels on the edge along y, as sim/ground_truth.py has them on others."""

    def frame(self, T_edge_sensor):
        """T_edge_contact (4, 4) of a sensor."""
        return matrix([0.0, T_edge_sensor[1, 3], 0.0], Rotation.identity())

    def label(self, T_edge_sensor):
        """The label (6,), m and rad, of a sensor."""
        return label_of(np.linalg.inv(self.frame(T_edge_sensor)) @ T_edge_sensor)


class SlidingPath:
    """Where a contact goes on to, stride by stride."""

    def __init__(self, task, solid, ranges, pose, draw):
        """task: surface or edge. solid: Solid that is touched; None for the flat and the straight edge. ranges:
        sampling.Ranges of labelled poses, which are kept to. pose: (6,) m and rad, where the contact is now. draw: numpy
        Generator."""
        self._along = task == "edge"
        self.truth = _StraightTruth() if self._along else SurfaceGroundTruth(solid or _Flat())
        """Tells the label of a sensor, as of sim/ground_truth.py."""
        self._ranges, self._draw, self._anywhere = ranges, draw, _ALONG[task]
        self._T, self._label = sensor_in_contact(pose), self._local(pose)
        self._heading, self._target = self._any_heading(), self._any_pose()

    def stride(self):
        """Go on. Returns the pose (6,) of the sensor in the stimulus' frame to slide to, m and rad."""
        self._label = self._label + self._draw.uniform(0, _NEARER) * (self._aim() - self._label)
        length = np.exp(self._draw.uniform(*np.log(_STRIDE_M)))
        frame = self.truth.frame(self._T)
        ahead = matrix(length * self._way(frame), Rotation.from_rotvec([0, 0, self._turn()]))
        beside = frame @ ahead @ np.linalg.inv(frame) @ self._T
        self._T = self.truth.frame(beside) @ sensor_in_contact(self._label)
        return label_of(self._T)

    def label(self):
        """The true label (6,), m and rad, of where the last stride leads to."""
        return self.truth.label(self._T)

    def _aim(self):
        """The label (6,) that is made for."""
        if self._draw.uniform() < _NEW_POSE:
            self._target = self._any_pose()
        return self._target

    def _any_pose(self):
        """A label (6,) in the ranges that can be played, of which `tactip_twin.sim.dataset.generate.check` has seen that
        there are."""
        while True:
            label = self._ranges.draw(self._draw)
            if tilt(label) <= MAX_TILT_RAD:
                return self._local(label)

    def _local(self, pose):
        """A pose (6,) without what only says where on the object it is."""
        label = np.array(pose, float)
        label[self._anywhere] = 0.0
        return label

    def _any_heading(self):
        return self._draw.uniform(-np.pi, np.pi)

    def _turn(self):
        """Yaw of a stride, rad; on an edge it is of the label."""
        return 0.0 if self._along else self._draw.normal(0, _YAW_RAD)

    def _way(self, frame):
        """Unit vector (3,) of a stride in a contact frame (4, 4)."""
        self._heading = self._any_heading() if self._draw.uniform() < _NEW_HEADING else self._heading
        self._heading += self._draw.normal(0, _SWAY_RAD)
        if self._along:
            outward = frame[1, 3] * np.sin(self._heading) > 0
            if abs(frame[1, 3]) > _FARTHEST_M and outward:
                self._heading = -self._heading
            return np.array([0.0, np.sign(np.sin(self._heading)), 0.0])
        if np.linalg.norm(frame[:2, 3]) > _FARTHEST_M:
            back = -frame[:3, :3].T @ [*frame[:2, 3], 0.0]
            self._heading = np.arctan2(back[1], back[0]) + self._draw.normal(0, _SWAY_RAD)
        return np.array([np.cos(self._heading), np.sin(self._heading), 0.0])
