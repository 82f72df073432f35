"""Features of contacts: they do not change, or turn, with the sensor's rotation about its axis."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.features import COUNT, features, mirrored, pairs, without_yaw
from tactip_twin.sim.pose import before_shear, from_mm_deg, label_of, sensor_in_contact, shear_between

TASKS = ("surface", "edge")


@pytest.fixture
def contacts():
    rng = np.random.default_rng(0)
    poses = rng.uniform([-5e-3, 0, -5e-3, -0.25, -0.25, -0.7], [5e-3, 0, -1e-3, 0.25, 0.25, 0.7], (20, 6))
    return poses, rng.uniform(-1, 1, (20, 6)) * [5e-3, 5e-3, 0, 0.08, 0.08, 0.08]


def test_features_of_an_edge_do_not_depend_on_the_sensors_rotation(contacts):
    poses, shears = contacts
    plain, yaw = features("edge", poses, shears)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, -0.4]).as_matrix()  # about z of the sensor, which is -z of the label axes
    moved = [label_of(sensor_in_contact(pose) @ turn) for pose in poses]
    starts = [label_of(sensor_in_contact(before_shear(p, s)) @ turn) for p, s in zip(poses, shears, strict=True)]
    between = np.array([shear_between(a, b) for a, b in zip(starts, moved, strict=True)])
    again, turned_yaw = features("edge", np.array(moved), between)
    assert np.allclose(again, plain, atol=1e-9)
    assert np.allclose(turned_yaw - yaw, -0.4, atol=1e-9)


def test_any_yaw_of_an_edge_is_known_as_that_of_a_sensor_turned_about_its_axis(contacts):
    poses, shears = contacts
    turned = without_yaw(poses + np.array([0, 0, 0, 0, 0, 2.2]))
    assert np.allclose(features("edge", turned, shears)[1], 0, atol=1e-9)
    poses = poses * np.array([1, 1, 1, 1, 1, 0]) + from_mm_deg([0, 0, 0, 0, 0, 170])
    assert np.allclose(features("edge", without_yaw(poses), shears)[0], features("edge", poses, shears)[0], atol=1e-9)
    tip = read_fast_tip(any_materials("edge"))
    steep, far = poses + from_mm_deg([0, 0, 0, 40, 0, 0]), poses + from_mm_deg([20, 0, 0, 0, 0, 0])
    assert not tip.outside(poses, shears).any()
    assert tip.outside(steep, shears).all() and tip.outside(far, shears).all()


@pytest.mark.parametrize("task", TASKS)
def test_features_of_a_mirrored_contact_are_mirrored(contacts, task):
    """The last symmetry of a task is, or contains, the mirror in the plane of x and z."""
    (mirror,) = [s for s in SYMMETRIES[task] if np.allclose(s.plane, [[1, 0], [0, -1]])]
    poses, shears = contacts
    if task == "surface":
        poses = poses * [1, 1, 1, 1, 1, 0]
    plain, yaw = features(task, poses, shears)
    again, mirrored_yaw = features(task, np.array([*map(mirror.label, poses)]), np.array([*map(mirror.label, shears)]))
    assert np.allclose(again, mirrored(task) * plain, atol=1e-9)
    assert np.allclose(mirrored_yaw, -yaw)


def test_features_of_a_turned_surface_contact_are_turned_in_pairs(contacts):
    (quarter,) = [s for s in SYMMETRIES["surface"] if np.allclose(s.plane, [[0, -1], [1, 0]])]
    poses, shears = contacts[0] * [1, 1, 1, 1, 1, 0], contacts[1]
    plain, _ = features("surface", poses, shears)
    again, _ = features("surface", np.array([*map(quarter.label, poses)]), np.array([*map(quarter.label, shears)]))
    expected = plain.copy()
    for k in pairs("surface"):
        expected[:, k], expected[:, k + 1] = -plain[:, k + 1], plain[:, k]
    assert np.allclose(again, expected, atol=1e-9)
    assert plain.shape == (20, COUNT["surface"])
