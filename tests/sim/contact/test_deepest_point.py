"""The search for the deepest point of a mesh: closed forms, its error, and that it leaves out what cannot matter."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.deepest_point import deepest_m
from tactip_twin.sim.contact.stimuli import StraightEdge

ERROR_M = 5e-6


def sheet(count, width_m=0.02):
    """Return vertices and triangles of a flat square sheet around the origin, with count × count pairs of triangles."""
    line = np.linspace(-width_m / 2, width_m / 2, count + 1)
    x, y = np.meshgrid(line, line)
    first = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    lower = np.stack([first, first + 1, first + count + 1], 1)
    upper = np.stack([first + 1, first + count + 2, first + count + 1], 1)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1), np.concatenate([lower, upper])


@pytest.mark.parametrize("convex", [False, True])
@pytest.mark.parametrize("radius_m", [0.3e-3, 1e-3, 5e-3])
@pytest.mark.parametrize("height", [-0.8, 0.9, 1.0, 1.1])
def test_deepest_point_in_ball_is_below_its_centre(radius_m, height, convex):
    """A ball between the vertices of triangles of 2 mm, wherever it is. Its depth is curved as a ball of the radius at which
    the sheet lies."""
    vertices, triangles = sheet(10)
    spacing_m = np.sqrt(6 * ERROR_M * abs(height) * radius_m)
    for seed in range(10):
        centre = np.append(np.random.default_rng(seed).uniform(-8e-3, 8e-3, 2), height * radius_m)
        found = deepest_m(
            lambda p, c=centre: radius_m - np.linalg.norm(p - c, axis=1), vertices, triangles, spacing_m, ERROR_M, convex
        )
        exact = max(0.0, radius_m - abs(height) * radius_m)
        assert exact - ERROR_M <= found <= exact + 1e-12


def test_deepest_point_of_wavy_solid_is_that_of_dense_samples():
    vertices, triangles = sheet(8)

    def depth(points):
        """Depth below waves of 0.2 mm and less, whose slope is below one."""
        x, y = 1e3 * points[:, 0], 1e3 * points[:, 1]
        return 0.1e-3 * np.sin(2 * x + 1) * np.cos(1.5 * y) + 0.1e-3 * np.sin(3 * y - x)

    fine, _ = sheet(1000)
    found = deepest_m(depth, vertices, triangles, 0.05e-3, ERROR_M)
    assert abs(found - depth(fine).max()) < ERROR_M


def test_deepest_point_is_searched_only_where_it_may_be():
    """A plane that leans by 30 degrees: its depth at the vertices says where."""
    vertices, triangles = sheet(20)
    asked = []

    def depth(points):
        asked.append(len(points))
        return 0.5 * points[:, 0] - 4e-3

    assert deepest_m(depth, vertices, triangles, 0.05e-3, ERROR_M) == pytest.approx(1e-3)
    all_samples = len(triangles) * (1e-3 / 0.05e-3) ** 2 / 2
    assert sum(asked) < all_samples / 5


def test_deepest_point_outside_is_zero_after_one_look():
    vertices, triangles = sheet(5)
    looks = []
    assert deepest_m(lambda p: looks.append(1) or np.full(len(p), -0.05), vertices, triangles, 0.1e-3, ERROR_M) == 0.0
    assert len(looks) == 1


@pytest.mark.parametrize("turn_deg", [0, 20, 45, 90])
@pytest.mark.parametrize("lean_deg", [-10, 0, 5, 40])
def test_deepest_point_over_an_edge_is_the_same_with_tangents(turn_deg, lean_deg):
    """A block whose edge crosses the sheet. Where the sheet lies flat on it, tangents leave out what touches its top."""
    vertices, triangles = sheet(10)
    edge, turn = StraightEdge(), Rotation.from_euler("zy", [turn_deg, lean_deg], degrees=True)
    found, asked = {}, {False: 0, True: 0}
    for convex in asked:

        def depth(points, convex=convex):
            asked[convex] += len(points)
            return 0.25e-3 - edge.distance(turn.apply(points) - [0.2e-3, 0, -0.2e-3])

        found[convex] = deepest_m(depth, vertices, triangles, 0.1e-3, ERROR_M, convex)
    assert abs(found[True] - found[False]) < ERROR_M
    assert lean_deg != 0 or asked[True] < asked[False] / 3
