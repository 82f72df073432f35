"""Kinematics of the arm against its chain of joints, poses that are refused, and the arm models."""

from typing import get_args

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.pose import interpolate, matrix
from tactip_twin.sim.robot.arm_models import ARM_MODELS, DynamicArm, KinematicArm, arm_model_named
from tactip_twin.sim.robot.arm_names import ArmName
from tactip_twin.sim.robot.irb120 import (
    APEX_FROM_FLANGE_M,
    MAX_SPEEDS_RAD_S,
    MIN_SINGULAR_VALUE,
    READY_RAD,
    Arm,
    Unreachable,
)
from tactip_twin.tactip_model.errors import TactipError

DOWN = Rotation.from_rotvec([0, np.pi, 0])


@pytest.fixture(scope="module")
def arm():
    return Arm()


def chain(angles):
    """Return T_base_tcp from the table of joints alone: origins and axes from ABB's data."""
    origins = [[0, 0, 0], [0, 0, 0.29], [0, 0, 0.27], [0, 0, 0.07], [0.302, 0, 0], [0.072, 0, 0]]
    T = np.eye(4)
    for origin, axis, angle in zip(origins, "zyyxyx", angles, strict=True):
        T = T @ matrix(origin, Rotation.from_euler(axis, angle))
    return (
        T @ matrix([0, 0, 0], Rotation.from_euler("y", 90, degrees=True)) @ matrix([0, 0, APEX_FROM_FLANGE_M], DOWN * DOWN)
    )


def test_forward_kinematics_are_the_chain_s(arm):
    for angles in np.random.default_rng(0).uniform(*arm.limits.T, (50, 6)):
        assert np.allclose(arm.forward(angles), chain(angles), atol=1e-12)


def test_jacobian_is_derivative_of_forward_kinematics(arm):
    h = 1e-6
    for angles in np.random.default_rng(1).uniform(*arm.limits.T, (5, 6)):
        slope = np.empty((6, 6))
        for k in range(6):
            a, b = (arm.forward(angles + s * h * np.eye(6)[k]) for s in (-1, 1))
            slope[:3, k] = (b[:3, 3] - a[:3, 3]) / (2 * h)
            slope[3:, k] = Rotation.from_matrix(b[:3, :3] @ a[:3, :3].T).as_rotvec() / (2 * h)
        assert np.allclose(arm.jacobian(angles), slope, atol=1e-8)


def test_inverse_kinematics_come_back_to_the_pose_within_all_limits(arm):
    rng = np.random.default_rng(2)
    for _ in range(20):
        angles = READY_RAD + rng.uniform(-0.6, 0.6, 6)
        found = arm.solve_near(arm.forward(angles), np.clip(angles + rng.normal(0, 0.1, 6), *arm.limits.T))
        assert np.allclose(arm.forward(found), arm.forward(angles), atol=2e-5)
        assert arm.limit_margin(found) >= -1e-9


def test_inverse_kinematics_converge_from_any_start(arm):
    for place in ([0.38, 0, 0.05], [0.3, 0.2, 0.1], [0.45, -0.2, 0.02]):
        T = matrix(place, DOWN)
        assert np.allclose(arm.forward(arm.solve(T)), T, atol=2e-5)


@pytest.mark.parametrize("wrist_deg", [-180, 0, 180])
def test_joint_6_begins_where_it_has_room_to_turn(arm, wrist_deg):
    """A loop around a rim turns it once: it starts within half a turn of the desired angle and stays within its limits."""
    for yaw in np.radians([0, 100, 179, -90]):
        T = matrix([0.38, 0, 0.1], DOWN * Rotation.from_euler("z", yaw))
        found = arm.solve(T, np.radians(wrist_deg))
        assert np.allclose(arm.forward(found), T, atol=2e-5)
        assert abs(found[5] - np.radians(wrist_deg)) <= np.pi + 0.1
        assert arm.limit_margin(found) > 0


def test_unreachable_target_is_refused_before_motion(arm):
    with pytest.raises(Unreachable, match="stays 1"):
        arm.solve(matrix([0.7, 0, 0.1], DOWN))
    model = KinematicArm()
    model.reset_to(matrix([0.4, 0, 0.1], DOWN))
    before = model.pose.copy()
    with pytest.raises(Unreachable):
        model.set_target(matrix([0.9, 0, 0.1], DOWN), 10, 0.007)
    assert np.array_equal(model.pose, before)


