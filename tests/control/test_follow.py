"""Following a route in simulation, from first contact to the end, with the ground truth as estimator; and failures."""

import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from helpers.profiles import profiled_block
from tactip_twin.assets.meshes.hard_rims import CorneredRim, GappedRim
from tactip_twin.control.estimator import Estimate, Estimator, Oracle
from tactip_twin.control.follow import ContourFollower
from tactip_twin.control.obstacles import Obstacle
from tactip_twin.control.options import Settings
from tactip_twin.control.routes import EdgePath, PlanarPath
from tactip_twin.control.servo import Gains, Servo
from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import Edge, load_object
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import load_design

SURFACE = Labels("surface", (-5, -15, -15), (-1, 15, 15))
EDGE = Labels("edge", (-5, -5, -15, -15, -45), (5, -1, 15, 15, 45))


BRISK = {"max_skips": 1, "skip_mm": 8.0, "clearance_mm": 4.0}
"""Settings with few and long skips."""


class World:
    """An object, a tip on an arm, and the ground truth."""

    def __init__(self, source, arm="none", task="surface", edge=None):
        self.scene_object = load_object(source)
        if edge is not None:
            if not isinstance(edge, Edge):  # the ends of a straight edge on top of a mesh
                points = np.linspace(*edge, 50)
                edge = Edge(points, np.tile([0.0, 0, 1], (len(points), 1)), closed=False)
            self.scene_object = replace(self.scene_object, edge=edge)
        self.labels = SURFACE if task == "surface" else EDGE
        self.truth = (
            SurfaceGroundTruth(self.scene_object.solid) if task == "surface" else EdgeGroundTruth(self.scene_object.edge)
        )
        design, self.arm_model = load_design("tactip-127"), arm_model_named(arm)
        self.mounted_tip = MountedTip(
            design, self.scene_object.solid, fidelity_named("draft"), self.arm_model, self.scene_object.T_base_object
        )
        self.oracle = Oracle(self.truth, self.scene_object.T_base_object)
        self.steps = []

    def start(self, place_m, off_mm=1.5):
        """Return a pose above the true contact frame at a place (3,) m on the object."""
        T = np.eye(4)
        T[:3, :3] = np.diag([1.0, -1, -1])
        T[:3, 3] = place_m
        return (
            self.scene_object.T_base_object @ self.truth.frame(T) @ sensor_in_contact(from_mm_deg([0, 0, off_mm, 0, 0, 0]))
        )

    def follow(self, T, route, estimator=None, pose_filter=None, **settings):
        follower = ContourFollower(
            self.mounted_tip,
            estimator or self.oracle,
            Servo(Gains(), 3.0),
            self.labels,
            Settings(**settings),
            self.steps.append,
            time.perf_counter,
            pose_filter=pose_filter,
        )
        follower.run(T, route)
        return follower

    def true_labels(self, phase="follow"):
        """Return the true labels (n, 6), mm and degrees, of the steps of a phase."""
        to_object = inverse(self.scene_object.T_base_object)
        return np.array([to_mm_deg(self.truth.label(to_object @ s.T_base_tcp)) for s in self.steps if s.phase == phase])


class NoisyOracle:
    """The ground truth with noise, and the noise's deviations."""

    deviations = from_mm_deg([0, 0, 0.2, 3.0, 3.0, 0])

    def __init__(self, oracle):
        self._oracle, self._rng = oracle, np.random.default_rng(0)

    def estimate(self, touch, T_base_tcp):
        estimate = self._oracle.estimate(touch, T_base_tcp)
        noisy = estimate.label + self._rng.normal(0, 1, 6) * self.deviations
        return replace(estimate, label=noisy, deviations=self.deviations)


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


def over(world, length_m=0.012):
    """Return a straight path over the middle of an object."""
    middle = world.scene_object.T_base_object[:3, 3]
    return PlanarPath([middle, middle + [length_m, 0, 0]], [0, 0, 1])


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


class Scripted(Estimator):
    """The ground truth, with replaced estimates at some steps."""

    def __init__(self, world, replaced):
        self.oracle, self.replaced, self.step = world.oracle, replaced, -1

    def estimate(self, touch, T_base_tcp):
        self.step += 1
        estimate = self.oracle.estimate(touch, T_base_tcp)
        return self.replaced.get(self.step, lambda s: s)(estimate)


def lost(estimate):
    return Estimate(estimate.label, 0.0, None)


