"""Frames and labels.

The contact frame F sits on the surface or edge: z is the outward normal, x is perpendicular to the edge and points off the
object, y runs along the edge. The sensor frame S has its origin at the apex of the undeformed tip, z out of the tip, x to
the right and y down in the image. At pose zero the tip just touches and faces the object:

        housing                     z_F (outward)
          ║                           │
       ╭──╨──╮                        │    y_F into the page (along the edge)
       ╰──┬──╯  x_S = x_F             └──── x_F
    ▄▄▄▄▄▄│                        the object fills z_F < 0, and x_F < 0 too if it is an edge
    ██████↓ z_S = -z_F

A label is the pose of the sensor in F, of the axes that are parallel to F at zero ("label axes": x right, y up in the
image, z towards the housing): three coordinates of the apex and a rotation vector (axis-angle). So

    T_contact_sensor = [R(rotation vector), position] · (half a turn about x)

depth: z, negative into the object; roll, pitch, yaw: the rotation vector's x, y, z. Effect on the image of each component
alone (tests/sim/contact/test_labels.py): as x grows, the edge moves left; as z falls, pins move outward; as roll grows, the
tip leans on the lower side of its image; pitch, on the right side; yaw, the edge turns clockwise.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

FACING = np.diag([1.0, -1.0, -1.0])
"""Label axes in the sensor's frame at pose zero: half a turn about x."""

_T_FACING = np.diag([*np.diag(FACING), 1.0])
_MM_DEG = np.array([1e3] * 3 + [180 / np.pi] * 3)


def to_mm_deg(pose: ArrayLike) -> np.ndarray:
    """Return poses (..., 6) in m and rad as mm and degrees."""
    return np.asarray(pose, float) * _MM_DEG


def from_mm_deg(pose: ArrayLike) -> np.ndarray:
    """Return poses (..., 6) in mm and degrees as m and rad."""
    return np.asarray(pose, float) / _MM_DEG


def matrix(position: ArrayLike, rotation: Rotation) -> np.ndarray:
    """Return the rigid transform (4, 4) of a position (3,) and a rotation."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = position
    return T


def rotation_of(T: np.ndarray) -> Rotation:
    """Return the rotation of a rigid transform (4, 4) or rotation matrix (3, 3), which is not checked: a check takes five
    times as long as the conversion [M]."""
    return Rotation.from_matrix(T[:3, :3], assume_valid=True)


def inverse(T: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid transform (4, 4)."""
    R = T[:3, :3].T
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, -R @ T[:3, 3]
    return out


def sensor_in_contact(pose: ArrayLike) -> np.ndarray:
    """Return T_contact_sensor (4, 4) of a label (6,), m and rad."""
    pose = np.asarray(pose, float)
    return matrix(pose[:3], Rotation.from_rotvec(pose[3:])) @ _T_FACING


def label_of(T_contact_sensor: np.ndarray) -> np.ndarray:
    """Return the label (6,), m and rad, of a T_contact_sensor (4, 4)."""
    T = T_contact_sensor @ _T_FACING
    return np.concatenate([T[:3, 3], rotation_of(T).as_rotvec()])


def before_shear(pose: ArrayLike, shear: ArrayLike) -> np.ndarray:
    """Return the labels (..., 6) from which shears lead to poses: the paper's "target minus perturbation".

    The shear is a motion of the sensor in the contact frame: its apex moves by the first three components, and it turns
    about its apex by the rotation vector of the last three.

    Args:
        pose: (..., 6), m and rad.
        shear: (..., 6), m and rad.
    """
    pose, shear = np.asarray(pose, float), np.asarray(shear, float)
    turn = Rotation.from_rotvec(-shear[..., 3:]) * Rotation.from_rotvec(pose[..., 3:])
    return np.concatenate([pose[..., :3] - shear[..., :3], turn.as_rotvec()], -1)


def shear_between(start: ArrayLike, pose: ArrayLike) -> np.ndarray:
    """Return the shears (..., 6) that lead from labels `start` (..., 6) to labels `pose` (..., 6): the inverse of
    `before_shear`."""
    start, pose = np.asarray(start, float), np.asarray(pose, float)
    turn = Rotation.from_rotvec(pose[..., 3:]) * Rotation.from_rotvec(start[..., 3:]).inv()
    return np.concatenate([pose[..., :3] - start[..., :3], turn.as_rotvec()], -1)


def path(start: np.ndarray, end: np.ndarray, fractions: ArrayLike) -> np.ndarray:
    """Return labels (n, 6) on the straight path between two labels, with the turn at a constant rate.

    Args:
        start: (6,), m and rad.
        end: (6,), m and rad.
        fractions: (n,) of the path, 0 to 1.
    """
    fractions = np.asarray(fractions, float)[:, None]
    first = Rotation.from_rotvec(start[3:])
    turn = (Rotation.from_rotvec(end[3:]) * first.inv()).as_rotvec()
    rotation = Rotation.from_rotvec(fractions * turn) * first
    return np.concatenate([start[:3] + fractions * (end[:3] - start[:3]), rotation.as_rotvec()], 1)


def turn_between(start: np.ndarray, end: np.ndarray) -> float:
    """Return the angle (rad) between the orientations of two labels (6,)."""
    return float((Rotation.from_rotvec(end[3:]) * Rotation.from_rotvec(start[3:]).inv()).magnitude())


def interpolate(T_a: np.ndarray, T_b: np.ndarray, fraction: float) -> np.ndarray:
    """Return the pose (4, 4) at a fraction (0 to 1) of the straight path from T_a to T_b (4, 4), at a constant turn rate."""
    turn = rotation_of(T_a[:3, :3].T @ T_b[:3, :3]).as_rotvec()
    return matrix(
        T_a[:3, 3] + fraction * (T_b[:3, 3] - T_a[:3, 3]),
        rotation_of(T_a) * Rotation.from_rotvec(fraction * turn),
    )


def angle_between(T_a: np.ndarray, T_b: np.ndarray) -> float:
    """Return the angle (rad) between the orientations of two poses (4, 4)."""
    return float(rotation_of(T_a[:3, :3].T @ T_b[:3, :3]).magnitude())


def shortest_turn(start: np.ndarray, end: np.ndarray) -> Rotation:
    """Return the smallest rotation that turns one unit vector (3,) into another."""
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1 + 1e-12:  # half a turn, about any axis that is square to both
        other = np.eye(3)[np.abs(start).argmin()]
        axis = np.cross(start, other)
        return Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis))
    return Rotation.from_quat([1 + cosine, *axis], scalar_first=True)
