"""The limit of the press by force: closed forms, and a controller that presses on a spring."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.control.press import Press
from tactip_twin.control.servo import Gains, Servo
from tactip_twin.sim.pose import from_mm_deg, matrix


def motion(z_mm):
    return matrix(np.array([1e-3, -2e-3, 1e-3 * z_mm]), Rotation.from_rotvec([0.01, 0.02, 0]))


@pytest.mark.parametrize("force_n, allowed_mm", [(0.0, 4 / 3), (1.4, 0.4), (2.0, 0.0), (2.3, -0.2), (4.5, -0.7)])
def test_press_motion_is_limited_by_what_the_force_leaves(force_n, allowed_mm):
    limited = Press(2e-3, 2.0).motion(motion(2.0), force_n)
    assert 1e3 * limited[2, 3] == pytest.approx(allowed_mm)
    rest = motion(2.0)
    rest[2, 3] = limited[2, 3]
    assert np.array_equal(limited, rest)


@pytest.mark.parametrize(("z_mm", "force_n"), [(0.3, 1.4), (-1.5, 1.4), (5.0, None)])
def test_press_smaller_motion_or_one_without_an_estimate_of_the_force_stays(z_mm, force_n):
    assert np.array_equal(Press(2e-3, 2.0).motion(motion(z_mm), force_n), motion(z_mm))
    label = from_mm_deg([0, 0, -2.0 + z_mm, 3, 4, 0])
    assert np.array_equal(Press(2e-3, 2.0).label(label, force_n), label)


def press_on_spring(steps, n_per_mm, seen_mm, press):
    """Return depths (steps,), mm, of a servo that keeps 2 mm on a spring: seen_mm(k, depth) is what its image shows."""
    servo, depth_mm, out = Servo(Gains(), 2.0), 0.0, []
    for k in range(steps):
        force_n = max(0.0, n_per_mm * depth_mm)
        label = press.label(from_mm_deg([0, 0, -seen_mm(k, depth_mm), 0, 0, 0]), force_n)
        depth_mm += 1e3 * press.motion(servo.move(label), force_n)[2, 3]
        out.append(depth_mm)
    return np.array(out)


@pytest.mark.parametrize("n_per_mm", [0.4, 1.0, 1.5, 2.0])
def test_press_force_stays_at_its_limit_however_shallow_the_image_looks(n_per_mm):
    """Up to the assumed stiffness there is no overshoot; a spring a third stiffer is overshot by a third of a step."""
    force = n_per_mm * press_on_spring(60, n_per_mm, lambda k, depth: 0.3, Press(2e-3, 2.0))
    assert force.max() <= 2.0 + 1e-9 + (n_per_mm > 1.5) * 2.0 / 3
    assert force[-1] == pytest.approx(2.0, abs=0.25)


def test_press_returns_to_the_depth_without_windup():
    """Between flanks for 40 steps the image looks shallow; after them it is right, and the tip must not plunge."""
    depth = press_on_spring(100, 1.0, lambda k, depth: 0.3 if 20 <= k < 60 else depth, Press(2e-3, 2.5))
    assert depth[15:20] == pytest.approx(np.full(5, 2.0), abs=0.15)
    assert depth[60:].max() < 2.6
    assert depth[-5:] == pytest.approx(np.full(5, 2.0), abs=0.15)
