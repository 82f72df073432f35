"""A tip on an arm that follows an object, with the ground truth as estimator, and estimators that fail."""

import time
from dataclasses import replace

import numpy as np
import trimesh

from tactip_twin.control.estimator import Estimate, Estimator, Oracle
from tactip_twin.control.follow import ContourFollower
from tactip_twin.control.options import Settings
from tactip_twin.control.routes import PlanarPath
from tactip_twin.control.servo import FREE_AXES, Gains, Servo
from tactip_twin.learning.labels import Labels
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import Edge, load_object
from tactip_twin.tactip_model.presets import load_design

SURFACE = Labels("surface", (-5, -15, -15), (-1, 15, 15))
EDGE = Labels("edge", (-5, -5, -15, -15, -45), (5, -1, 15, 15, 45))


BRISK = {"max_skips": 1, "skip_mm": 8.0, "clearance_mm": 4.0}
"""Settings with few and long skips."""


SKETCH = replace(fidelity_named("draft"), mesh=replace(fidelity_named("draft").mesh, surface_m=5e-3, rim_m=7e-3))
"""`draft` on a mesh of 98 vertices instead of 245. The force of a contact differs by a twentieth, which a follower does not
notice, and a step takes half the time."""


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
            design, self.scene_object.solid, SKETCH, self.arm_model, self.scene_object.T_base_object
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

    def follow(self, T, route, estimator=None, pose_filter=None, servo=Servo, **settings):
        follower = ContourFollower(
            self.mounted_tip,
            estimator or self.oracle,
            servo(Gains(), 3.0, FREE_AXES[self.labels.task]),
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


def over(world, length_m=0.012):
    """Return a straight path over the middle of an object."""
    middle = world.scene_object.T_base_object[:3, 3]
    return PlanarPath([middle, middle + [length_m, 0, 0]], [0, 0, 1])


def beside(world, x_m, length_m):
    """Return a straight path from a place x_m off the middle of an object."""
    start = world.scene_object.T_base_object[:3, 3] + [x_m, 0, 0]
    return PlanarPath([start, start + [length_m, 0, 0]], [0, 0, 1])


def rim_world(rim):
    """Return the world of a rim."""
    vertices, triangles = rim.mesh()
    turn = np.linspace(0, 2 * np.pi, 721)
    edge = Edge(rim.edge(turn) / 1e3, rim.frames(turn)[1], closed=True)
    return World(trimesh.Trimesh(vertices / 1e3, triangles, process=False), task="edge", edge=edge)


class NoisyOracle:
    """The ground truth with noise, and the noise's deviations."""

    deviations = from_mm_deg([0, 0, 0.2, 3.0, 3.0, 0])

    def __init__(self, oracle):
        self._oracle, self._rng = oracle, np.random.default_rng(0)

    def estimate(self, touch, T_base_tcp):
        estimate = self._oracle.estimate(touch, T_base_tcp)
        noisy = estimate.label + self._rng.normal(0, 1, 6) * self.deviations
        return replace(estimate, label=noisy, deviations=self.deviations)


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


class Shallow(Oracle):
    """What an image tells of a tip between two flanks: a shallow contact; and the force."""

    def estimate(self, touch, T_base_tcp):
        estimate = super().estimate(touch, T_base_tcp)
        label = np.clip(to_mm_deg(estimate.label), [0, 0, -5, -15, -15, 0], [0, 0, -0.6, 15, 15, 0])
        return replace(estimate, label=from_mm_deg(label), force_n=float(np.linalg.norm(touch.force)))


class Held(Oracle):
    """What an image tells of a tip that another part of the object holds: the depth stays as the tip moves back; and the
    force."""

    held, step = range(16, 26), -1

    def estimate(self, touch, T_base_tcp):
        self.step += 1
        estimate = replace(super().estimate(touch, T_base_tcp), deviations=from_mm_deg([0, 0, 0.6, 1, 1, 0]), force_n=0.5)
        if self.step not in self.held:
            return estimate
        return replace(estimate, label=from_mm_deg([0, 0, -1.0, 0, 0, 0]), touching=1.0, force_n=3.0)