def wild(estimate):
    return Estimate(from_mm_deg([0, 0, -3, 40, 0, 0]), estimate.touching, None)


@pytest.mark.parametrize(("failure", "kind"), [(lost, "contact lost"), (wild, "estimate out of range")])
def test_follower_single_failure_is_recorded_and_recovered(failure, kind):
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), Scripted(world, {20: failure}), alignment_steps=5)
    assert follower.stopped_because == "route completed"
    assert [e.kind for e in follower.events] == [kind]


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


@pytest.mark.parametrize("fidelity", ["draft", "fast"])
def test_arm_moves_back_where_the_force_is_too_high(fidelity, monkeypatch):
    """A press of 5 mm on a plane, of some 5 N, is stopped at 2 N; one of 1 mm is not."""
    world, at_rest_n = World(profiled_block([(-60, 0), (60, 0)]), arm="dynamic"), []
    tip, scene = world.mounted_tip, world.mounted_tip.scene
    stiffen = scene.stiffen

    def stiffened(resting):
        if resting:
            at_rest_n.append(np.linalg.norm(scene.contact_force()))
        stiffen(resting)

    monkeypatch.setattr(scene, "stiffen", stiffened)
    if fidelity == "fast":
        sliding = read_sliding_tip(shipped_sliding_tip("surface", "tactip-127"))
        solid, T = world.scene_object.solid, world.scene_object.T_base_object
        standard = fidelity_named("standard")
        tip = FastMountedTip(sliding, load_design("tactip-127"), solid, standard, world.arm_model, T, world.truth)
    tip.reset_to(world.start([0, 0, 0]))
    for depth_mm, limit_n in ((1, 2.0), (5, 2.0), (1, 0.1)):
        state = tip.go(world.start([0, 0, 0], -depth_mm), limit_n)
        force = np.linalg.norm(state.force)
        assert state.peak_force_n >= force - 1e-9
        assert state.moved_back == (depth_mm == 5)
        if state.moved_back:
            assert 0.5 < force <= 1.05 * limit_n < state.peak_force_n
            if fidelity != "fast":  # which only knows the force at the end of a motion
                assert state.peak_force_n < 1.3 * limit_n
                # At the stiffness of a tip at rest, so deep a contact could throw the tip off.
                assert at_rest_n[-1] <= limit_n
    # A motion that only lowers the force is no reason to stop, whatever the limit.
    assert 0.1 < force < 0.7


def beside(world, x_m, length_m):
    """Return a straight path from a place x_m off the middle of an object."""
    start = world.scene_object.T_base_object[:3, 3] + [x_m, 0, 0]
    return PlanarPath([start, start + [length_m, 0, 0]], [0, 0, 1])


@pytest.mark.slow
def test_follower_lifts_over_a_wall_and_continues_behind_it():
    """A wall 16 mm high and 6 mm thick stands across the route on a plate."""
    world = World(profiled_block([(-60, 0), (-3.1, 0), (-3, 16), (3, 16), (3.1, 0), (60, 0)], -20, 80))
    follower = world.follow(world.start([-0.04, 0, 0]), beside(world, -0.04, 0.08), max_force_n=3.0)
    assert follower.stopped_because == "route completed"
    assert follower.events
    following = [s for s in world.steps if s.phase == "follow"]
    places = np.array([s.T_base_tcp[0, 3] - world.scene_object.T_base_object[0, 3] for s in following])
    assert places.min() < -0.03
    assert places.max() > 0.035
    # The arm stops at the limit and moves back; at the pace of this fidelity the force overshoots within a step.
    assert max(np.linalg.norm(s.touch.force) for s in world.steps) < 3.3
    assert follower.peak_force_n < 6.0
    assert 10 < sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out) < 60
    assert len(following) > 20


@pytest.mark.slow
def test_follower_bridges_a_gap_of_an_edge():
    """The gap is 30 mm wide and 15 mm deep, and the edge is straight across it."""
    block = profiled_block([(-60, 0), (-25, 0), (-24.9, -15), (4.9, -15), (5, 0), (60, 0)], -25, 60)
    world = World(block, task="edge", edge=([0.06, 0.03, 0], [-0.06, 0.03, 0]))
    route = EdgePath(max_length_m=0.085)
    follower = world.follow(world.start([0.03, 0.03, 0]), route)
    assert follower.stopped_because == "stopped at the path limit of 85 mm"
    assert {"contact lost", "no contact"} & {e.kind for e in follower.events}
    places = [s.T_base_tcp[0, 3] - world.scene_object.T_base_object[0, 3] for s in world.steps if s.phase == "follow"]
    assert max(places) > 0.025
    assert min(places) < -0.03
    assert 8 < sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out) < 50


