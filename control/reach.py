"""Which parts of an object the fingertip can touch: for scores and pictures; the controller does not know it.

The tip is a ball that may lie in the object by the commanded depth, with its housing behind it. A point can be touched if
such a ball covers it with the housing clear of the object, so the part that can be touched is a closing of the object by the
tip.
The tip fits at a point if it can also stand square on it, at the commanded depth and with its flanks no deeper.
"""

import numpy as np

from tactip_twin.sim.contact.rigid_points import RigidPoints
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import matrix, shortest_turn
from tactip_twin.sim.robot.irb120 import housing_points

_DIRECTIONS = 300
"""Number of directions from a point to the centre of a ball that are tried."""

_MAX_SLOPE_COSINE = 0.2
"""Smallest cosine between such a direction and the normal, -."""

_DEPTHS = (0.0, 0.5, 1.0)
"""Depths of the point in the ball that are tried, as fractions of the commanded depth."""

_MAX_BALLS = 12
"""Maximum number of balls per point for which the housing is checked, those with most room first."""

_POLAR_RAD, _AZIMUTHS = np.radians([0.0, 25.0, 50.0]), 12
"""Angles between the sensor's axis and the direction of the touched point that are tried, rad, and the number of axes at
each but the first: pins farther from the axis hardly move [?]."""

_HOUSING_RINGS, _HOUSING_SIDES = 10, 32
"""Points on the housing."""

_HOUSING_GROUPS = 16
"""Number of groups of the points on the housing; it changes the time alone [M]."""

_SLACK_M = 0.2e-3
"""Distance by which a ball may lie deeper, m, because only some directions are tried."""


def touchable(solid: SignedDistanceMesh, points: np.ndarray, radius_m: float, depth_m: float) -> np.ndarray:
    """Return whether each point (n, 3), m, on a solid can be touched, (n,) bool.

    Args:
        solid: The object.
        points: In its frame.
        radius_m: Radius of the dome, m.
        depth_m: Commanded depth, m.
    """
    housing = _housing(radius_m)
    normals = solid.smooth_normal(points)
    out = np.zeros(len(points), bool)
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        directions = _DIRECTION_SET[_DIRECTION_SET @ normal > _MAX_SLOPE_COSINE]
        away = np.concatenate([(radius_m - f * depth_m) * directions for f in _DEPTHS])
        room = solid.distance(point + away) - (radius_m - depth_m)
        best = [i for i in np.argsort(-room)[:_MAX_BALLS] if room[i] >= -_SLACK_M]
        out[k] = any(_has_room(solid, point + away[i], -away[i], housing, radius_m) for i in best)
    return out


def fits(solid: SignedDistanceMesh, places: np.ndarray, radius_m: float, depth_m: float) -> np.ndarray:
    """Return whether the tip can stand square on each place (n, 3), m, on a solid, (n,) bool. The other parameters are those
    of `touchable`."""
    normals = solid.smooth_normal(places)
    centers = places + (radius_m - depth_m) * normals
    out = solid.distance(centers) >= radius_m - depth_m - _SLACK_M
    housing = _housing(radius_m)
    for k in np.flatnonzero(out):
        out[k] = _clear(solid, centers[k], -normals[k], housing, radius_m)
    return out


def _has_room(
    solid: SignedDistanceMesh, center: np.ndarray, towards: np.ndarray, housing: RigidPoints, radius_m: float
) -> bool:
    """Return whether the housing is clear for one of some axes around the direction (3,) from a ball's centre to a point."""
    turn = shortest_turn(np.array([0.0, 0.0, 1.0]), towards / np.linalg.norm(towards)).as_matrix()
    azimuth = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    for polar in _POLAR_RAD:
        for a in azimuth[: None if polar else 1]:
            axis = turn @ [np.sin(polar) * np.cos(a), np.sin(polar) * np.sin(a), np.cos(polar)]
            if _clear(solid, center, axis, housing, radius_m):
                return True
    return False


def _housing(radius_m: float) -> RigidPoints:
    """Return the points on the housing behind a dome of a radius, m."""
    return RigidPoints(housing_points(radius_m, _HOUSING_RINGS, _HOUSING_SIDES), _HOUSING_GROUPS)


def _clear(solid: SignedDistanceMesh, center: np.ndarray, axis: np.ndarray, housing: RigidPoints, radius_m: float) -> bool:
    """Return whether the housing is outside of the object, for a dome with a centre (3,) and an axis (3,)."""
    turn = shortest_turn(np.array([0.0, 0.0, 1.0]), axis)
    T_object_sensor = matrix(center + radius_m * axis, turn)
    return bool(housing.distances(solid.distance, T_object_sensor, -np.inf).min() >= 0)


def _spread(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) that are spread evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], 1)


_DIRECTION_SET = _spread(2 * _DIRECTIONS)
