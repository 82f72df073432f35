"""A learned tip that moves to commanded poses on a stimulus: InteractiveContact in a fraction of its time."""

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.interactive import InteractiveContact
from tactip_twin.sim.contact.simulator import LEVER_M
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.dataset.sliding import ground_truth_on
from tactip_twin.sim.fast_tip.sliding_contact import SlidingContact, TouchedObject
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip
from tactip_twin.sim.pose import path, sensor_in_contact, turn_between
from tactip_twin.tactip_model.design import Design


class FastInteractiveContact(InteractiveContact):
    """A learned tip and the stimulus of its task. Motions that cannot be trusted are simulated."""

    def __init__(
        self, tip: SlidingTip, design: Design, fidelity: Fidelity, label: ArrayLike, corrected: bool = False
    ) -> None:
        """Place the tip clear of the stimulus, above a label.

        Args:
            tip: The sliding tip; its task is the stimulus.
            design: Design with the shape and the materials that the tip learned.
            fidelity: Fidelity of what the tip has learned, and of what is simulated.
            label: (6,), m and rad, the first target.
            corrected: Whether the simulation corrects what is predicted.

        Raises:
            TactipError: The design is not that of the tip, or `set_target` rejects the label.
        """
        self._sliding: SlidingContact | None = None
        super().__init__(design, tip.task, fidelity, label)
        stimulus = self.scene.stimulus
        touched = TouchedObject(stimulus, ground_truth_on(tip.task), stimulus.distance)
        self._sliding = SlidingContact(tip, design, touched, fidelity, corrected)
        self.lift()

    def lift(self) -> None:
        """Move the tip, undeformed, clear of the stimulus and above its target: see InteractiveContact."""
        super().lift()
        if self._sliding:
            self._sliding.reset_to(sensor_in_contact(self._label))

    @property
    def at_rest(self) -> bool:
        """Whether the tip is at its target."""
        return bool(np.array_equal(self._label, self._target))

    def advance(self, steps: int) -> TipState:
        """Move as far as in `steps` time steps of the simulation, and return the state there. Raises Diverged."""
        if self._sliding and not self.at_rest:
            travel = np.linalg.norm(self._target[:3] - self._label[:3]) + LEVER_M * turn_between(self._label, self._target)
            fraction = min(1.0, steps * self._simulator.shear_step_m / float(travel))
            self._label = self._target if fraction == 1 else path(self._label, self._target, [fraction])[0]
            self._sliding.move(sensor_in_contact(self._label))
        return self.tip_state()

    def tip_state(self) -> TipState:
        """Return the current state of the tip."""
        if self._sliding is None:
            return super().tip_state()
        contact = self._sliding.contact
        return TipState(
            pin_tips=contact.pin_tips,
            directions=contact.directions,
            skin=self._sliding.skin(),
            force=contact.force_n,
            penetration_m=contact.penetration_m,
            speed_m_s=contact.speed_m_s,
            steps=contact.steps,
        )
