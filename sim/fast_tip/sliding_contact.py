"""A tip that slides over an object as the learned tip predicts; motions that cannot be trusted are simulated.

A simulated motion starts from the predicted deformation, so it costs no more than in a simulation. With `corrected`, every
predicted state is settled by a few steps of the simulation (corrected_contacts.py).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator, Diverged
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.sim.fast_tip.corrected_contacts import MAX_STEPS, MIN_STEPS
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder
from tactip_twin.sim.fast_tip.measures import forces_and_patch
from tactip_twin.sim.fast_tip.mesh_decoder import MeshDecoder
from tactip_twin.sim.fast_tip.overlap import dome_points, overlap_harmonics
from tactip_twin.sim.fast_tip.skin_field import SkinSampler
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, Steps, motion_between
from tactip_twin.sim.ground_truth import GroundTruth
from tactip_twin.sim.pose import angle_between, interpolate, label_of
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import neutral_pins

_MAX_TRAVEL_M, _MAX_TURN_RAD = 1.5e-3, np.radians(6.0)
"""Longest motion that is predicted in one step, m and rad: longer ones are divided. Most strides of the training sets are
shorter (sim/dataset/sliding.py)."""


@dataclass(frozen=True)
class SlidState:
    """State of the tip after a motion, in the sensor frame. (p pins, s vertices of the skin)"""

    pin_tips: np.ndarray
    """(p, 3) m."""
    directions: np.ndarray
    """(p, 3) unit, from the pins' roots to their tips."""
    skin: np.ndarray
    """(s, 3) m, vertices of the skin."""
    force_n: np.ndarray
    """(3,) N, force of the object on the tip."""
    penetration_m: float
    """Maximum penetration, m; NaN where it was predicted and not simulated."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s; likewise."""
    steps: int
    """Number of time steps that were simulated for it; 0 where it was predicted."""


