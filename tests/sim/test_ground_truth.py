"""True labels on surfaces."""

import numpy as np
import pytest
import trimesh

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact, shortest_turn, to_mm_deg

RADIUS_M = 0.1


@pytest.mark.parametrize("thickness_mm", [0.5, 1.5, 2.5, 4.0, 50.0])
def test_label_on_a_thin_wall_is_that_of_its_near_side(thickness_mm):
    """Pressed 2.2 mm deep, the far side of a thin shell is nearer to the apex, or even behind it; the true label does not
    depend on it."""
    outer = trimesh.creation.icosphere(5, RADIUS_M)
    inner = trimesh.creation.icosphere(5, RADIUS_M - 1e-3 * thickness_mm)
    inner.invert()
    shell = trimesh.util.concatenate([outer, inner])
    truth, rng = SurfaceGroundTruth(SignedDistanceMesh(shell.vertices, shell.faces)), np.random.default_rng(0)
    for _ in range(10):
        label = np.array([0, 0, -2.2, *rng.uniform(-10, 10, 2), 0])
        outward = rng.normal(size=3)
        outward /= np.linalg.norm(outward)
        T = np.eye(4)
        T[:3, :3] = shortest_turn(np.array([0, 0, 1.0]), outward).as_matrix()
        T[:3, 3] = RADIUS_M * outward
        found = to_mm_deg(truth.label(T @ sensor_in_contact(from_mm_deg(label))))
        # Facets of 4 mm lie up to 0.02 mm below the sphere, and bend its normal between them.
        assert abs(found[2] - label[2]) < 0.03
        assert np.abs(found[3:5] - label[3:5]).max() < 0.5


def test_label_and_frame_are_those_of_the_sensor_at_hand():
    """The last sensor's frame is kept. Neither a change of its array, in place, nor of the returned frame must matter."""
    ball = trimesh.creation.icosphere(4, RADIUS_M)
    truth, fresh = (SurfaceGroundTruth(SignedDistanceMesh(ball.vertices, ball.faces)) for _ in range(2))
    sensor = np.eye(4)
    for x_mm, depth_mm in ((0, -1), (20, -1), (0, -1), (0, -3)):
        sensor[:] = sensor_in_contact(from_mm_deg([x_mm, 0, depth_mm, 0, 0, 0]))
        sensor[2, 3] += RADIUS_M
        truth.frame(sensor)[:] = 0.0
        np.testing.assert_array_equal(truth.frame(sensor), fresh.frame(sensor.copy()))
        np.testing.assert_array_equal(truth.label(sensor), fresh.label(sensor.copy()))
        fresh = SurfaceGroundTruth(SignedDistanceMesh(ball.vertices, ball.faces))
