"""Effect of each label component on the image; shear drags the pins, saturates and needs friction."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


def field(contact, press):
    """Return image displacements (p, 2) of the pins and their neutral positions (p, 2), px of 256, x right, y down."""
    lens = Lens(press.simulator.scene.design)
    neutral = lens.project(press.simulator.reader.pin_tips) - lens.centre + 0.5
    return (lens.project(contact.pin_tips) - lens.centre + 0.5 - neutral) * 256 / lens.width, neutral * 256 / lens.width


def pressed_position(contact, press):
    """Return the mean position (2,) px of the pins, weighted by the square of their motion towards the camera."""
    _, neutral = field(contact, press)
    inward = np.maximum(press.simulator.reader.pin_tips[:, 2] - contact.pin_tips[:, 2], 0) ** 2
    return (inward[:, None] * neutral).sum(0) / inward.sum()


def outward(contact, press):
    moved, neutral = field(contact, press)
    r = np.linalg.norm(neutral, axis=1, keepdims=True)
    return float(((moved * neutral).sum(1) / np.maximum(r[:, 0], 1e-9))[r[:, 0] > 1].mean())


def test_depth_moves_pins_outward(on_surface):
    spread = [outward(on_surface([0, 0, -d, 0, 0, 0]), on_surface) for d in (1, 2, 3, 4, 5)]
    assert spread[0] > 0.3
    assert (np.diff(spread) > 0.3).all()


def test_roll_presses_the_lower_side_of_the_image(on_surface):
    up = pressed_position(on_surface([0, 0, -3, -12, 0, 0]), on_surface)
    down = pressed_position(on_surface([0, 0, -3, 12, 0, 0]), on_surface)
    assert down[1] > 10
    assert up[1] < -10
    assert abs(down[0]) < 3


def test_pitch_presses_the_right_side_of_the_image(on_surface):
    left = pressed_position(on_surface([0, 0, -3, 0, -12, 0]), on_surface)
    right = pressed_position(on_surface([0, 0, -3, 0, 12, 0]), on_surface)
    assert right[0] > 10
    assert left[0] < -10
    assert abs(right[1]) < 3


def test_x_moves_the_edge_to_the_left(on_edge):
    """The object lies to the left of its edge, so the farther the sensor is off it, the farther left the contact is."""
    positions = [pressed_position(on_edge([x, 0, -3, 0, 0, 0]), on_edge)[0] for x in (-4, 0, 4)]
    assert (np.diff(positions) < -5).all()


def test_yaw_turns_the_edge_clockwise(on_edge):
    """The field under a yawed edge is that of a straight one, rotated clockwise (by plus yaw, as y is down)."""
    straight = pressed_position(on_edge([0, 0, -3, 0, 0, 0]), on_edge)
    for yaw in (-40, -20, 20, 40):
        position = pressed_position(on_edge([0, 0, -3, 0, 0, yaw]), on_edge)
        expected = np.degrees(np.arctan2(*straight[::-1])) + yaw
        error = (np.degrees(np.arctan2(*position[::-1])) - expected + 180) % 360 - 180
        assert abs(error) < 6


def test_pose_far_off_edge_has_no_contact(on_edge):
    contact = on_edge([25, 0, -3, 0, 0, 0])
    assert contact.normal_force_n == 0
    assert np.abs(contact.pin_tips - on_edge.simulator.reader.pin_tips).max() < 5e-6


@pytest.mark.parametrize("direction_deg", [0, 90, 200])
def test_shear_drags_the_pins_along(on_surface, direction_deg):
    """The stimulus is fixed and the sensor moves, so pins lag behind, against the shear in the image."""
    a = np.radians(direction_deg)
    shear = np.array([3 * np.cos(a), 3 * np.sin(a)])
    contact = on_surface([0, 0, -3, 0, 0, 0], [*shear, 0, 0, 0, 0])
    still = on_surface([0, 0, -3, 0, 0, 0])
    moved = (field(contact, on_surface)[0] - field(still, on_surface)[0]).mean(0)
    lag = -np.array([shear[0], -shear[1]])  # label axes have y up, the image has y down
    angle = np.degrees(np.arccos(moved @ lag / np.linalg.norm(moved) / np.linalg.norm(lag)))
    assert np.linalg.norm(moved) > 0.8
    assert angle < 10


def mean_shift(press, shear_mm):
    contact = press([0, 0, -3, 0, 0, 0], [shear_mm, 0, 0, 0, 0, 0])
    still = press([0, 0, -3, 0, 0, 0])
    return -(field(contact, press)[0] - field(still, press)[0])[:, 0].mean()


def test_shear_saturates_when_skin_slides(on_surface):
    shift = [mean_shift(on_surface, s) for s in (0.25, 0.5, 1, 3, 4, 5)]
    assert shift[0] < shift[1] < shift[2]
    plateau = np.mean(shift[3:])
    assert np.abs(np.array(shift[3:]) / plateau - 1).max() < 0.15
    # Skin that sticks throughout would reach 5 / 0.25 of the first shift.
    assert plateau < 0.3 * 5 / 0.25 * shift[0]


def test_shear_without_friction_has_no_effect(on_ice):
    assert abs(mean_shift(on_ice, 5)) < 0.05
    assert on_ice([0, 0, -3, 0, 0, 0], [5, 0, 0, 0, 0, 0]).tangential_force_n < 1e-9


def test_two_shears_to_one_pose_give_different_images(on_surface, design):
    """The network must be insensitive to this difference, because the label is the same."""
    pose = [0, 0, -3.5, 5, -5, 0]
    a = on_surface(pose, [4, 0, 0, 0, 0, 0])
    b = on_surface(pose, [-4, 2, 0, 0, 0, 5])
    assert (a.pose == b.pose).all()
    raster = Raster(design)
    images = [tactile_image(raster.render(c.pin_tips, c.directions), design.image) for c in (a, b)]
    assert (images[0] != images[1]).mean() > 0.01


def test_shear_about_normal_twists_pins(on_surface):
    contact = on_surface([0, 0, -4, 0, 0, 0], [0, 0, 0, 0, 0, 5])
    moved, neutral = field(contact, on_surface)
    near = np.linalg.norm(neutral, axis=1) < 30
    twist = (neutral[near, 0] * moved[near, 1] - neutral[near, 1] * moved[near, 0]).mean()
    # The sensor turns counter-clockwise in the image (y up) and the sticking skin lags clockwise: positive with y down.
    assert twist > 5
    assert Rotation.from_rotvec(contact.shear[3:]).magnitude() == pytest.approx(np.radians(5))