class SlidingContact:
    """A tip and an object; the tip keeps its state from motion to motion."""

    def __init__(
        self,
        tip: SlidingTip,
        design: Design,
        stimulus: Stimulus,
        truth: GroundTruth,
        distance: Callable[[np.ndarray], np.ndarray],
        fidelity: Fidelity,
        corrected: bool = False,
    ) -> None:
        """Prepare the prediction; the simulation is built when it is first needed.

        Args:
            tip: The sliding tip.
            design: Design with the shape and the materials that the tip learned.
            stimulus: The object, for the simulation.
            truth: Poses on the object.
            distance: Signed distance (k,), m, to the object at points (k, 3), m, in its frame.
            fidelity: Fidelity of the simulation.
            corrected: Whether the simulation corrects what is predicted.

        Raises:
            TactipError: The design has another shape or other materials than those learned.
        """
        tip.check_design(design)
        self._tip, self._design, self._stimulus, self._truth = tip, design, stimulus, truth
        self._distance, self._fidelity, self._corrected = distance, fidelity, corrected
        self.mesh = build_mesh(design.shape, fidelity.mesh)
        """Undeformed mesh of the tip."""
        self._points = dome_points(design.shape.radius_m)
        self._pins = PinDecoder(design, tip.modes)
        self._meshes = MeshDecoder(self.mesh, fidelity.mesh.poisson_limit, tip.modes)
        self._rest = neutral_pins(design)
        self._built: ContactSimulator | None = None
        self._sampler: SkinSampler | None = None
        self.simulated_motions = 0
        """Number of motions that were simulated, because their prediction could not be trusted."""
        self.motions = 0
        """Number of motions in contact."""

    def reset_to(self, T_object_sensor: np.ndarray) -> None:
        """Place the sensor (4, 4) on the object, with the tip undeformed."""
        self._T = np.array(T_object_sensor, float)
        self._gap = float(self._distances(self._T).min())
        self._coefficients = np.zeros((1, len(self._tip.modes.orders)), np.complex64)
        self._state = self._undeformed()

    def state(self) -> SlidState:
        """Return the present state."""
        return self._state

    def move(self, T_object_sensor: np.ndarray) -> SlidState:
        """Move the sensor to a pose (4, 4) on a straight path, and return the state there.

        Raises:
            Diverged: A simulated motion diverged.
        """
        start, end = self._T, np.array(T_object_sensor, float)
        parts = np.linalg.norm(end[:3, 3] - start[:3, 3]) / _MAX_TRAVEL_M, angle_between(start, end) / _MAX_TURN_RAD
        count = max(1, int(np.ceil(max(parts))))
        steps = 0
        for k in range(1, count + 1):
            self._advance(end if k == count else interpolate(start, end, k / count), last=k == count)
            steps += self._state.steps
        self._state = SlidState(**(vars(self._state) | {"steps": steps}))
        return self._state

    def _advance(self, T: np.ndarray, last: bool) -> None:
        """Move to a pose (4, 4) in one step. last: whether its state will be read."""
        distances, before, touched = self._distances(T), self._T, self._gap < 0
        gap, self._T, old_gap = float(distances.min()), T, self._gap
        self._gap = gap
        if gap >= 0:
            self._coefficients = np.zeros_like(self._coefficients)
            self._state = self._undeformed()
            return
        self.motions += 1
        frame = self._truth.frame(T)
        motion = motion_between(before, T, frame)
        if not touched:
            # The shear is the part of the motion below the surface, without the approach itself.
            motion *= -gap / max(old_gap - gap, 1e-12)
            motion[2] = 0.0
        pose = self._truth.label(T)
        steps = Steps(pose[None], motion[None], overlap_harmonics(distances[None]), np.array([touched]))
        stepped = self._tip.step(steps, self._coefficients)
        if not stepped.trusted[0]:
            self._simulate(before, T)
            return
        coefficients, self._coefficients = self._coefficients, stepped.states
        vertices = self._meshes(stepped.states)[0]
        if self._corrected and last:
            if not self._correct(vertices, T):
                self._coefficients = coefficients
                self._simulate(before, T)
            return
        tips, directions = self._pins(stepped.states)
        force = forces_and_patch(stepped.measures, pose[None])["forces_n"][0]
        skin = vertices[: self.mesh.surface_count]
        self._state = SlidState(tips[0], directions[0], skin, force, float("nan"), float("nan"), 0)

    def _correct(self, vertices: np.ndarray, T: np.ndarray) -> bool:
        """Settle a predicted mesh (n, 3) at a pose (4, 4); return whether it then passes its checks."""
        limits, pose = QualityLimits().while_sliding(), label_of(T)
        self._simulator.start_from(vertices, pose)
        for contact in self._simulator.settle(pose, MAX_STEPS):
            if contact.steps >= MIN_STEPS and not contact.violations(limits):
                self._read_simulation(contact.steps)
                return True
        return False

    def _simulate(self, before: np.ndarray, T: np.ndarray) -> None:
        """Simulate the motion from a pose (4, 4), with the present deformation, to the next (4, 4)."""
        self.simulated_motions += 1
        self._simulator.start_from(self._meshes(self._coefficients)[0], label_of(before))
        contact = self._simulator.slide(label_of(T), self._truth.label(T))
        if not np.isfinite(contact.pin_tips).all():
            raise Diverged("the simulation diverged: the state of the tip is no longer finite")
        self._read_simulation(contact.steps)

    def _read_simulation(self, steps: int) -> None:
        """Take the state over from the simulation."""
        scene = self._simulator.scene
        skin = scene.vertices()[: self.mesh.surface_count]
        tips, directions = self._simulator.reader.read(skin)
        if self._sampler is None:
            self._sampler = SkinSampler(self.mesh)
        self._coefficients = self._tip.modes.coefficients(self._sampler.harmonics(skin[None])).astype(np.complex64)
        force, speed = scene.contact_force(), scene.max_vertex_speed()
        self._state = SlidState(tips, directions, skin, force, scene.penetration(), speed, steps)

    @property
    def _simulator(self) -> ContactSimulator:
        if self._built is None:
            self._built = ContactSimulator(self._design, self._stimulus, self._fidelity)
        return self._built

    def _distances(self, T: np.ndarray) -> np.ndarray:
        """Return the signed distances (k,), m, of the undeformed dome's points at a pose (4, 4) to the object."""
        return self._distance(self._points @ T[:3, :3].T + T[:3, 3])

    def _undeformed(self) -> SlidState:
        tips, directions = self._rest
        return SlidState(tips, directions, self.mesh.vertices[: self.mesh.surface_count], np.zeros(3), 0.0, 0.0, 0)
