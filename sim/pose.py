"""Frames and labels, said once.

The contact frame F sits on the surface or edge: z is the outward normal, x is square to the edge and points off the
object, y runs along the edge. The sensor frame S has its origin at the apex of the undeformed tip, z out of the tip, x to
the right and y down in the image. At pose zero the tip just touches and faces the object:

        housing                     z_F (outward)
          ║                           │
       ╭──╨──╮                        │    y_F into the page (along the edge)
       ╰──┬──╯  x_S = x_F             └──── x_F
    ▄▄▄▄▄▄│                        the object fills z_F < 0, and x_F < 0 too if it is an edge
    ██████↓ z_S = -z_F

A label is the pose of the sensor in F, of the axes that are parallel to F at zero ("label axes": x right, y up in the
image, z towards the housing): three coordinates of the apex and a rotation vector (axis-angle). Hence

    T_contact_sensor = [R(rotation vector), position] · (half a turn about x)

depth: z, negative into the object; roll, pitch, yaw: the rotation vector's x, y, z. What the image does when one
component alone grows (held by tests/sim/contact/test_labels.py): x: the edge goes left; z falls: pins move outward;
roll: the tip
leans on its image's lower side; pitch: on its right side; yaw: the edge turns clockwise.
"""

import numpy as np
from scipy.spatial.transform import Rotation

FACING = np.diag([1.0, -1.0, -1.0])
"""Label axes in the sensor's frame at pose zero: half a turn about x."""

_T_FACING = np.diag([*np.diag(FACING), 1.0])
_EDGE_UNITS = np.array([1e3] * 3 + [180 / np.pi] * 3)


def to_mm_deg(pose):
    """Poses (..., 6) in m and rad to mm and degrees."""
    return np.asarray(pose, float) * _EDGE_UNITS


def from_mm_deg(pose):
    """Poses (..., 6) in mm and degrees to m and rad."""
    return np.asarray(pose, float) / _EDGE_UNITS


def matrix(position, rotation):
    """The 4×4 of a position (3,) and a scipy Rotation."""
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = position
    return T


def inverse(T):
    """Inverse of a rigid 4×4."""
    R = T[:3, :3].T
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, -R @ T[:3, 3]
    return out


def sensor_in_contact(pose):
    """T_contact_sensor (4, 4) of a label (6,), m and rad."""
    pose = np.asarray(pose, float)
    return matrix(pose[:3], Rotation.from_rotvec(pose[3:])) @ _T_FACING


def label_of(T_contact_sensor):
    """The label (6,), m and rad, of a T_contact_sensor (4, 4)."""
    T = T_contact_sensor @ _T_FACING
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def before_shear(pose, shear):
    """The label (6,) from which a `shear` (6,) leads to `pose` (6,): the paper's "target minus perturbation".

    The shear is the motion of the sensor in the contact frame: its apex moves by the first three components and it turns
    about its apex by the rotation vector of the last three. m and rad.
    """
    pose, shear = np.asarray(pose, float), np.asarray(shear, float)
    turn = Rotation.from_rotvec(-shear[3:]) * Rotation.from_rotvec(pose[3:])
    return np.concatenate([pose[:3] - shear[:3], turn.as_rotvec()])


def shear_between(start, pose):
    """The shear (6,) that leads from label `start` to label `pose`: the inverse of `before_shear`."""
    start, pose = np.asarray(start, float), np.asarray(pose, float)
    turn = Rotation.from_rotvec(pose[3:]) * Rotation.from_rotvec(start[3:]).inv()
    return np.concatenate([pose[:3] - start[:3], turn.as_rotvec()])


def path(start, end, shares):
    """Labels (n, 6) at `shares` (n,), 0 to 1, of the way from label `start` to label `end`: straight, at a steady turn."""
    shares = np.asarray(shares, float)[:, None]
    first = Rotation.from_rotvec(start[3:])
    turn = (Rotation.from_rotvec(end[3:]) * first.inv()).as_rotvec()
    rotation = Rotation.from_rotvec(shares * turn) * first
    return np.concatenate([start[:3] + shares * (end[:3] - start[:3]), rotation.as_rotvec()], 1)


def turn_between(start, end):
    """Angle (rad) between the orientations of labels `start` and `end`."""
    return float((Rotation.from_rotvec(end[3:]) * Rotation.from_rotvec(start[3:]).inv()).magnitude())


def interpolate(T_a, T_b, fraction):
    """The pose (4, 4) at a fraction (0 to 1) of the path from T_a to T_b (4, 4): straight, at a steady turn."""
    turn = Rotation.from_matrix(T_a[:3, :3].T @ T_b[:3, :3]).as_rotvec()
    return matrix(
        T_a[:3, 3] + fraction * (T_b[:3, 3] - T_a[:3, 3]),
        Rotation.from_matrix(T_a[:3, :3]) * Rotation.from_rotvec(fraction * turn),
    )


def angle_between(T_a, T_b):
    """Angle (rad) between the orientations of two poses (4, 4)."""
    return float(Rotation.from_matrix(T_a[:3, :3].T @ T_b[:3, :3]).magnitude())