def rim_world(rim):
    """Return the world of a rim."""
    vertices, triangles = rim.mesh()
    turn = np.linspace(0, 2 * np.pi, 721)
    edge = Edge(rim.edge(turn) / 1e3, rim.frames(turn)[1], closed=True)
    return World(trimesh.Trimesh(vertices / 1e3, triangles, process=False), task="edge", edge=edge)


@pytest.mark.slow
def test_follower_continues_behind_the_gap_of_a_rim():
    """Straight ahead, the edge behind the gap would be missed by several millimetres."""
    rim = GappedRim(60.0)
    world = rim_world(rim)
    follower = world.follow(world.start(rim.edge(np.array([1.3]))[0] / 1e3), EdgePath(max_length_m=0.085))
    assert follower.stopped_because == "stopped at the path limit of 85 mm"
    to_object = inverse(world.scene_object.T_base_object)
    places = np.array([(to_object @ s.T_base_tcp)[:3, 3] for s in world.steps if s.phase == "follow"])
    turn = np.arctan2(places[:, 1], places[:, 0]) - rim.gap_turn_rad
    half = rim.gap_mm / 2 / rim.radius_mm
    assert turn.min() < -1.5 * half
    assert turn.max() > 1.5 * half
    beside = np.abs(turn) > 1.2 * half
    assert np.abs(np.linalg.norm(places[beside, :2], axis=1) - 0.06).max() < 2e-3


@pytest.mark.slow
def test_follower_turns_with_a_corner_of_a_rim():
    rim = CorneredRim(50.0)
    world = rim_world(rim)
    follower = world.follow(world.start([0.05, 0.035, 0]), EdgePath(max_length_m=0.03))
    assert follower.stopped_because == "stopped at the path limit of 30 mm"
    assert not follower.left_out
    end = inverse(world.scene_object.T_base_object) @ world.steps[-1].T_base_tcp
    assert end[1, 3] == pytest.approx(0.05, abs=1e-3)
    assert end[0, 3] < 0.04


def test_follower_high_force_is_an_event():
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), max_force_n=0.8, max_recoveries=1, **BRISK)
    assert {e.kind for e in follower.events} == {"force"}
    assert follower.stopped_because == "route completed"
    assert follower.left_out[-1].to_mm == pytest.approx(12)


def test_follower_eases_off_where_the_estimated_force_is_high():
    class Forceful(Oracle):
        def estimate(self, touch, T_base_tcp):
            return replace(super().estimate(touch, T_base_tcp), force_n=float(np.linalg.norm(touch.force)))

    depths, forces = {}, {}
    for limit in (100.0, 1.0):
        world = World("plate")
        oracle = Forceful(world.truth, world.scene_object.T_base_object)
        follower = world.follow(world.start([0, 0, 0]), over(world, 0.005), oracle, ease_force_n=limit)
        assert follower.stopped_because == "route completed"
        depths[limit] = -world.true_labels()[-1, 2]
        forces[limit] = np.linalg.norm(world.steps[-1].touch.force)
    assert depths[100.0] == pytest.approx(3.0, abs=0.1)
    assert depths[1.0] < 2.7
    assert forces[1.0] < 1.2 < forces[100.0]


def test_follower_retraction_is_not_in_the_phase_follow():
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), Scripted(world, {20: wild}), alignment_steps=5)
    assert [e.kind for e in follower.events] == ["estimate out of range"]
    depths = world.true_labels()[:, 2]
    assert depths.max() < -2.5  # the servo keeps 3 mm, and a retraction is 2 mm


def test_follower_search_without_detection_stops_at_the_force_limit():
    world = World("plate")
    blind = Scripted(world, dict.fromkeys(range(4000), lost))
    follower = world.follow(world.start([0, 0, 0]), over(world), blind, search_mm=8.0, max_force_n=2.0, **BRISK)
    assert follower.stopped_because == "route completed"
    assert {e.kind for e in follower.events} <= {"force", "no contact"}
    assert follower.events[0].kind == "force"
    assert follower.events[0].what.startswith("no contact detected in the image, but ")
    forces = [np.linalg.norm(s.touch.force) for s in world.steps]
    assert 1.0 < max(forces) < 2.1
    assert 2.0 < follower.peak_force_n < 3.0
    assert follower.left_out[-1].to_mm == pytest.approx(12)