def test_singular_poses_are_refused(arm):
    """With the wrist straight, joints 4 and 6 turn about one axis."""
    straight = READY_RAD * [1, 1, 1, 1, 0, 1]
    assert arm.min_singular_value(straight) < 1e-6 < MIN_SINGULAR_VALUE < arm.min_singular_value(READY_RAD)
    with pytest.raises(Unreachable, match="singular"):
        arm.solve_near(arm.forward(straight), straight)


def test_joints_keep_their_speeds(arm):
    """Near a singular wrist a small motion needs large joint motions, so it takes more time."""
    model = KinematicArm()
    model._set_angles(np.radians([0.0, 30, 10, 0, 12, 0]))
    T = model.pose @ matrix([0, 0, 0], Rotation.from_rotvec([0.15, 0, 0]))
    steps, before = model.set_target(T, 3, 0.007), model.angles.copy()
    assert steps > 3
    mean = np.abs(model._to - before) / (steps * 0.007)
    assert (mean <= MAX_SPEEDS_RAD_S).all()


@pytest.mark.parametrize("name", ARM_MODELS)
def test_every_arm_model_ends_at_its_target(name):
    model = arm_model_named(name)
    start, end = matrix([0.38, 0, 0.1], DOWN), matrix([0.385, 0.003, 0.098], DOWN * Rotation.from_rotvec([0.03, 0, 0.02]))
    model.reset_to(start)
    count = model.set_target(end, 8, 0.007)
    for k in range(1, count + 1):
        model.advance(k / count, 0.007, np.zeros(3), np.zeros(3))
    for _ in range(15):
        model.advance(1.0, 0.007, np.zeros(3), np.zeros(3))
    assert np.allclose(model.pose, end, atol=2e-5)
    assert np.allclose(model.measured_pose(), model.pose)


def test_dynamic_arm_deflects_by_its_stiffness():
    """At rest, joints turn by torque over stiffness, so the sensor moves by J K^-1 J^T F. Gravity is compensated."""
    model = DynamicArm()
    T = matrix([0.38, 0, 0.1], DOWN)
    model.reset_to(T)
    for _ in range(60):
        model.advance(1.0, 0.007, np.zeros(3), np.zeros(3))
    rest = model.pose[:3, 3].copy()
    assert np.linalg.norm(rest - T[:3, 3]) < 0.2e-3  # the sensor's own weight is not
    force = np.array([1.0, -2.0, 5.0])
    jacobian = model.arm.jacobian(model.angles)[:3]
    for _ in range(60):
        model.advance(1.0, 0.007, force, np.zeros(3))
    expected = jacobian / model.model.actuator_gainprm[:, 0] @ jacobian.T @ force
    assert np.allclose(model.pose[:3, 3] - rest, expected, atol=0.02 * np.linalg.norm(expected))
    assert 1e-6 < np.linalg.norm(expected) < 0.1e-3


def test_arm_centres_of_mass_lie_in_their_links(arm):
    """Masses and centres come from another source than the shapes, so each centre must lie within the link's own solids."""
    data = mujoco.MjData(arm.model)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_comPos(arm.model, data)
    for body in range(1, arm.model.nbody):
        geoms = np.flatnonzero(arm.model.geom_bodyid == body)
        low = (data.geom_xpos[geoms] - arm.model.geom_rbound[geoms, None]).min(0)
        high = (data.geom_xpos[geoms] + arm.model.geom_rbound[geoms, None]).max(0)
        assert (low < data.xipos[body]).all() and (data.xipos[body] < high).all()
    assert arm.model.body_mass.sum() == pytest.approx(6.215 + 3.067 + 3.909 + 2.944 + 1.328 + 0.546 + 0.137 + 0.2)


def test_half_way_between_two_poses():
    a, b = matrix([0, 0, 0], Rotation.identity()), matrix([2, 0, 0], Rotation.from_rotvec([0, 0, 1]))
    assert np.allclose(interpolate(a, b, 0.5), matrix([1, 0, 0], Rotation.from_rotvec([0, 0, 0.5])))


def test_unknown_arm_is_refused():
    with pytest.raises(TactipError, match="none, kinematic, dynamic"):
        arm_model_named("left")


def test_arm_names_are_those_of_the_models():
    assert get_args(ArmName) == tuple(ARM_MODELS)
