"""The filter of poses against geometry on planes and edges, and against the statistics of simulated estimates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.sim.pose import from_mm_deg, label_of, matrix, sensor_in_contact, to_mm_deg

IDEAL = FilterSettings(bend_deg_per_mm=0.0, rest_mm=0.0, rest_deg=0.0, motion_fraction=0.0, correlated_estimates=1.0)
"""A filter that assumes straight objects and independent estimates."""

STARTS = {"surface": [0, 0, -2.5, 6, -4, 0], "edge": [1.5, 0, -3, 5, -7, 20]}
"""Labels, mm and degrees."""


def rows(task):
    return [COMPONENTS.index(c) for c in LEARNED[task]]


def label_on_straight(task, T_world_sensor):
    """Return the label (6,) of a sensor on the plane z = 0, or on the edge along y there."""
    label = label_of(T_world_sensor)
    return np.array([label[0], 0, *label[2:]]) if task == "edge" else SurfaceGroundTruth(Plane()).label(T_world_sensor)


class Plane:
    """The plane z = 0 as a distance field."""

    def nearest(self, points):
        return SimpleNamespace(place=points * [1, 1, 0], distance=points[:, 2])

    def smooth_normal(self, points):
        return np.array([[0.0, 0, 1]])

    def distance(self, points):
        return points[2]


def random_motion(rng):
    return matrix(rng.normal(0, 6e-4, 3), Rotation.from_rotvec(np.radians(rng.normal(0, 1.5, 3))))


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_pose_filter_with_worthless_estimates_follows_the_motion_exactly(task):
    rng, T = np.random.default_rng(1), sensor_in_contact(from_mm_deg(STARTS[task]))
    pose_filter = PoseFilter(task, IDEAL)
    pose_filter.step(T, label_on_straight(task, T), from_mm_deg([0.1] * 3 + [0.5] * 3))
    for _ in range(20):
        T = T @ random_motion(rng)
        worthless = label_on_straight(task, T) + from_mm_deg([1] * 3 + [5] * 3)
        found = pose_filter.step(T, worthless, from_mm_deg([1e6] * 3 + [1e6] * 3))
        assert np.allclose(to_mm_deg(found.label), to_mm_deg(label_on_straight(task, T)), atol=1e-5)


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_pose_filter_covariance_matches_its_errors(task):
    """With independent estimates, the squared errors over the covariance follow a chi-squared distribution."""
    k, deviations, normalized, raw = rows(task), from_mm_deg([0.3] * 3 + [1.5] * 3), [], []
    for seed in range(120):
        rng, T = np.random.default_rng(seed), sensor_in_contact(from_mm_deg(STARTS[task]))
        pose_filter = PoseFilter(task, replace(IDEAL, gate_probability=0.999999))
        for _ in range(8):
            estimated = label_on_straight(task, T)
            estimated[k] += rng.normal(0, deviations[k])
            found = pose_filter.step(T, estimated, deviations)
            last, T = T, T @ random_motion(rng)
        error = np.roll(_log(sensor_in_contact(label_on_straight(task, last)), sensor_in_contact(found.label)), 3)[k]
        normalized.append(error @ np.linalg.solve(found.covariance[np.ix_(k, k)], error))
        raw.append(np.abs(found.label - label_on_straight(task, last))[k] / deviations[k])
    # The mean of 120 such values has a standard deviation of sqrt(2 k / 120).
    assert np.mean(normalized) == pytest.approx(len(k), abs=3 * np.sqrt(2 * len(k) / 120))
    assert np.mean(np.array(normalized) > chi2.ppf(0.9, len(k))) == pytest.approx(0.1, abs=0.08)
    assert np.mean(raw) < 0.4  # of a deviation; single estimates err by 0.8


def _log(T, T_mean):
    """Return rotation vector and translation (6,) of T over T_mean."""
    from scipy.spatial.transform import RigidTransform

    return RigidTransform.from_matrix(T @ np.linalg.inv(T_mean)).as_exp_coords()


def test_pose_filter_error_of_tilt_becomes_one_of_depth():
    """After a step of d, the variance of depth has grown by d² times that of the tilt along it."""
    pose_filter, T = PoseFilter("surface", IDEAL), sensor_in_contact(from_mm_deg([0, 0, -2, 0, 0, 0]))
    small, large = from_mm_deg([0.1] * 3 + [2.0] * 3), from_mm_deg([1e6] * 6)
    before = pose_filter.step(T, label_on_straight("surface", T + 1e-12), small).covariance
    T = T @ matrix([3e-3, 0, 0], Rotation.identity())
    after = pose_filter.step(T, from_mm_deg([0, 0, -2, 0, 0, 0]), large).covariance
    assert after[2, 2] - before[2, 2] == pytest.approx(3e-3**2 * before[4, 4], rel=1e-3)
    assert after[0].tolist() == [0.0] * 6


def test_pose_filter_rejects_an_outlier_and_restarts_after_several():
    pose_filter, T = PoseFilter("edge", FilterSettings(max_rejected=2)), np.eye(4)
    label, deviations = from_mm_deg([0.5, 0, -3, 0, 0, 10]), from_mm_deg([0.2] * 3 + [1.0] * 3)
    for _ in range(3):
        assert pose_filter.step(T, label, deviations).accepted
    wrong = label + from_mm_deg([0, 0, 0, 0, 0, 40])
    for _ in range(2):
        found = pose_filter.step(T, wrong, deviations)
        assert not found.accepted
        assert np.allclose(found.label, label)
    found = pose_filter.step(T, wrong, deviations)
    assert found.accepted
    assert np.allclose(found.label, wrong)


def test_pose_filter_bends_and_correlated_estimates_raise_the_deviation():
    T, label, deviations = np.eye(4), from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([0.1] * 3 + [1.0] * 3)
    D = matrix([0, 1e-3, 0], Rotation.identity())

    def deviation(settings):
        pose_filter = PoseFilter("surface", settings)
        pose_filter.step(T, label, deviations)
        return pose_filter.step(T @ D, label, deviations).deviations[3]

    alone = deviation(IDEAL)
    assert np.degrees(alone) == pytest.approx(np.sqrt(0.5), rel=0.05)
    assert deviation(replace(IDEAL, bend_deg_per_mm=3.0)) > 1.2 * alone
    assert deviation(replace(IDEAL, correlated_estimates=4.0)) == pytest.approx(2 * alone, rel=0.05)


def test_pose_filter_finds_the_bend_of_a_rim_and_does_not_lag():
    """Along a circle of 50 mm the frame turns by 1.15° per mm, more than a filter without bends could follow."""
    radius, step = 0.05, 1e-3
    rng, deviations = np.random.default_rng(3), from_mm_deg([0.3, 0, 0.1, 1.0, 1.5, 4.0])
    in_contact = from_mm_deg([0.4, 0, -2, 2, -3, 5])
    late, without, bends = [], [], []
    pose_filter, straight = PoseFilter("edge", FilterSettings()), PoseFilter("edge", FilterSettings(bend_deg_per_mm=0.0))
    for k in range(120):
        turn = Rotation.from_euler("z", k * step / radius)
        T_world_contact = matrix(turn.apply([radius, 0, 0]), turn)
        estimated = in_contact + rng.normal(0, deviations) * [1, 0, 1, 1, 1, 1]
        T = T_world_contact @ sensor_in_contact(in_contact)
        found, other = (one.step(T, estimated, deviations) for one in (pose_filter, straight))
        if k >= 20:
            without.append(to_mm_deg(other.label - in_contact))
            late.append(to_mm_deg(found.label - in_contact))
            bends.append(found.bends[2])
    assert np.mean(bends) * radius == pytest.approx(1, abs=0.25)
    assert abs(np.mean(late, 0)[5]) < 0.9
    assert abs(np.mean(without, 0)[5]) > 3
    assert (np.std(late, 0)[[0, 2, 3, 4, 5]] < 0.7 * to_mm_deg(deviations)[[0, 2, 3, 4, 5]]).all()


def test_pose_filter_finds_the_curvatures_of_a_cylinder():
    """Of a cylinder along y, convex along x; the sensor is guided along x, back, and along y."""
    radius, rng = 0.03, np.random.default_rng(4)
    deviations = from_mm_deg([0, 0, 0.05, 0.5, 0.5, 0])
    pose_filter = PoseFilter("surface", FilterSettings(bend_length_mm=1e3))
    angles = [*np.linspace(0, 0.4, 25), *np.linspace(0.4, 0.1, 20), *[0.1] * 15]
    along_y = [*[0.0] * 45, *np.linspace(0, 0.012, 15)]
    for angle, y in zip(angles, along_y, strict=True):
        turn = Rotation.from_euler("y", angle)
        T_world_contact = matrix(turn.apply([0, 0, radius]) + [0, y, 0], turn)
        true = from_mm_deg([0, 0, -2, 0, 0, 0])
        estimated = true + rng.normal(0, 1, 6) * deviations
        found = pose_filter.step(T_world_contact @ sensor_in_contact(true), estimated, deviations)
    along_x, twist, across = found.bends
    assert along_x == pytest.approx(1 / radius, rel=0.15)
    assert abs(twist) < 6
    assert abs(across) < 10


def test_pose_filter_learns_that_estimates_err_more_than_they_say(monkeypatch):
    """With errors of three times the deviations, it weighs estimates less, and its own deviations grow."""
    told, true = from_mm_deg([0, 0, 0.1, 1.0, 1.0, 0]), from_mm_deg([0, 0, -2, 0, 0, 0])

    def spread():
        """Return the errors' and the filter's standard deviations of the tilt, degrees."""
        rng, pose_filter = np.random.default_rng(5), PoseFilter("surface", FilterSettings(correlated_estimates=1.0))
        states = [
            pose_filter.step(
                sensor_in_contact(true) @ matrix([k * 3e-4, 0, 0], Rotation.identity()),
                true + 3 * told * rng.normal(0, 1, 6),
                told,
            )
            for k in range(400)
        ]
        tilts = np.degrees([s.label[3:5] for s in states[50:]])
        return tilts.std(), np.degrees(np.mean([s.deviations[3:5] for s in states[50:]]))

    error, deviation = spread()
    assert deviation == pytest.approx(error, rel=0.4)
    monkeypatch.setattr("tactip_twin.learning.pose_filter._MAX_EXCESS", 1.0)
    trusting_error, trusting_deviation = spread()
    assert error < 0.85 * trusting_error
    assert trusting_deviation < 0.6 * trusting_error


def test_pose_filter_believes_estimates_that_contradict_the_motion_again_and_again():
    """The tip touches a steep flank with its side: the arm moves 0.3 mm along the sensor's axis at every other step, and the
    flank gives way. A filter that takes this for noise is wrong by more than a millimetre after ten steps."""
    told, true = from_mm_deg([0, 0, 0.1, 2.5, 2.5, 0]), from_mm_deg([0, 0, -0.3, 2, 9, 0])
    rng, pose_filter, T = np.random.default_rng(2), PoseFilter("surface", FilterSettings()), sensor_in_contact(true)
    errors_mm = []
    for k in range(40):
        T = T @ matrix([0, 0, 0.3e-3 * (k % 2)], Rotation.identity())
        found = pose_filter.step(T, true + told * rng.normal(0, 1, 6), told)
        errors_mm.append(abs(to_mm_deg(found.label - true)[2]))
    assert np.mean(errors_mm[10:]) < 0.35
    assert max(errors_mm[10:]) < 1.0
