"""Poses of the sensor that are moved, or turned towards a direction or away from it."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import matrix, shortest_turn


def moved(T: np.ndarray, direction: np.ndarray | None, by_mm: float) -> np.ndarray:
    """Return a pose (4, 4), moved in a direction (3,) of the base frame, or along the sensor's axis if None."""
    out = T.copy()
    out[:3, 3] += by_mm / 1e3 * (T[:3, 2] if direction is None else direction)
    return out


def tilt_rad(T: np.ndarray, direction: np.ndarray) -> float:
    """Return the angle, rad, between the axis of a pose (4, 4) and a direction (3,)."""
    return float(np.arccos(np.clip(T[:3, 2] @ direction, -1.0, 1.0)))


def tilted_at_most(T: np.ndarray, direction: np.ndarray | None, max_rad: float) -> np.ndarray:
    """Return a pose (4, 4), turned about its apex by the smallest angle, so that its axis is within an angle, rad, of a
    direction (3,); unchanged if that is None."""
    tilt = 0.0 if direction is None else tilt_rad(T, direction)
    if direction is None or tilt <= max_rad:
        return T
    turn = shortest_turn(T[:3, 2], direction).as_rotvec() * (1 - max_rad / tilt)
    return matrix(T[:3, 3], Rotation.from_rotvec(turn) * Rotation.from_matrix(T[:3, :3]))


def turned_away(T: np.ndarray, direction: np.ndarray, min_rad: float) -> np.ndarray:
    """Return a pose (4, 4), turned about its apex by the smallest angle, so that its housing, which is behind the apex, is
    at least at an angle, rad, to a direction (3,)."""
    angle = np.pi - tilt_rad(T, direction)
    if angle >= min_rad:
        return T
    turn = shortest_turn(-T[:3, 2], -direction).as_rotvec() * (min_rad - angle) / (np.pi - angle)
    return matrix(T[:3, 3], Rotation.from_rotvec(turn) * Rotation.from_matrix(T[:3, :3]))
