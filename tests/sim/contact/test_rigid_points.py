"""Distances of a rigid set of points, against those of every point."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.rigid_points import RigidPoints
from tactip_twin.sim.fast_tip.overlap import NEAR_M, dome_points
from tactip_twin.sim.pose import matrix
from tactip_twin.sim.robot.objects import load_object


@pytest.mark.parametrize("near_m", [NEAR_M, -np.inf])
@pytest.mark.parametrize("groups", [1, 20, 10_000])
def test_distances_are_exact_where_they_matter_and_lower_bounds_elsewhere(groups, near_m):
    solid, rng = load_object("bust").solid, np.random.default_rng(2)
    points = dome_points(20e-3)
    rigid, left_out = RigidPoints(points, groups), 0
    for _ in range(8):
        start = solid.vertices[rng.integers(len(solid.vertices))] + rng.normal(0, 5e-3, 3)
        T = matrix(start, Rotation.random(rng=rng))
        exact = solid.distance(points @ T[:3, :3].T + T[:3, 3])
        found = rigid.distances(solid.distance, T, near_m)
        # Products of matrices of different sizes round differently.
        assert found.min() == pytest.approx(exact.min(), abs=1e-15)
        assert np.allclose(found[exact <= near_m], exact[exact <= near_m], rtol=0, atol=1e-15)
        assert (found <= exact + 1e-12).all() and (found[exact > near_m] > min(near_m, exact.min()) - 1e-12).all()
        left_out += int((np.abs(found - exact) > 1e-12).sum())
    assert (left_out > 0) == (groups == 20) or groups == 1


@pytest.mark.parametrize("near_m", [NEAR_M, -np.inf])
def test_small_motions_need_few_new_distances(near_m):
    """On a walk over the surface, what is known of the last pose replaces most queries; another object is measured anew."""
    solid, other, points, asked = load_object("bust").solid, load_object("saddle").solid, dome_points(20e-3), []

    def distance(places):
        asked.append(len(places))
        return solid.distance(places)

    rigid, rng, counts = RigidPoints(points, 48), np.random.default_rng(3), []
    top = solid.vertices[solid.vertices[:, 2].argmax()]
    for step in range(10):
        turn = Rotation.from_rotvec(rng.normal(0, 0.02, 3)) * Rotation.from_euler("x", 180, degrees=True)
        T = matrix(top + [0.5e-3 * step, 0, rng.normal(-1e-3, 0.3e-3)], turn)
        exact = solid.distance(points @ T[:3, :3].T + T[:3, 3])
        found, of_all = rigid.distances(distance, T, near_m), len(asked)
        assert found.min() == pytest.approx(exact.min(), abs=1e-15)
        assert np.allclose(found[exact <= near_m], exact[exact <= near_m], rtol=0, atol=1e-15)
        assert (found <= exact + 1e-12).all()
        RigidPoints(points, 48).distances(distance, T, near_m)
        counts.append((sum(asked[:of_all]), sum(asked[of_all:])))
        asked.clear()
    remembered, anew = np.sum(counts[1:], 0)
    assert remembered < 0.9 * anew
    found = rigid.distances(other.distance, T, near_m)
    assert found.min() == pytest.approx(other.distance(points @ T[:3, :3].T + T[:3, 3]).min(), abs=1e-15)


def test_nearest_point_is_exact_or_bounded():
    """On a walk through the air and into the object, most places need no distance at all."""
    solid, points, asked, rng = load_object("bust").solid, dome_points(20e-3)[::4], [], np.random.default_rng(5)

    def distance(places):
        asked.append(len(places))
        return solid.distance(places)

    rigid, T = RigidPoints(points, 20), matrix(solid.vertices[:, :].max(0) + [0, 0, 10e-3], Rotation.random(rng=rng))
    towards, exact, found = solid.vertices.mean(0) - T[:3, 3], [], []
    for _ in range(300):
        T = T @ matrix([0, 0, 0], Rotation.from_rotvec(rng.normal(0, 5e-3, 3)))
        T[:3, 3] += towards / 400
        exact.append(solid.distance(points @ T[:3, :3].T + T[:3, 3]).min())
        found.append(rigid.nearest(distance, T, 1e-3))
    exact, found = np.array(exact), np.array(found)
    assert (found <= exact + 1e-12).all() and ((found > 1e-3) | (abs(found - exact) < 1e-12)).all()
    assert min(exact) < -1e-3 and len(asked) < 200
