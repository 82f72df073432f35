"""Frames: inverses, conventions, and the path of a motion."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import (
    before_shear,
    from_mm_deg,
    inverse,
    label_of,
    path,
    sensor_in_contact,
    shortest_turn,
    to_mm_deg,
    turn_between,
)

component = st.floats(-1, 1)
labels = st.lists(component, min_size=6, max_size=6).map(np.array)


@given(labels)
def test_label_of_inverts_sensor_in_contact(label):
    assert np.allclose(label_of(sensor_in_contact(label)), label, atol=1e-9)


@given(labels)
def test_inverse_times_transform_is_identity(label):
    T = sensor_in_contact(label)
    assert np.allclose(T @ inverse(T), np.eye(4), atol=1e-12)


@given(labels, labels)
def test_shortest_turn_is_square_to_both_directions(one, other):
    start, end = (sensor_in_contact(label)[:3, 2] for label in (one, other))
    for goal in (end, start, -start):
        turn = shortest_turn(start, goal)
        assert np.allclose(turn.apply(start), goal, atol=1e-6)
        assert turn.magnitude() <= np.arccos(np.clip(start @ goal, -1, 1)) + 1e-6


@given(labels)
def test_units_round_trip(label):
    assert np.allclose(from_mm_deg(to_mm_deg(label)), label)


@given(labels, labels)
def test_shear_leads_from_start_to_pose(pose, shear):
    """The motion from the start to the pose is the shear, in translation and in rotation."""
    start = before_shear(pose, shear)
    assert np.allclose(start[:3] + shear[:3], pose[:3])
    turned = Rotation.from_rotvec(shear[3:]) * Rotation.from_rotvec(start[3:])
    assert np.allclose(turned.as_matrix(), Rotation.from_rotvec(pose[3:]).as_matrix(), atol=1e-9)


@given(labels, labels)
def test_path_leads_from_start_to_end_at_constant_turn_rate(start, end):
    labels = path(start, end, [0, 0.25, 0.5, 1])
    assert np.allclose(labels[0], start, atol=1e-9)
    assert np.allclose(labels[-1][:3], end[:3])
    whole = turn_between(start, end)
    assert np.isclose(turn_between(start, labels[1]), 0.25 * whole, atol=1e-7)
    assert np.isclose(turn_between(labels[2], end), 0.5 * whole, atol=1e-7)


def test_sensor_frame_at_pose_zero_faces_object():
    """z points into the object, x to the right and y down, where label axes have y up."""
    T = sensor_in_contact(np.zeros(6))
    assert np.allclose(T[:3, :3], np.diag([1, -1, -1]))


def test_depth_is_negative_into_object():
    assert sensor_in_contact(from_mm_deg([0, 0, -3, 0, 0, 0]))[2, 3] == -3e-3
