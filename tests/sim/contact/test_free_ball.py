"""A free ball between the tip and a table, against what a rolling ball does."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.free_ball import GRAVITY_M_S2, FreeBall
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.free_ball_tip import FreeBallTip

RADIUS_M, DEPTH_M = 5e-3, 2e-3


def above(x, height):
    """Return the pose of a sensor that points down, its apex at x and a height, m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([-1.0, 1, -1]), [x, 0, height]
    return T


@pytest.fixture(scope="module")
def tip(design):
    return FreeBallTip(design, FreeBall(RADIUS_M), fidelity_named("draft"), arm_model_named("none"), 0.8)


def pressed(tip):
    tip.put_ball([0.0, 0.0])
    tip.reset_to(above(0.0, 2 * RADIUS_M + 1e-3))
    return tip.go(above(0.0, 2 * RADIUS_M - DEPTH_M))


def test_ball_that_nothing_touches_rests_on_the_table(tip):
    tip.put_ball([0.0, 0.0])
    tip.reset_to(above(0.0, 2 * RADIUS_M + 3e-3))
    for _ in range(3):
        tip.go(above(0.0, 2 * RADIUS_M + 2e-3))
    assert tip.T_base_object[2, 3] == pytest.approx(RADIUS_M, abs=20e-6)
    assert np.allclose(tip.T_base_object[:2, 3], 0, atol=1e-6)
    table = (tip.scene.data.contact.geom == tip.scene.model.geom("table").id).any(1)
    row = tip.scene.data.contact.efc_address[table]
    assert tip.scene.data.efc_force[row].sum() == pytest.approx(GRAVITY_M_S2 * tip.ball.mass_kg, rel=0.2)


def test_ball_rolls_about_half_as_far_as_the_tip(tip):
    """Exactly half under a rigid plate; under soft skin, which wraps around it, somewhat less."""
    pressed(tip)
    before = tip.T_base_object
    for k in range(1, 4):
        state = tip.go(above(1e-3 * k, 2 * RADIUS_M - DEPTH_M))
    moved = tip.T_base_object[:3, 3] - before[:3, 3]
    assert 0.38 < moved[0] / 3e-3 < 0.52
    assert abs(moved[1]) < 0.05e-3
    turn = Rotation.from_matrix(tip.T_base_object[:3, :3] @ before[:3, :3].T).as_rotvec()
    assert turn[1] == pytest.approx(moved[0] / RADIUS_M, rel=0.06)  # without slipping on the table
    assert np.linalg.norm(state.force[:2]) < 0.1 * abs(state.force[2])  # rolling takes no force


def test_episode_does_not_depend_on_earlier_ones(tip):
    first = pressed(tip)
    tip.go(above(2e-3, 2 * RADIUS_M - DEPTH_M))
    again = pressed(tip)
    assert np.array_equal(first.pin_tips, again.pin_tips) and np.array_equal(first.force, again.force)
