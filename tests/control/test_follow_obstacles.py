"""Obstacles on a route: force, walls, grooves, gaps, corners, limits of the arm, and divergence."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.profiles import profiled_block
from helpers.servo_world import BRISK, Held, Scripted, Shallow, World, beside, lost, over, rim_world, wild
from tactip_twin.assets.meshes.hard_rims import CorneredRim, GappedRim
from tactip_twin.control.estimator import Oracle
from tactip_twin.control.obstacles import Obstacle
from tactip_twin.control.routes import EdgePath
from tactip_twin.control.sensed_tip import SensedTip
from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.irb120 import Unreachable
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.tactip_model.presets import load_design


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
        assert state.stopped_by == ("force" if depth_mm == 5 else "")
        if state.stopped_by:
            assert 0.5 < force <= 1.05 * limit_n < state.peak_force_n
            if fidelity != "fast":  # which only knows the force at the end of a motion
                assert state.peak_force_n < 1.3 * limit_n
                # At the stiffness of a tip at rest, so deep a contact could throw the tip off.
                assert at_rest_n[-1] <= limit_n
    # A motion that only lowers the force is no reason to stop, whatever the limit.
    assert 0.1 < force < 0.7


@pytest.mark.slow
def test_follower_continues_on_a_lower_terrace():
    """Beyond a step of 30 mm, where the tip has touched nothing so deep before, it finds the lower part from above."""
    world = World(profiled_block([(-60, 30), (0, 30), (0.1, 0), (60, 0)], -30, 60))
    follower = world.follow(world.start([-0.006, 0, 0.05]), beside(world, -0.006, 0.043), alignment_steps=3)
    assert follower.stopped_because == "route completed"
    to_object = inverse(world.scene_object.T_base_object)
    heights = [(to_object @ s.T_base_tcp)[2, 3] for s in world.steps if s.phase == "follow"]
    assert max(heights) > 25e-3 and np.count_nonzero(np.array(heights) < 2e-3) > 4


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
def test_follower_crosses_a_groove_that_is_narrower_than_the_tip():
    """The groove is 18 mm wide and 16 mm deep, so the tip bridges it; without the limit by force it is left out."""
    left_out = {}
    for ease_force_n in (2.0, 100.0):
        world = World(profiled_block([(-60, 0), (-9, 0), (0, -16), (9, 0), (60, 0)], -30, 80))
        shallow = Shallow(world.truth, world.scene_object.T_base_object)
        route = beside(world, -0.025, 0.05)
        follower = world.follow(world.start([-0.025, 0, 0]), route, shallow, ease_force_n=ease_force_n)
        assert follower.stopped_because == "route completed"
        assert follower.peak_force_n < 6.0
        left_out[ease_force_n] = sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out)
    assert left_out[2.0] < 5
    assert left_out[100.0] > 15


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


def test_follower_believes_the_image_where_the_filter_leaves_the_trained_range():
    """The filter adds the motion back to a depth that stays, so the tip would count as off the object."""
    world = World("plate")
    held = Held(world.truth, world.scene_object.T_base_object)
    follower = world.follow(world.start([0, 0, 0]), over(world), held, PoseFilter("surface", FilterSettings()))
    depths_mm = 1e3 * np.array([s.estimate.label[2] for s in world.steps])
    moved_mm = 1e3 * (world.steps[held.held[-1]].T_base_tcp - world.steps[held.held[0]].T_base_tcp)[2, 3]
    assert moved_mm > 4
    assert depths_mm[held.held].max() < 0
    assert "estimate out of range" not in {e.kind for e in follower.events}


def test_follower_high_force_is_an_event():
    world = World("plate")
    follower = world.follow(world.start([0, 0, 0]), over(world), max_force_n=0.8, max_recoveries=1, **BRISK)
    # The tip moves back by a millimetre, and may be off the object then.
    assert follower.events[0].kind == "force"
    assert {e.kind for e in follower.events} <= {"force", "contact lost"}
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


@pytest.mark.slow
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

    lifts, lift = [], SensedTip.lift

    def interrupted(self):
        lifts.append(world.arm_model.pose)
        if len(lifts) == 1:  # free, but no higher
            self.go(world.arm_model.pose + 4.5e-3 * np.outer([0, 0, 1, 0], [0, 0, 0, 1]))
            raise Obstacle("unreachable", "the arm cannot reach this pose")
        lift(self)

    monkeypatch.setattr(world.mounted_tip, "go", stiff)
    monkeypatch.setattr(SensedTip, "lift", interrupted)
    replaced = dict.fromkeys(range(10, 4000), wild_there)
    settings = {**BRISK, "clearance_mm": 8.0, "retract_mm": 4.5, "alignment_steps": 3, "max_recoveries": 0}
    follower = world.follow(world.start([0, 0, 0]), over(world, 0.03), Scripted(world, replaced), **settings)
    assert follower.stopped_because == "route completed"
    assert [e.kind for e in follower.events] == ["estimate out of range", "unreachable"]
    assert sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out) < 10


@pytest.mark.parametrize(
    ("from_mm", "needed_n", "pulled"),
    [pytest.param(-np.inf, 9.0, True, marks=pytest.mark.slow), (-np.inf, 9.1, True), (2.5, 99.0, False)],
)
def test_follower_frees_a_held_tip(from_mm, needed_n, pulled, monkeypatch):
    """The arm stops at its limit of force where it would lift the tip, as in a hollow with an undercut: beyond a place of
    the route, from which the tip goes back the way it came, or wherever it is, so that it must be pulled. No pull exceeds
    twice the limit: a tip that needs more ends the run."""
    world = World("plate")
    go, limits_n, zero = world.mounted_tip.go, [], world.scene_object.T_base_object[0, 3]

    def held(T, max_force_n=np.inf):
        here = world.arm_model.pose
        lifts = T[2, 3] - here[2, 3] > 1.5e-3 and 1e3 * (here[0, 3] - zero) > from_mm
        if lifts:
            limits_n.append(max_force_n)
        if lifts and max_force_n < needed_n:
            return replace(world.mounted_tip.tip_state(), peak_force_n=needed_n, stopped_by="force")
        return go(T, max_force_n)

    monkeypatch.setattr(world.mounted_tip, "go", held)
    failures = Scripted(world, {20: wild})
    follower = world.follow(world.start([0, 0, 0]), over(world, 0.02), failures, alignment_steps=5, max_recoveries=0)
    assert limits_n[0] == 4.5 and (max(limits_n) == 9.0) is pulled
    if needed_n > 9 and pulled:
        assert follower.stopped_because == "the object holds the tip, and 9 N do not free it"
        return
    assert follower.stopped_because == "route completed"
    assert [e.kind for e in follower.events] == ["estimate out of range"]
    assert sum(stretch.to_mm - stretch.from_mm for stretch in follower.left_out) < 5


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
    monkeypatch.setattr(world.mounted_tip, "_overlap", lambda: 0.0)
    follower = world.follow(world.start([0, 0, 0]), over(world), alignment_steps=5)
    assert [(e.kind, e.what) for e in follower.events] == [
        ("collision", "the sensor's housing ran against the object, and is 1.0 mm in it now")
    ]
    # The sensor moved along x, so that is where the obstacle is: the housing leans away from it for 3 mm.
    following = [s for s in world.steps if s.phase == "follow"]
    leaning = np.array([np.degrees(np.arcsin(s.T_base_tcp[0, 2])) for s in following])
    travelled_mm = np.array([1e3 * (s.T_base_tcp[0, 3] - following[0].T_base_tcp[0, 3]) for s in following])
    leaned = np.flatnonzero(leaning > 4.0)
    assert leaning.max() < 6.5 and 2.0 < np.ptp(travelled_mm[leaned]) < 5.0
    assert abs(leaning[-3:]).max() < 1.5
