"""What of an object the fingertip can touch: for scores and pictures; the controller does not know it.

A point can be touched if a dome that lies no deeper in the object than the commanded depth covers it, with its housing clear
of the object. So the part that can be touched is a closing of the object by the tip.
"""

import numpy as np

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import shortest_turn
from tactip_twin.sim.robot.irb120 import housing_points

_DIRECTIONS = 150
"""Number of directions from a point to the middle of a dome that are tried."""

_AXES = 12
"""Number of axes of the sensor that are tried for each dome."""

_MAX_POLAR_RAD = np.radians(50.0)
"""Largest angle at the dome's middle between the sensor's axis and a touched point, rad: pins beyond hardly move [?]."""


def touchable(solid: SignedDistanceMesh, points: np.ndarray, radius_m: float, depth_m: float) -> np.ndarray:
    """Return whether each point (n, 3), m, on a solid can be touched, (n,) bool.

    Args:
        solid: The object.
        points: In its frame.
        radius_m: Radius of the dome, m.
        depth_m: Commanded depth, m.
    """
    directions = _spread(_DIRECTIONS)
    housing = housing_points(radius_m)
    out = np.zeros(len(points), bool)
    for k, point in enumerate(points):
        middles = point + radius_m * directions
        free = np.flatnonzero(solid.distance(middles) >= radius_m - depth_m - _SLACK_M)
        out[k] = any(_has_room(solid, middles[i], -directions[i], housing, radius_m) for i in free)
    return out


_SLACK_M = 0.2e-3
"""Distance by which a dome may lie deeper, m, because only some directions are tried."""


def _has_room(
    solid: SignedDistanceMesh, middle: np.ndarray, towards: np.ndarray, housing: np.ndarray, radius_m: float
) -> bool:
    """Return whether the housing is clear for one of some axes around the direction (3,) from a dome's middle to a point."""
    turn = shortest_turn(np.array([0.0, 0.0, 1.0]), towards).as_matrix()
    azimuth = 2 * np.pi * np.arange(_AXES) / _AXES
    cone = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    for polar in (0.0, 0.5 * _MAX_POLAR_RAD, _MAX_POLAR_RAD):
        for around in cone[: 1 if polar == 0 else None]:
            axis = turn @ (np.cos(polar) * np.array([0.0, 0.0, 1.0]) + np.sin(polar) * around)
            places = middle + radius_m * axis + housing @ shortest_turn(np.array([0.0, 0.0, 1.0]), axis).as_matrix().T
            if solid.distance(places).min() >= 0:
                return True
    return False


def _spread(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) that are spread evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], 1)
