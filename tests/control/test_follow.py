"""The whole way from contact to a followed route, in simulation, with the truth for an estimator; and what goes wrong on
it."""

import time
from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.control.estimator import Estimate, Estimator, Oracle
from tactip_twin.control.follow import ContourFollower
from tactip_twin.control.options import Settings
from tactip_twin.control.routes import EdgePath, PlanarPath
from tactip_twin.control.servo import Gains, Servo
from tactip_twin.learning.labels import Labels
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import load_design

SURFACE = Labels("surface", (-5, -15, -15), (-1, 15, 15))
EDGE = Labels("edge", (-5, -5, -15, -15, -45), (5, -1, 15, 15, 45))


class World:
    """An object, a tip on an arm, and the truth of both."""

    def __init__(self, name, arm="none", task="surface"):
        self.thing = load_object(name)
        self.labels = SURFACE if task == "surface" else EDGE
        self.truth = SurfaceGroundTruth(self.thing.solid) if task == "surface" else EdgeGroundTruth(self.thing.edge)
        design, self.carrier = load_design("tactip-127"), arm_model_named(arm)
        self.finger = MountedTip(design, self.thing.solid, fidelity_named("draft"), self.carrier, self.thing.T_base_object)
        self.oracle = Oracle(self.truth, self.thing.T_base_object)
        self.steps = []

    def start(self, place_m, off_mm=1.5):
        """A pose above the true contact frame at a place (3,) m of the object."""
        T = np.eye(4)
        T[:3, :3] = np.diag([1.0, -1, -1])
        T[:3, 3] = place_m
        return self.thing.T_base_object @ self.truth.frame(T) @ sensor_in_contact(from_mm_deg([0, 0, off_mm, 0, 0, 0]))

    def explore(self, T, route, estimator=None, **settings):
        explorer = ContourFollower(
            self.finger,
            estimator or self.oracle,
            Servo(Gains(), 3.0),
            self.labels,
            Settings(**settings),
            self.steps.append,
            time.perf_counter,
        )
        explorer.run(T, route)
        return explorer

    def true_labels(self, phase="follow"):
        """Labels (n, 6), mm and degrees, of the steps of a phase."""
        to_object = inverse(self.thing.T_base_object)
        return np.array([to_mm_deg(self.truth.label(to_object @ s.T_base_tcp)) for s in self.steps if s.phase == phase])


def over(world, length_m=0.012):
    """A Plan over the middle of an object."""
    middle = world.thing.T_base_object[:3, 3]
    return PlanarPath([middle, middle + [length_m, 0, 0]], [0, 0, 1])


@pytest.mark.parametrize("arm", ["kinematic", "dynamic"])
def test_a_ball_is_followed(arm):
    world = World("sphere", arm)
    explorer = world.explore(world.start([0, 0, 0.06]), over(world))
    assert explorer.stopped_because == "route completed"
    assert not explorer.events
    labels = world.true_labels()
    assert len(labels) >= 11
    assert np.abs(labels[:, 2] + 3).max() < 0.2
    assert np.linalg.norm(labels[:, 3:5], axis=1).max() < 2.5
    told = np.array([s.T_base_tcp_measured for s in world.steps])
    true = np.array([s.T_base_tcp for s in world.steps])
    assert np.allclose(told, true, atol=1e-9)
    assert all(np.linalg.norm(s.touch.force) > 0.2 for s in world.steps if s.phase == "follow")


def test_an_edge_is_followed_to_its_end():
    world = World("edge", task="edge")
    start = world.start([0.06, 0, 0])
    explorer = world.explore(start, EdgePath(max_length_m=0.01))
    assert explorer.stopped_because == "stopped at the path limit of 10 mm"
    labels = world.true_labels()
    assert np.abs(labels[:, 0]).max() < 0.1
    assert np.abs(labels[:, 2] + 3).max() < 0.1
    way = world.steps[-1].T_base_tcp[:3, 3] - start[:3, 3]
    assert way[1] == pytest.approx(0.01, abs=1.5e-3)


