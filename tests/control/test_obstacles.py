"""What is tried at obstacles, and how routes are skipped."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.control.obstacles import Obstacle, Tries
from tactip_twin.control.options import Settings
from tactip_twin.control.routes import EdgePath, Geodesic, PlanarPath
from tactip_twin.sim.pose import from_mm_deg, matrix, sensor_in_contact

UP = [0.0, 0.0, 1.0]


def test_tries_are_on_the_spot_then_farther_and_bounded():
    tries = Tries(Settings(max_recoveries=2, skip_mm=4.0, max_skips=3), can_turn=True)
    chosen = [tries.next("contact lost") for _ in range(9)]
    assert [one.skip_mm for one in chosen] == [None, None, 4, 0, 4, 0, 8, 0, np.inf]
    assert [one.turned for one in chosen] == [False, False, False, True, False, True, False, True, False]


def test_tries_after_a_collision_are_not_on_the_spot():
    assert Tries(Settings(), can_turn=False).next("collision").skip_mm == Settings().skip_mm


def test_tries_evade_a_few_stops_and_collisions_at_a_place():
    tries = Tries(Settings(), can_turn=True)
    assert [tries.evades(0.01) for _ in range(6)] == [True] * 5 + [False]
    assert not tries.evades(0.0115)
    assert tries.evades(0.0125)
    tries.skipped_to(0.0125)
    assert [tries.evades(0.0125) for _ in range(6)] == [True] * 5 + [False]


def test_tries_start_again_after_progress_only():
    tries = Tries(Settings(max_recoveries=1), can_turn=False)
    assert tries.next("contact lost").skip_mm is None
    for mm in (0.5, 1.0, 1.5):
        tries.followed(mm / 1e3)
    assert tries.next("contact lost").skip_mm is not None
    for mm in (2.0, 3.0, 4.0, 5.0):
        tries.followed(mm / 1e3)
    assert tries.next("contact lost").skip_mm is None


def test_tries_without_progress_raise_an_obstacle():
    tries = Tries(Settings(), can_turn=False)
    with pytest.raises(Obstacle, match="moved the tip by less than 2 mm") as raised:
        for _ in range(1000):
            tries.followed(0.0)
    assert raised.value.kind == "no progress"


def test_planar_path_skips_along_its_line_and_to_the_next_part():
    path = PlanarPath([[0, 0, 0], [0.06, 0, 0], [0.06, 0.01, 0], [0, 0.01, 0]], UP)
    T = np.eye(4)
    T[:3, 3] = [0.01, 0.002, 0.3]
    ahead = path.skip(0.004, T)
    assert ahead[:3, 3] == pytest.approx([0.004, 0, 0.3])
    assert path.skip(np.inf, T)[:3, 3] == pytest.approx([0.06, 0, 0.3], abs=1e-5)
    assert path.part == 1
    assert path.skip(np.inf, T)[:3, 3] == pytest.approx([0.06, 0.01, 0.3], abs=1e-5)
    assert path.skip(np.inf, T) is None
    assert path.ended == "route completed"


def test_planar_path_places_of_a_stretch_follow_its_corners():
    path = PlanarPath([[0, 0, 0], [0.01, 0, 0], [0.01, 0.01, 0]], UP)
    places = path.places(np.linspace(0.005, 0.015, 5), np.array([0.0, 0, 0.1]), np.array([0.0, 0, 0.2]))
    assert places[2] == pytest.approx([0.01, 0, 0.15])
    assert places[-1] == pytest.approx([0.01, 0.005, 0.2])


def test_planar_path_on_a_steep_surface_is_an_obstacle():
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # the sensor points along x
    with pytest.raises(Obstacle, match="90 degrees") as raised:
        PlanarPath([[0, 0, 0], [0.1, 0, 0]], UP).direction(T, T)
    assert raised.value.kind == "too steep"


def test_geodesic_and_edge_skip_straight_ahead_and_end():
    T = np.diag([1.0, -1, -1, 1])
    geodesic = Geodesic(0.0, 0.02)
    geodesic.direction(T, T)
    assert geodesic.skip(0.005, T)[:3, 3] == pytest.approx([0.005, 0, 0])
    assert geodesic.skip(0.05, T) is None
    edge = EdgePath()
    edge.direction(T, T)
    assert edge.skip(0.004, T)[:3, 3] == pytest.approx([0, -0.004, 0])
    assert edge.skip(0.004, T)[:3, 3] == pytest.approx([0, -0.008, 0])
    assert edge.skip(np.inf, T)[:3, 3] == pytest.approx([0.004, -0.004, 0])  # round a corner
    assert edge.skip(0.004, T)[:3, 3] == pytest.approx([0.008, -0.004, 0])
    assert edge.skip(np.inf, T) is None
    assert edge.ended == "the edge was not found again within 8 mm"


@pytest.mark.parametrize("backward", [False, True])
def test_edge_skips_along_the_arc_before_the_sensor_leaned(backward):
    """A circle of 60 mm radius, followed for 70 mm, the last 10 mm of them leaning into a gap."""
    radius, sense, edge = 0.06, -1.0 if backward else 1.0, EdgePath(backward)

    def pose(length, lean_deg=0.0):
        angle = sense * length / radius
        frame = matrix(radius * np.array([np.cos(angle), np.sin(angle), 0.0]), Rotation.from_euler("z", angle))
        return frame, frame @ sensor_in_contact(from_mm_deg([0, 0, -3, lean_deg, 0, 0]))

    for length in np.arange(0.0, 0.07, 1e-3):
        frame, T = pose(length, 8.0 * (length > 0.06))
        edge.direction(T, frame)
    skipped = 0.0
    for step in (0.004, 0.004, 0.016):
        skipped += step
        found = edge.skip(step, T)
        expected = pose(0.069 + skipped)[1]
        assert found[:3, :3] == pytest.approx(expected[:3, :3], abs=0.01)
        assert found[:3, 3] == pytest.approx(expected[:3, 3], abs=1e-3)


def test_edge_found_behind_an_obstacle_does_not_lean_far():
    """A tip that hangs in a gap may take the end of the wall for the edge; the route refuses it, and a moderate lean not."""
    edge = EdgePath()

    def pose(y, lean_deg):
        frame = matrix(np.array([0.0, y, 0.0]), Rotation.identity())
        return frame @ sensor_in_contact(from_mm_deg([0, 0, -3, lean_deg, 0, 0])), frame

    for y in np.arange(0.0, 0.04, 1e-3):
        edge.direction(*pose(y, 0.0))
    edge.skip(0.004, pose(0.04, 0.0)[0])
    assert edge.direction(*pose(0.044, 20.0)) is not None
    with pytest.raises(Obstacle, match="what was found leans 40 degrees from the edge before the obstacle"):
        edge.direction(*pose(0.045, 40.0))
    # Without an obstacle before, an edge may lead anywhere.
    steep = EdgePath()
    for y, lean_deg in zip(np.arange(0.0, 0.04, 1e-3), np.linspace(0.0, 60.0, 40), strict=True):
        assert steep.direction(*pose(y, lean_deg)) is not None
