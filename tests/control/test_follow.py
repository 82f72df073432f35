"""Following a route in simulation from first contact to the end, with the ground truth as estimator; and single failures."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.servo_world import BRISK, NoisyOracle, Scripted, World, beside, lost, over, wild
from tactip_twin.control.estimator import Estimate, Oracle
from tactip_twin.control.routes import EdgePath, PlanarPath
from tactip_twin.control.servo import Servo
from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.tactip_model.errors import TactipError


@pytest.mark.slow
def test_follower_with_a_filter_follows_noisy_estimates_more_closely():
    """The recorded label is the fused one, beside that of the image alone; in the air nothing is fused."""
    errors, estimates = {}, {}
    for name, pose_filter in (("alone", None), ("fused", PoseFilter("surface", FilterSettings(correlated_estimates=1.0)))):
        world = World("sphere")
        follower = world.follow(world.start([0, 0, 0.06]), over(world), NoisyOracle(world.oracle), pose_filter)
        assert follower.stopped_because == "route completed"
        labels = world.true_labels()
        errors[name] = np.hypot(labels[:, 3], labels[:, 4]).mean()
        following = [s for s in world.steps if s.phase == "follow"]
        off = np.array([to_mm_deg(s.estimate.label) for s in following]) - labels
        estimates[name] = np.hypot(off[:, 3], off[:, 4]).mean()
        same = [np.array_equal(s.estimate.label, s.label_from_image) for s in following]
        assert all(same) if pose_filter is None else not any(same)
        assert all(np.array_equal(s.estimate.label, s.label_from_image) for s in world.steps if not s.estimate.touching)
        if pose_filter is not None:
            assert all((s.estimate.deviations[2:5] < NoisyOracle.deviations[2:5]).all() for s in following)
    # The limit on turns smooths the run without the filter, too.
    assert errors["fused"] < 0.85 * errors["alone"]
    assert estimates["fused"] < 0.6 * estimates["alone"]


@pytest.mark.parametrize("arm", ["kinematic", "dynamic"])
def test_follower_on_a_ball_completes_its_route(arm):
    world = World("sphere", arm)
    follower = world.follow(world.start([0, 0, 0.06]), over(world))
    assert follower.stopped_because == "route completed"
    assert not follower.events
    labels = world.true_labels()
    assert len(labels) >= 11
    assert np.abs(labels[:, 2] + 3).max() < 0.2
    assert np.linalg.norm(labels[:, 3:5], axis=1).max() < 2.5
    measured = np.array([s.T_base_tcp_measured for s in world.steps])
    true = np.array([s.T_base_tcp for s in world.steps])
    assert np.allclose(measured, true, atol=1e-9)
    assert all(np.linalg.norm(s.touch.force) > 0.2 for s in world.steps if s.phase == "follow")


def test_follower_along_an_edge_stops_at_the_path_limit():
    world = World("edge", task="edge")
    start = world.start([0.06, 0, 0])
    follower = world.follow(start, EdgePath(max_length_m=0.01))
    assert follower.stopped_because == "stopped at the path limit of 10 mm"
    labels = world.true_labels()
    assert np.abs(labels[:, 0]).max() < 0.1
    assert np.abs(labels[:, 2] + 3).max() < 0.1
    travel = world.steps[-1].T_base_tcp[:3, 3] - start[:3, 3]
    assert travel[1] == pytest.approx(0.01, abs=1.5e-3)


def test_follower_with_a_biased_estimator_has_the_same_bias():
    """The estimator is off by half a millimetre and two degrees."""

    class Wrong(Oracle):
        def estimate(self, touch, T_base_tcp):
            estimate = super().estimate(touch, T_base_tcp)
            return Estimate(estimate.label + from_mm_deg([0, 0, 0.5, 2, 0, 0]), estimate.touching, None)

    world = World("plate")
    world.follow(
        world.start([0, 0, 0]), over(world, 0.003), Wrong(world.truth, world.scene_object.T_base_object), alignment_steps=30
    )
    assert np.allclose(world.true_labels()[-1], [0, 0, -3.5, -2, 0, 0], atol=0.1)


@pytest.mark.parametrize(("failure", "kind"), [(lost, "contact lost"), (wild, "estimate out of range")])
def test_follower_single_failure_is_recorded_and_recovered(failure, kind):
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), Scripted(world, {20: failure}), alignment_steps=5)
    assert follower.stopped_because == "route completed"
    assert [e.kind for e in follower.events] == [kind]


@pytest.mark.slow
def test_follower_failure_that_remains_is_left_out_to_the_end_of_the_route():
    world = World("plate")
    replaced = dict.fromkeys(range(12, 4000), wild)
    follower = world.follow(
        world.start([0, 0, 0]), over(world), Scripted(world, replaced), max_recoveries=1, alignment_steps=3, skip_mm=5.0
    )
    assert follower.stopped_because == "route completed"
    left = follower.left_out
    assert [(stretch.to_mm, stretch.kind) for stretch in left] == [(pytest.approx(12), "estimate out of range")]
    assert len(follower.events) <= 8
    places = np.array(left[0].places_m)
    assert np.ptp(places[:, 0]) == pytest.approx(1e-3 * (left[0].to_mm - left[0].from_mm), abs=1e-6)


def test_follower_without_contact_reports_it():
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0], off_mm=9), over(world), search_mm=2.0)
    assert follower.stopped_because == "no contact detected within 2 mm"


def test_follower_beyond_the_border_of_the_object_leaves_the_rest_out():
    """Beyond the border of a plate, the estimate is of an upright surface or there is no contact."""
    world = World("plate")
    follower = world.follow(
        world.start([0.076, 0, 0]), beside(world, 0.076, 0.03), search_mm=3.0, alignment_steps=3, **BRISK
    )
    assert follower.stopped_because == "route completed"
    assert {e.kind for e in follower.events} <= {
        "contact lost",
        "no contact",
        "estimate out of range",
        "too steep",
        "collision",
    }
    assert follower.left_out[-1].to_mm == pytest.approx(30)
    assert follower.left_out[-1].from_mm < 12


def test_follower_retraction_is_not_in_the_phase_follow():
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), Scripted(world, {20: wild}), alignment_steps=5)
    assert [e.kind for e in follower.events] == ["estimate out of range"]
    depths = world.true_labels()[:, 2]
    assert depths.max() < -2.5  # the servo keeps 3 mm, and a retraction is 2 mm


def test_follower_start_inside_the_object_is_refused():
    world = World("plate")
    with pytest.raises(TactipError, match="start farther away from it"):
        world.follow(world.start([0, 0, 0], off_mm=-2), over(world))


def test_follower_same_route_twice_gives_equal_steps():
    ends = []
    for _ in range(2):
        world = World("plate", "dynamic")
        world.follow(world.start([0, 0, 0]), over(world, 0.004), alignment_steps=3)
        ends.append(world.steps[-1])
    assert np.array_equal(ends[0].T_base_tcp, ends[1].T_base_tcp)
    assert np.array_equal(ends[0].touch.pin_tips, ends[1].touch.pin_tips)


@pytest.mark.slow
def test_follower_with_slowdown_lags_less_and_takes_more_steps():
    """On a ball, where the sensor lags behind the normal."""
    tilts, counts = {}, {}
    for slow in (0.0, 2.0):
        world = World("sphere")
        top = np.array([0.0, 0, 60e-3])
        middle = (world.scene_object.T_base_object @ [*top, 1])[:3]
        route = PlanarPath(middle + np.array([[0.0, 0, 0], [8e-3, 0, 0]]), [0, 0, 1])
        follower = world.follow(world.start(top), route, slowdown_angle_deg=slow)
        assert follower.stopped_because == "route completed"
        following = [s for s in world.steps if s.phase == "follow"]
        tilts[slow] = np.mean([np.degrees(np.linalg.norm(s.estimate.label[3:5])) for s in following])
        counts[slow] = len(following)
    assert tilts[2.0] < 0.8 * tilts[0.0]
    assert 1.2 * counts[0.0] < counts[2.0] < 5 * counts[0.0]


def test_follower_tells_the_controller_to_which_motion_it_was_limited():
    """While it aligns after contact, an estimated tilt of 40 degrees leads to turns of 4 degrees at most."""
    made = []

    class Noting(Servo):
        def limited_to(self, motion):
            made.append(np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))
            super().limited_to(motion)

    for replaced in ({}, dict.fromkeys(range(6, 9), wild)):
        world, made[:] = World("plate"), []
        follower = world.follow(world.start([0, 0, 0]), over(world, 0.003), Scripted(world, replaced), servo=Noting)
        assert follower.stopped_because == "route completed"
        assert made == pytest.approx([4.0] * len(made)) and len(made) >= len(replaced)
        assert bool(made) == bool(replaced)


@pytest.mark.parametrize(("tilt_deg", "least", "most"), [(0.0, 0.95, 1.05), (4.0, 0.05, 0.15), (9.0, 0.0, 0.001)])
def test_follower_takes_shorter_steps_the_larger_the_estimated_tilt(tilt_deg, least, most):
    """Full steps without tilt, a tenth of them at 4 degrees, none at 9; one step has the tilted estimate."""
    world = World("plate")

    def tilted(estimate):
        return replace(estimate, label=estimate.label + from_mm_deg([0, 0, 0, 0, tilt_deg, 0]))

    world.follow(world.start([0, 0, 0]), over(world), Scripted(world, {24: tilted}))
    steps = [np.linalg.norm(b.T_base_tcp[:2, 3] - a.T_base_tcp[:2, 3]) for a, b in pairwise(world.steps)]
    assert world.steps[24].phase == "follow" == world.steps[25].phase
    assert least <= 1e3 * steps[24] <= most
