"""Poses of the sensor that are moved or turned."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.control.sensor_poses import moved, tilt_rad, tilted_at_most, turned_away
from tactip_twin.sim.pose import matrix

DOWN = np.array([0.0, 0.0, -1.0])


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return matrix(rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3)))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("max_deg", [0.0, 5.0, 40.0, 180.0])
def test_tilted_at_most_turns_by_the_smallest_angle(seed, max_deg):
    T, max_rad = random_pose(seed), np.radians(max_deg)
    out = tilted_at_most(T, DOWN, max_rad)
    before = tilt_rad(T, DOWN)
    assert tilt_rad(out, DOWN) == pytest.approx(min(before, max_rad), abs=1e-6)
    assert np.array_equal(out[:3, 3], T[:3, 3])
    turn = Rotation.from_matrix(out[:3, :3] @ T[:3, :3].T).magnitude()
    assert turn == pytest.approx(max(0.0, before - max_rad), abs=1e-6)


def test_tilted_at_most_without_a_direction_leaves_the_pose():
    T = random_pose(0)
    assert tilted_at_most(T, None, 0.0) is T


def test_moved_along_a_direction_or_the_axis():
    T = random_pose(0)
    assert moved(T, DOWN, 2.0)[:3, 3] == pytest.approx(T[:3, 3] + [0, 0, -2e-3])
    assert moved(T, None, 2.0)[:3, 3] == pytest.approx(T[:3, 3] + 2e-3 * T[:3, 2])
    assert np.array_equal(moved(T, None, 2.0)[:3, :3], T[:3, :3])


def test_housing_is_turned_away_by_the_smallest_angle():
    rng = np.random.default_rng(3)
    for _ in range(50):
        T, direction, least = (
            matrix(rng.normal(0, 0.1, 3), Rotation.random(rng=rng)),
            rng.normal(size=3),
            rng.uniform(0, np.pi),
        )
        direction /= np.linalg.norm(direction)
        before = np.arccos(np.clip(-T[:3, 2] @ direction, -1, 1))
        out = turned_away(T, direction, least)
        after = np.arccos(np.clip(-out[:3, 2] @ direction, -1, 1))
        turned = Rotation.from_matrix(out[:3, :3] @ T[:3, :3].T).magnitude()
        assert np.array_equal(out[:3, 3], T[:3, 3])
        assert after == pytest.approx(max(before, least), abs=1e-6)
        assert turned == pytest.approx(max(0.0, least - before), abs=1e-6)