def test_follower_beyond_the_arms_reach_leaves_the_rest_out():
    world = World("plate", "kinematic")
    T = world.scene_object.T_base_object.copy()
    T[0, 3] += 0.16  # its far end is beyond the arm's reach with the sensor pointing down
    mounted_tip = MountedTip(
        load_design("tactip-127"), world.scene_object.solid, fidelity_named("draft"), world.arm_model, T
    )
    world.mounted_tip, world.scene_object = mounted_tip, replace(world.scene_object, T_base_object=T)
    world.oracle = Oracle(world.truth, T)
    follower = world.follow(world.start([-0.06, 0, 0]), over(world, 0.2), alignment_steps=3, **BRISK)
    assert follower.stopped_because == "route completed"
    assert follower.events[-1].kind == "unreachable"
    assert follower.left_out[-1].kind == "unreachable"


def test_follower_that_cannot_lift_in_the_air_goes_back_until_it_can(monkeypatch):
    """Between 4 and 6 mm along the route, the arm cannot lift the tip by more than 5 mm at once: enough to be free."""
    world = World("plate")
    go, zero = world.mounted_tip.go, world.scene_object.T_base_object[0, 3]

    def stiff(T, *args):
        here = world.arm_model.pose
        if 4e-3 < here[0, 3] - zero < 6e-3 and T[2, 3] - here[2, 3] > 5e-3:
            raise Unreachable("the arm cannot reach this pose")
        return go(T, *args)

    def wild_there(estimate):
        return wild(estimate) if world.arm_model.pose[0, 3] - zero > 4.5e-3 and not lifts else estimate

    lifts, lift = [], ContourFollower._lift

    def interrupted(self):
        lifts.append(world.arm_model.pose)
        if len(lifts) == 1:  # free, but no higher
            self._go(world.arm_model.pose + 4.5e-3 * np.outer([0, 0, 1, 0], [0, 0, 0, 1]))
            raise Obstacle("unreachable", "the arm cannot reach this pose")
        lift(self)

    monkeypatch.setattr(world.mounted_tip, "go", stiff)
    monkeypatch.setattr(ContourFollower, "_lift", interrupted)
    replaced = dict.fromkeys(range(10, 4000), wild_there)
    settings = {**BRISK, "clearance_mm": 8.0, "retract_mm": 4.5, "alignment_steps": 3, "max_recoveries": 0}
    follower = world.follow(world.start([0, 0, 0]), over(world, 0.03), Scripted(world, replaced), **settings)
    assert follower.stopped_because == "route completed"
    assert [e.kind for e in follower.events] == ["estimate out of range", "unreachable"]
    assert sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out) < 10


def test_follower_after_divergence_restarts(monkeypatch):
    world = World("plate")
    calls, tip_state = [], world.mounted_tip.tip_state

    def diverging():
        calls.append(1)
        if len(calls) == 15:
            raise Diverged("the simulation diverged")
        return tip_state()

    monkeypatch.setattr(world.mounted_tip, "tip_state", diverging)
    follower = world.follow(world.start([0, 0, 0]), over(world), alignment_steps=3)
    assert follower.stopped_because == "route completed"
    assert next(e.kind for e in follower.events) == "diverged"


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


def test_follower_overlap_of_the_housing_is_a_collision(monkeypatch):
    """Clearance in closed form: over a plate, the nearest point of a tilted housing is its edge behind the tip."""
    world = World("plate")
    for tilt_deg in (0.0, 40.0, 60.0):
        T = world.scene_object.T_base_object @ sensor_in_contact(from_mm_deg([0, 0, 0.5, tilt_deg, 0, 0]))
        world.mounted_tip.arm_model.reset_to(T)
        tilt = np.radians(tilt_deg)
        height = 0.5e-3 + 20e-3 * np.cos(tilt) - 22e-3 * np.sin(tilt)
        assert world.mounted_tip.tip_state().clearance_m == pytest.approx(height, abs=1e-7)
    once = iter([1.0] * 10 + [-1e-3])
    monkeypatch.setattr(world.mounted_tip, "_clearance", lambda: next(once, 1.0))
    follower = world.follow(world.start([0, 0, 0]), over(world), alignment_steps=5)
    assert [(e.kind, e.what) for e in follower.events] == [
        ("collision", "the sensor's housing overlaps the object by 1.0 mm")
    ]