def test_what_is_felt_is_what_counts():
    """With an estimator that is wrong by half a millimetre and two degrees, the servo is wrong by as much."""

    class Wrong(Oracle):
        def estimate(self, touch, T_base_tcp):
            sight = super().estimate(touch, T_base_tcp)
            return Estimate(sight.label + from_mm_deg([0, 0, 0.5, 2, 0, 0]), sight.touching, None)

    world = World("plate")
    world.explore(
        world.start([0, 0, 0]), over(world, 0.003), Wrong(world.truth, world.thing.T_base_object), alignment_steps=30
    )
    assert np.allclose(world.true_labels()[-1], [0, 0, -3.5, -2, 0, 0], atol=0.1)


class Scripted(Estimator):
    """The truth, but for what is said otherwise at some steps."""

    def __init__(self, world, said):
        self.oracle, self.said, self.step = world.oracle, said, -1

    def estimate(self, touch, T_base_tcp):
        self.step += 1
        sight = self.oracle.estimate(touch, T_base_tcp)
        return self.said.get(self.step, lambda s: s)(sight)


def lost(sight):
    return Estimate(sight.label, 0.0, None)


def wild(sight):
    return Estimate(from_mm_deg([0, 0, -3, 40, 0, 0]), sight.touching, None)


@pytest.mark.parametrize(("fault", "kind"), [(lost, "contact lost"), (wild, "estimate out of range")])
def test_a_passing_fault_is_noted_and_overcome(fault, kind):
    world = World("plate")
    explorer = world.explore(world.start([0, 0, 0]), over(world), Scripted(world, {20: fault}), alignment_steps=5)
    assert explorer.stopped_because == "route completed"
    assert [e.kind for e in explorer.events] == [kind]


def test_a_lasting_fault_ends_the_route_with_its_reason():
    world = World("plate")
    said = dict.fromkeys(range(12, 400), wild)
    explorer = world.explore(world.start([0, 0, 0]), over(world), Scripted(world, said), max_recoveries=2)
    assert (
        "estimate out of range 3 times in a row: pose_Rx predicted as 40.0 ° (training range: -15 to 15)"
        in explorer.stopped_because
    )
    assert len(explorer.events) == 3


def test_nothing_to_touch_is_said():
    world = World("plate")
    explorer = world.explore(world.start([0, 0, 0], off_mm=9), over(world), search_mm=2.0)
    assert explorer.stopped_because == "no contact detected within 2 mm"


def test_the_end_of_the_object_ends_the_route():
    """Over the brink of a plate, the surface that is felt stands upright, or nothing is: either way it says so, and
    stops."""
    world = World("plate")
    explorer = world.explore(world.start([0.076, 0, 0]), over(world, 0.2), search_mm=3.0, alignment_steps=3)
    assert explorer.stopped_because.startswith(("no contact detected", "contact lost", "estimate out of range"))
    assert {e.kind for e in explorer.events} <= {"contact lost", "estimate out of range"}
    assert explorer.events


def test_too_high_a_force_backs_off():
    world = World("plate")
    explorer = world.explore(world.start([0, 0, 0]), over(world), max_force_n=0.8, max_recoveries=1)
    assert explorer.stopped_because.startswith("force 2 times in a row: ")
    assert explorer.events[0].kind == "force"


def test_backing_off_is_not_following():
    """What is scored is what was followed."""
    world = World("plate")
    explorer = world.explore(world.start([0, 0, 0]), over(world), Scripted(world, {20: wild}), alignment_steps=5)
    assert [e.kind for e in explorer.events] == ["estimate out of range"]
    depths = world.true_labels()[:, 2]
    assert depths.max() < -2.5  # 3 are kept; it backs off by 2


def test_a_search_that_feels_nothing_stops_at_the_force():
    world = World("plate")
    numb = Scripted(world, dict.fromkeys(range(400), lost))
    explorer = world.explore(world.start([0, 0, 0]), over(world), numb, search_mm=8.0, max_force_n=2.0)
    assert explorer.stopped_because.startswith("no contact detected in the image, but force: ")
    assert [e.kind for e in explorer.events] == ["force"]
    forces = [np.linalg.norm(s.touch.force) for s in world.steps]
    assert forces[-1] > 2.0 >= max(forces[:-1])


