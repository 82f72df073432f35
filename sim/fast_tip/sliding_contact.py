"""A tip that slides over an object as the learned tip predicts; motions that cannot be trusted are simulated.

A simulated motion starts from the predicted deformation, so it costs no more than in a simulation. With `corrected`, every
predicted state is settled by a few steps of the simulation (corrected_contacts.py).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.rigid_points import RigidPoints
from tactip_twin.sim.contact.simulator import ContactSimulator, Diverged
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.sim.fast_tip.corrected_contacts import MAX_STEPS, MIN_STEPS
from tactip_twin.sim.fast_tip.fast_contacts import predicted_contact
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder
from tactip_twin.sim.fast_tip.measures import forces_and_patch
from tactip_twin.sim.fast_tip.mesh_decoder import MeshDecoder
from tactip_twin.sim.fast_tip.overlap import NEAR_M, dome_points, overlap_harmonics
from tactip_twin.sim.fast_tip.skin_field import SkinSampler
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, Steps, motion_between
from tactip_twin.sim.ground_truth import GroundTruth
from tactip_twin.sim.pose import angle_between, interpolate, label_of, shear_between
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import neutral_pins

_MAX_TRAVEL_M, _MAX_TURN_RAD = 1.5e-3, np.radians(6.0)
"""Longest motion that is predicted in one step, m and rad: longer ones are divided. Most strides of the training sets are
shorter (sim/dataset/sliding.py)."""


def parts_of(start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """Return the poses (4, 4) after each step of a straight motion between two poses (4, 4); the last is the end."""
    parts = np.linalg.norm(end[:3, 3] - start[:3, 3]) / _MAX_TRAVEL_M, angle_between(start, end) / _MAX_TURN_RAD
    count = max(1, int(np.ceil(max(parts))))
    return [*(interpolate(start, end, k / count) for k in range(1, count)), end]


DOME_GROUPS = 48
"""Number of groups of the dome's points: more of them leave out more points, and cost a query each [M]."""


def motion_below(motion: np.ndarray, old_gap_m: float, gap_m: float) -> np.ndarray:
    """Return the part of a motion (6,) below the surface, without the approach itself: the shear of a tip that touches down.

    Args:
        motion: The whole motion, m and rad.
        old_gap_m: Distance of the undeformed tip to the object before, m; infinite for a tip that is pressed in place.
        gap_m: That after the motion, m, negative.
    """
    sheared = motion * (-gap_m / max(old_gap_m - gap_m, 1e-12))
    sheared[2] = 0.0
    return sheared


@dataclass(frozen=True)
class TouchedObject:
    """An object that a tip slides over."""

    stimulus: Stimulus
    """The object for the simulation."""
    truth: GroundTruth
    """Poses of a sensor on it."""
    distance: Callable[[np.ndarray], np.ndarray]
    """Signed distance (k,), m, to it at points (k, 3), m, in its frame."""


