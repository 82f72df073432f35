"""The limit of the press by force: a closed form, and a controller that presses on a spring."""

import numpy as np
import pytest

from tactip_twin.control.press import press_room_m
from tactip_twin.control.servo import Gains, Servo
from tactip_twin.sim.pose import from_mm_deg


@pytest.mark.parametrize(
    ("force_n", "room_mm"), [(None, np.inf), (0.0, 4 / 3), (1.4, 0.4), (2.0, 0.0), (2.3, -0.2), (4.5, -0.7)]
)
def test_press_room_is_what_the_force_leaves(force_n, room_mm):
    assert 1e3 * press_room_m(force_n, 2.0) == pytest.approx(room_mm)


def press_on_spring(steps, n_per_mm, seen_mm, ease_force_n):
    """Return depths (steps,), mm, of a servo that keeps 2 mm on a spring: seen_mm(k, depth) is what its image shows."""
    servo, depth_mm, out = Servo(Gains(), 2.0), 0.0, []
    for k in range(steps):
        room_m = press_room_m(max(0.0, n_per_mm * depth_mm), ease_force_n)
        label = from_mm_deg([0, 0, -seen_mm(k, depth_mm), 0, 0, 0])
        depth_mm += 1e3 * servo.move(label, max_press_m=room_m)[2, 3]
        out.append(depth_mm)
    return np.array(out)


@pytest.mark.parametrize("n_per_mm", [0.4, 1.0, 1.5, 2.0])
def test_press_force_stays_at_its_limit_however_shallow_the_image_looks(n_per_mm):
    """Up to the assumed stiffness there is no overshoot; a spring a third stiffer is overshot by a third of a step."""
    force = n_per_mm * press_on_spring(60, n_per_mm, lambda k, depth: 0.3, 2.0)
    assert force.max() <= 2.0 + 1e-9 + (n_per_mm > 1.5) * 2.0 / 3
    assert force[-1] == pytest.approx(2.0, abs=0.25)


def test_press_returns_to_the_depth_without_windup():
    """Between flanks for 40 steps the image looks shallow; after them it is right, and the tip moves back at once."""
    depth = press_on_spring(100, 1.0, lambda k, depth: 0.3 if 20 <= k < 60 else depth, 3.0)
    assert depth[15:20] == pytest.approx(np.full(5, 2.0), abs=0.15)
    assert depth[59] == pytest.approx(3.0, abs=0.1)
    assert depth[60] < depth[59] - 0.3
    assert depth[63] < 2.2
    assert depth[60:].min() > 1.4
    assert depth[-5:] == pytest.approx(np.full(5, 2.0), abs=0.15)