def test_the_arm_s_reach_ends_a_route():
    world = World("plate", "kinematic")
    T = world.thing.T_base_object.copy()
    T[0, 3] += 0.16  # beyond what the arm reaches with the sensor pointing down, at its far end
    finger = MountedTip(load_design("tactip-127"), world.thing.solid, fidelity_named("draft"), world.carrier, T)
    world.finger, world.thing = finger, replace(world.thing, T_base_object=T)
    world.oracle = Oracle(world.truth, T)
    explorer = world.explore(world.start([-0.06, 0, 0]), over(world, 0.2), alignment_steps=3)
    assert "the arm" in explorer.stopped_because
    assert explorer.events[-1].kind == "unreachable"


def test_a_simulation_that_loses_the_tip_begins_again(monkeypatch):
    world = World("plate")
    calls, tip_state = [], world.finger.tip_state

    def torn():
        calls.append(1)
        if len(calls) == 15:
            raise Diverged("the simulated tip is lost")
        return tip_state()

    monkeypatch.setattr(world.finger, "tip_state", torn)
    explorer = world.explore(world.start([0, 0, 0]), over(world), alignment_steps=3)
    assert explorer.stopped_because == "route completed"
    assert next(e.kind for e in explorer.events) == "diverged"


def test_a_start_inside_of_the_object_is_refused():
    world = World("plate")
    with pytest.raises(TactipError, match="start farther away from it"):
        world.explore(world.start([0, 0, 0], off_mm=-2), over(world))


def test_the_same_route_twice_is_the_same():
    ends = []
    for _ in range(2):
        world = World("plate", "dynamic")
        world.explore(world.start([0, 0, 0]), over(world, 0.004), alignment_steps=3)
        ends.append(world.steps[-1])
    assert np.array_equal(ends[0].T_base_tcp, ends[1].T_base_tcp)
    assert np.array_equal(ends[0].touch.pin_tips, ends[1].touch.pin_tips)


def test_it_slows_down_where_it_leans():
    """On a ball the sensor lags behind the normal; with shorter steps there it lags less, and takes more of them."""
    leans, counts = {}, {}
    for slow in (0.0, 2.0):
        world = World("sphere")
        top = np.array([0.0, 0, 60e-3])
        middle = (world.thing.T_base_object @ [*top, 1])[:3]
        route = PlanarPath(middle + np.array([[0.0, 0, 0], [8e-3, 0, 0]]), [0, 0, 1])
        explorer = world.explore(world.start(top), route, slowdown_angle_deg=slow)
        assert explorer.stopped_because == "route completed"
        following = [s for s in world.steps if s.phase == "follow"]
        leans[slow] = np.mean([np.degrees(np.linalg.norm(s.estimate.label[3:5])) for s in following])
        counts[slow] = len(following)
    assert leans[2.0] < 0.8 * leans[0.0]
    assert 1.2 * counts[0.0] < counts[2.0] < 5 * counts[0.0]


def test_the_housing_is_kept_off_the_object(monkeypatch):
    """How far it is, in closed form: over a plate, a leaning sensor's housing is nearest at the edge behind the tip."""
    world = World("plate")
    for lean_deg in (0.0, 40.0, 60.0):
        T = world.thing.T_base_object @ sensor_in_contact(from_mm_deg([0, 0, 0.5, lean_deg, 0, 0]))
        world.finger.arm_model.reset_to(T)
        lean = np.radians(lean_deg)
        height = 0.5e-3 + 20e-3 * np.cos(lean) - 22e-3 * np.sin(lean)
        assert world.finger.tip_state().clearance_m == pytest.approx(height, abs=1e-7)
    once = iter([1.0] * 10 + [-1e-3])
    monkeypatch.setattr(world.finger, "_clearance", lambda: next(once, 1.0))
    explorer = world.explore(world.start([0, 0, 0]), over(world), alignment_steps=5)
    assert [(e.kind, e.what) for e in explorer.events] == [
        ("collision", "the sensor's housing overlaps the object by 1.0 mm")
    ]
