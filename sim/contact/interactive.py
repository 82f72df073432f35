"""A tip that moves to commanded poses while in contact, so its skin keeps the shear of earlier motions."""

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.limits import MAX_DEPTH_M, check_motion
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.simulator import LEVER_M, ContactSimulator
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.sim.contact.tip_state import TipState, read_tip_state
from tactip_twin.sim.pose import path, turn_between
from tactip_twin.tactip_model.design import Design

_ABOVE_M = 1e-3
"""Gap between a lifted tip and the stimulus, m."""


class InteractiveContact:
    """A tip and a stimulus. The tip moves to the commanded pose at the fidelity's speed, a few time steps per call."""

    def __init__(self, design: Design, stimulus: str | Stimulus, fidelity: Fidelity, label: ArrayLike) -> None:
        """Place the tip clear of the stimulus, above a label.

        Args:
            design: The tip.
            stimulus: Name in stimuli.STIMULI, or a stimulus.
            fidelity: Mesh, steps and solver.
            label: (6,), m and rad, the first target.

        Raises:
            TactipError: The scene cannot be built, or `set_target` rejects the label.
        """
        self._simulator = ContactSimulator(design, stimulus, fidelity)
        self.scene = self._simulator.scene
        """The scene in its current state."""
        self._steps_at_rest = 0
        self.set_target(label)
        self.lift()

    def set_target(self, label: ArrayLike) -> None:
        """Set the target pose (6,), m and rad. Raise TactipError if it is out of reach; the old target is then kept."""
        check_motion(np.asarray(label, float), np.zeros(6), min(MAX_DEPTH_M, self.scene.stimulus.max_depth_m))
        self._target, self._steps_at_rest = np.array(label, float), 0

    def lift(self) -> None:
        """Move the tip, undeformed, clear of the stimulus and above its target, from where it descends without shear."""
        self.scene.reset()
        rise = max(0.0, self._simulator.lift(self._target)) + _ABOVE_M
        self._label, self._steps_at_rest = self._target + np.array([0, 0, rise, 0, 0, 0]), 0
        self._simulator.hold(self._label)

    @property
    def at_rest(self) -> bool:
        """Whether the tip is at its target and its skin at rest."""
        return self._steps_at_rest >= self.scene.fidelity.motion.settle_limit

    def advance(self, steps: int) -> TipState:
        """Simulate at most `steps` time steps and return the state after them.

        Raises:
            Diverged: The state diverged; only `lift` recovers from it.
        """
        motion = self.scene.fidelity.motion
        travel = np.linalg.norm(self._target[:3] - self._label[:3]) + LEVER_M * turn_between(self._label, self._target)
        step_m = self._simulator.shear_step_m if self.scene.data.ncon else self._simulator.press_step_m
        needed = int(np.ceil(travel / step_m))
        with counted_warnings():
            if needed:
                moves = min(steps, needed)
                labels = path(self._label, self._target, np.arange(moves + 1) / needed)
                self._simulator.move(labels)
                self._label, steps = (self._target if moves == needed else labels[-1]), steps - moves
            for _ in range(steps if not self.at_rest else 0):
                self._simulator.hold(self._label)
                slow = self.scene.max_vertex_speed() < motion.settle_speed_m_s
                settled = slow and self._steps_at_rest >= motion.settle_steps
                self._steps_at_rest = motion.settle_limit if settled else self._steps_at_rest + 1
                if self.at_rest:
                    break
        return self.tip_state()

    @property
    def label(self) -> np.ndarray:
        """Current pose (6,), m and rad (sim/pose.py)."""
        return self._label.copy()

    def tip_state(self) -> TipState:
        """Return the current state of the tip."""
        return read_tip_state(self.scene, self._simulator.reader)