class SlidingContact:
    """A tip and an object; the tip keeps its state from motion to motion."""

    def __init__(
        self, tip: SlidingTip, design: Design, touched: TouchedObject, fidelity: Fidelity, corrected: bool = False
    ) -> None:
        """Prepare the prediction; the simulation is built when it is first needed.

        Args:
            tip: The sliding tip.
            design: Design with the shape and the materials that the tip learned.
            touched: The object.
            fidelity: Fidelity of the simulation.
            corrected: Whether the simulation corrects what is predicted.

        Raises:
            TactipError: The design has another shape or other materials than those learned.
        """
        tip.check_design(design)
        self._tip, self._design, self.touched = tip, design, touched
        self._fidelity, self._corrected = fidelity, corrected
        self.mesh = build_mesh(design.shape, fidelity.mesh)
        """Undeformed mesh of the tip."""
        self._dome = RigidPoints(dome_points(design.shape.radius_m), DOME_GROUPS)
        self._pins = PinDecoder(design, tip.modes)
        self._meshes = MeshDecoder(self.mesh, fidelity.mesh.poisson_limit, tip.modes)
        self._undeformed = _undeformed(design)
        self._built: ContactSimulator | None = None
        self._sampler = SkinSampler(self.mesh)
        self.simulated_motions = 0
        """Number of motions that were simulated, because their prediction could not be trusted."""
        self.motions = 0
        """Number of motions in contact."""

    def reset_to(self, T_object_sensor: np.ndarray) -> None:
        """Place the sensor (4, 4) on the object, with the tip undeformed."""
        self._T = self._T_start = np.array(T_object_sensor, float)
        self._gap = float(self._distances(self._T).min())
        self._lift_off()

    def touch_down(self, T_before: np.ndarray, T: np.ndarray) -> Contact | None:
        """Press at a pose, and shear to the next, both (4, 4). Return the contact; None if it cannot be trusted."""
        self.reset_to(T_before)
        distances = self._distances(T)
        stepped, pose = self._predict(distances, T, motion_between(T_before, T, self.touched.truth.frame(T)), touched=False)
        self._gap, self._T = float(distances.min()), T
        self.motions += 1
        return self.contact if stepped and self._accept(stepped, pose, T) else None

    def take_over(self, contact: Contact, skin: np.ndarray) -> None:
        """Continue from a simulated contact with skin vertices (s, 3), m, at the pose of the last `touch_down`."""
        self._coefficients = self._tip.modes.coefficients(self._sampler.harmonics(skin[None])).astype(np.complex64)
        self.contact, self._skin = contact, skin

    def move(self, T_object_sensor: np.ndarray) -> Contact:
        """Move the sensor to a pose (4, 4) on a straight path, and return the contact there.

        Its pose is the label on the object, its shear the whole motion since it touched down, and its steps are those that
        were simulated; measures that only a simulation has are NaN where it was predicted.

        Raises:
            Diverged: A simulated motion diverged.
        """
        steps, parts = 0, parts_of(self._T, np.array(T_object_sensor, float))
        for k, T in enumerate(parts):
            self._advance(T, last=k == len(parts) - 1)
            steps += self.contact.steps
        self.contact = replace(self.contact, steps=steps)
        return self.contact

    def skin(self) -> np.ndarray:
        """Return the vertices (s, 3), m, of the skin, in the sensor frame."""
        return self._skin

    def _advance(self, T: np.ndarray, last: bool) -> None:
        """Move to a pose (4, 4) in one step. last: whether its state will be read."""
        distances, before, old_gap = self._distances(T), self._T, self._gap
        self._gap, self._T, touched = float(distances.min()), T, old_gap < 0
        if self._gap >= 0:
            self._T_start = T
            self._lift_off()
            return
        self.motions += 1
        motion = motion_between(before, T, self.touched.truth.frame(T))
        motion = motion if touched else motion_below(motion, old_gap, self._gap)
        coefficients = self._coefficients
        stepped, pose = self._predict(distances, T, motion, touched)
        if stepped is None or not self._accept(stepped, pose, T, last):
            self._coefficients = coefficients
            self._simulate(before, T, pose)

    def _predict(
        self, distances: np.ndarray, T: np.ndarray, motion: np.ndarray, touched: bool
    ) -> tuple[tuple[np.ndarray, np.ndarray] | None, np.ndarray]:
        """Return states (1, n) and measures (1, 8) after a step to a pose (4, 4), None if untrusted; and its label (6,)."""
        pose = self.touched.truth.label(T)
        steps = Steps(pose[None], motion[None], overlap_harmonics(distances[None]), np.array([touched]))
        stepped = self._tip.step(steps, self._coefficients)
        return ((stepped.states, stepped.measures) if stepped.trusted[0] else None), pose

    def _accept(self, stepped: tuple[np.ndarray, np.ndarray], pose: np.ndarray, T: np.ndarray, last: bool = True) -> bool:
        """Take over a predicted step, corrected if it is to be; return whether it passes its checks."""
        self._coefficients, measures = stepped
        measured = {name: value[0] for name, value in forces_and_patch(measures, pose[None]).items()}
        if self._corrected and last:
            return self._correct(pose, T, float(measured["slip_fractions"]))
        tips, directions = self._pins(self._coefficients)
        shear = shear_between(label_of(self._T_start), label_of(T))
        self.contact = predicted_contact(pose, shear, tips[0], directions[0], measured)
        self._skin = self._meshes.skin(self._coefficients)[0]
        return True

    def _correct(self, pose: np.ndarray, T: np.ndarray, slip_fraction: float) -> bool:
        """Settle the predicted mesh at a pose (4, 4) with a label (6,); return whether it then passes its checks."""
        limits, there = QualityLimits().while_sliding(), label_of(T)
        vertices = self._meshes(self._coefficients)[0]
        self._simulator.start_from(vertices, there, shear_between(label_of(self._T_start), there))
        contact = self._simulator.settle(there, limits, MIN_STEPS, MAX_STEPS, pose)
        if contact is not None:
            self.take_over(replace(contact, slip_fraction=slip_fraction), self._simulated_skin())
        return contact is not None

    def _simulate(self, before: np.ndarray, T: np.ndarray, pose: np.ndarray) -> None:
        """Simulate the motion from a pose (4, 4), with the present deformation, to the next (4, 4), with its label (6,)."""
        self.simulated_motions += 1
        vertices, there = self._meshes(self._coefficients)[0], label_of(before)
        self._simulator.start_from(vertices, there, shear_between(label_of(self._T_start), there))
        contact = self._simulator.slide(label_of(T), pose)
        if not np.isfinite(contact.pin_tips).all():
            raise Diverged("the simulation diverged: the state of the tip is no longer finite")
        self.take_over(contact, self._simulated_skin())

    def _simulated_skin(self) -> np.ndarray:
        return self._simulator.scene.vertices()[: self.mesh.surface_count]

    @property
    def _simulator(self) -> ContactSimulator:
        if self._built is None or self._built.scene.stimulus is not self.touched.stimulus:
            self._built = ContactSimulator(self._design, self.touched.stimulus, self._fidelity)
        return self._built

    def _distances(self, T: np.ndarray) -> np.ndarray:
        """Return the signed distances (k,), m, of the undeformed dome's points at a pose (4, 4) to the object.

        Those of points that do not count for the overlap are lower bounds.
        """
        return self._dome.distances(self.touched.distance, T, NEAR_M)

    def _lift_off(self) -> None:
        """Make the tip undeformed."""
        self._coefficients = np.zeros((1, len(self._tip.modes.orders)), np.complex64)
        self.contact, self._skin = self._undeformed, self.mesh.vertices[: self.mesh.surface_count]


def _undeformed(design: Design) -> Contact:
    """Return the record of a tip that touches nothing."""
    none = {
        "normal_forces_n": 0.0,
        "tangential_forces_n": 0.0,
        "forces_n": np.zeros(3),
        "effective_shears": np.zeros(6),
        "slip_fractions": 0.0,
        "contact_areas_m2": 0.0,
    }
    contact = predicted_contact(np.zeros(6), np.zeros(6), *neutral_pins(design), none)
    return replace(contact, penetration_m=0.0, speed_m_s=0.0)
