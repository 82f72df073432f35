"""What the learned tip knows of a contact: depth, tilt and shear, in axes that turn with the contact.

A turn of the sensor about the tip's axis turns the features of a surface contact in pairs. On an edge, the features are in
axes whose y is parallel to the edge, so the sensor's yaw does not appear in them.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import Task

_MM, _DEG = 1e3, float(np.degrees(1.0))

COUNT: dict[Task, int] = {"surface": 9, "edge": 10}
"""Number of features."""

_FIRST: dict[Task, int] = {"surface": 0, "edge": 1}
"""Position of the depth: on an edge, the position across it comes first."""


def pairs(task: Task) -> list[int]:
    """Return the positions of the first feature of each pair (x, y) that a turn about the tip's axis turns."""
    return [_FIRST[task] + k for k in (1, 3, 6)]


def mirrored(task: Task) -> np.ndarray:
    """Return the factors (COUNT,) that a mirror in the plane of x and z multiplies the features by."""
    factors = np.ones(COUNT[task])
    # y of the normal and of the shear; x and z of its turn, which is axial.
    factors[[_FIRST[task] + k for k in (2, 4, 6, 8)]] = -1
    return factors


def features(task: Task, poses: np.ndarray, shears: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the features of contacts, and the yaw of the axes they are in.

    They are (on an edge) the position across it, mm; the depth, mm; x and y of the surface's normal, in tenths; the shear of
    the sensor, mm, and its turn, degrees, three components each. Vectors are in label axes that are turned by the yaw.

    Args:
        task: `surface` or `edge`.
        poses: (n, 6) m and rad.
        shears: (n, 6) m and rad.

    Returns:
        Features (n, COUNT), and the yaw (n,), rad, about z of the label axes; 0 on a surface.
    """
    poses, shears = np.asarray(poses, float), np.asarray(shears, float)
    into_label = Rotation.from_rotvec(poses[:, 3:]).inv()
    yaw = _yaw(into_label) if task == "edge" else np.zeros(len(poses))
    into_axes = Rotation.from_rotvec(-yaw[:, None] * [0.0, 0.0, 1.0]) * into_label
    normal = into_axes.apply([0.0, 0.0, 1.0])[:, :2]
    columns = [_MM * poses[:, 2:3], 10 * normal, _MM * into_axes.apply(shears[:, :3]), _DEG * into_axes.apply(shears[:, 3:])]
    if task == "edge":
        columns.insert(0, _MM * poses[:, :1])
    return np.concatenate(columns, 1), yaw


def without_yaw(poses: np.ndarray) -> np.ndarray:
    """Return poses (n, 6), m and rad, on an edge, of sensors turned about their own axis until y is parallel to the edge."""
    turned = Rotation.from_rotvec(poses[:, 3:])
    upright = turned * Rotation.from_rotvec(_yaw(turned.inv())[:, None] * [0.0, 0.0, 1.0])
    return np.concatenate([poses[:, :3], upright.as_rotvec()], 1)


def _yaw(into_label: Rotation) -> np.ndarray:
    """Return the yaw (n,), rad, about z of the label axes, of rotations from the sensor's axes."""
    along = into_label.apply([0.0, 1.0, 0.0])
    return np.arctan2(-along[:, 0], along[:, 1])
