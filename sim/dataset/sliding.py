"""Sliding paths: the tip keeps sliding after a contact, and an image is taken after each stride.

In servoing, the tip slides far in varying directions without being lifted; a single press and shear never reaches such a
state. A stride also costs a fraction of a new contact, which starts in the air.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.limits import MAX_TILT_RAD, tilt
from tactip_twin.sim.contact.signed_distance import DistanceField, Nearest
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.ground_truth import GroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import label_of, matrix, sensor_in_contact

MAX_SNAPSHOTS = 1000
"""Maximum number of images per contact."""

_STRIDE_M = (0.2e-3, 2e-3)
"""Minimum and maximum stride, m, sampled uniformly in its logarithm: a servo's is 1 mm, and less where it slows down."""

_MAX_DISTANCE_M = 16e-3
"""Distance from its start at which a path turns back, m: within the patch of a curved surface
(sim/contact/curved_surface.py)."""

_MAX_APPROACH = 0.5
"""Maximum fraction of the difference to its target pose that a stride covers, -: successive poses of a servo differ little
[?]."""

_NEW_POSE, _NEW_HEADING = 0.3, 0.15
"""Probabilities that a stride gets a new target pose, and a new heading, - [?]."""

_SWAY_RAD, _YAW_RAD = 0.15, 0.02
"""Standard deviations of the change of heading and yaw in a stride, rad [?]."""

_POSITION_ON_OBJECT = {"surface": [0, 1, 5], "edge": [1]}
"""Components of a pose, by task, that only give the sensor's position on the object: strides change them, labels lack
them."""


class _Plane:
    """The plane z = 0, as a DistanceField."""

    def nearest(self, points: np.ndarray) -> Nearest:
        """Return the points of the plane nearest to `points` (n, 3), m."""
        place = points * [1.0, 1.0, 0.0]
        return Nearest(points[:, 2], place, self.smooth_normal(points))

    def distance(self, points: ArrayLike) -> np.ndarray:
        """Return the signed distance (...), m, of points (..., 3), m."""
        return np.asarray(points)[..., 2]

    def smooth_normal(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (n, 3) below points (n, 3), m."""
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))


class _StraightEdgeGroundTruth:
    """Labels on the edge along y, with the methods of the classes in sim/ground_truth.py."""

    def frame(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return T_object_contact (4, 4) for a sensor."""
        return matrix([0.0, T_object_sensor[1, 3], 0.0], Rotation.identity())

    def label(self, T_object_sensor: np.ndarray) -> np.ndarray:
        """Return the label (6,), m and rad, of a sensor."""
        return label_of(np.linalg.inv(self.frame(T_object_sensor)) @ T_object_sensor)


def ground_truth_on(task: str, solid: DistanceField | None = None) -> GroundTruth:
    """Return the ground truth of a task on a solid; by default on the flat surface or the straight edge."""
    return _StraightEdgeGroundTruth() if task == "edge" else SurfaceGroundTruth(solid or _Plane())


class SlidingPath:
    """A random path along which a contact keeps sliding, stride by stride."""

    def __init__(
        self, task: str, solid: DistanceField | None, ranges: Ranges, pose: ArrayLike, rng: np.random.Generator
    ) -> None:
        """Start at the pose of a contact.

        Args:
            task: `surface` or `edge`.
            solid: Object that is touched; None for the flat surface and the straight edge.
            ranges: Ranges of the labelled poses, which the path keeps to.
            pose: (6,), m and rad, current pose of the contact.
            rng: Generator of the path.
        """
        self._on_edge = task == "edge"
        self.truth = ground_truth_on(task, solid)
        """Ground truth of labels on the object."""
        self._ranges, self._rng, self._free = ranges, rng, _POSITION_ON_OBJECT[task]
        self._T, self._label = sensor_in_contact(pose), self._local(pose)
        self._heading, self._target = self._random_heading(), self._random_label()

    def stride(self) -> np.ndarray:
        """Take a stride; return the pose (6,), m and rad, of the sensor in the stimulus frame to slide to."""
        self._label = self._label + self._rng.uniform(0, _MAX_APPROACH) * (self._next_target() - self._label)
        length = np.exp(self._rng.uniform(*np.log(_STRIDE_M)))
        frame = self.truth.frame(self._T)
        ahead = matrix(length * self._direction(frame), Rotation.from_rotvec([0, 0, self._yaw_change()]))
        beside = frame @ ahead @ np.linalg.inv(frame) @ self._T
        self._T = self.truth.frame(beside) @ sensor_in_contact(self._label)
        return label_of(self._T)

    def label(self) -> np.ndarray:
        """Return the true label (6,), m and rad, after the last stride."""
        return self.truth.label(self._T)

    def _next_target(self) -> np.ndarray:
        """Return the label (6,) that a stride approaches."""
        if self._rng.uniform() < _NEW_POSE:
            self._target = self._random_label()
        return self._target

    def _random_label(self) -> np.ndarray:
        """Return a label (6,) in the ranges that is not too steep; `tactip_twin.sim.dataset.generate.check` ensures that
        there are some."""
        while True:
            label = self._ranges.sample(self._rng)
            if tilt(label) <= MAX_TILT_RAD:
                return self._local(label)

    def _local(self, pose: ArrayLike) -> np.ndarray:
        """Return a pose (6,) without its position on the object."""
        label = np.array(pose, float)
        label[self._free] = 0.0
        return label

    def _random_heading(self) -> float:
        return self._rng.uniform(-np.pi, np.pi)

    def _yaw_change(self) -> float:
        """Return the yaw of a stride, rad; on an edge yaw belongs to the label."""
        return 0.0 if self._on_edge else self._rng.normal(0, _YAW_RAD)

    def _direction(self, frame: np.ndarray) -> np.ndarray:
        """Return the unit direction (3,) of a stride in a contact frame (4, 4)."""
        self._heading = self._random_heading() if self._rng.uniform() < _NEW_HEADING else self._heading
        self._heading += self._rng.normal(0, _SWAY_RAD)
        if self._on_edge:
            outward = frame[1, 3] * np.sin(self._heading) > 0
            if abs(frame[1, 3]) > _MAX_DISTANCE_M and outward:
                self._heading = -self._heading
            return np.array([0.0, np.sign(np.sin(self._heading)), 0.0])
        if np.linalg.norm(frame[:2, 3]) > _MAX_DISTANCE_M:
            back = -frame[:3, :3].T @ [*frame[:2, 3], 0.0]
            self._heading = np.arctan2(back[1], back[0]) + self._rng.normal(0, _SWAY_RAD)
        return np.array([np.cos(self._heading), np.sin(self._heading), 0.0])
