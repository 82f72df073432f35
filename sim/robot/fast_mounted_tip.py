"""A learned tip that an arm model moves over an object: a servo's scene at a fraction of the simulation's time.

The arm model takes the force of the tip's last state throughout a motion, at the apex and without a torque, because a
prediction only tells the force at the end.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.tip_state import StoppedBy, TipState
from tactip_twin.sim.fast_tip.sliding_contact import SlidingContact, TouchedObject
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip
from tactip_twin.sim.ground_truth import GroundTruth
from tactip_twin.sim.pose import inverse
from tactip_twin.sim.robot.arm_models import ArmModel
from tactip_twin.sim.robot.mounted_tip import GIVE_M, TipOnArm, check_force
from tactip_twin.tactip_model.design import Design

_BACK_OFF = (0.75, 0.5, 0.25, 0.0)
"""Fractions of a motion to which the arm moves back, one after the other, while the force is too high or the housing in the
object."""


class FastMountedTip(TipOnArm):
    """A learned tip on an arm model, and an object."""

    def __init__(
        self,
        tip: SlidingTip,
        design: Design,
        solid: SignedDistanceMesh,
        fidelity: Fidelity,
        arm_model: ArmModel,
        T_base_object: ArrayLike,
        truth: GroundTruth,
    ) -> None:
        """Prepare the prediction.

        Args:
            tip: The sliding tip.
            design: Design of the sensor, which the tip must have learned.
            solid: Shape of the object, in the object's frame.
            fidelity: Fidelity of what the tip has learned and of the motions that are simulated.
            arm_model: Model that positions the sensor.
            T_base_object: (4, 4).
            truth: Poses of the sensor on the object.

        Raises:
            TactipError: The design has another shape or other materials than those learned.
        """
        super().__init__(design, solid, fidelity, arm_model, T_base_object)
        touched = TouchedObject(SolidStimulus(solid), truth, solid.distance)
        self.sliding = SlidingContact(tip, design, touched, fidelity)
        """The tip on the object, which counts the motions that were simulated."""
        self.mesh = self.sliding.mesh

    def _reset(self) -> None:
        self.sliding.reset_to(self._sensor())

    def _sensor(self) -> np.ndarray:
        """Return T_object_sensor (4, 4)."""
        return inverse(self.T_base_object) @ self.arm_model.pose

    def go(self, T_base_tcp: np.ndarray, max_force_n: float = np.inf) -> TipState:
        """Move to a pose and settle there: see TipOnArm. Forces on the way are unknown, so the arm moves back from the end
        of its path where the force there is too high, or the housing in the object."""
        motion, limit, give = self._motion, max(max_force_n, self._force_n()), max(GIVE_M, self._overlap())
        fractions = self._set_target(T_base_tcp, motion.shear_step_m, 1.0)
        with counted_warnings() as messages:
            self._move(fractions)
            peak_n = self._force_n()
            stopped_by: StoppedBy = ""
            for back in _BACK_OFF:
                if self._force_n() > limit:
                    stopped_by = "force"
                elif self._overlap() > give:
                    stopped_by = stopped_by or "housing"
                else:
                    break
                self._move(fractions[: 1 + int(back * (len(fractions) - 1))][-1:])
        check_force(self.sliding.contact.force_n)
        self.warnings += len(messages)
        return replace(self.tip_state(), peak_force_n=peak_n, stopped_by=stopped_by)

    def _force_n(self) -> float:
        """Return the magnitude of the contact force, N."""
        return float(np.linalg.norm(self.sliding.contact.force_n))

    def _move(self, fractions: np.ndarray) -> None:
        """Move the arm through fractions (n,) of its path, settle at the last one, and predict the tip there."""
        motion, force = self._motion, self.arm_model.pose[:3, :3] @ self.sliding.contact.force_n
        for fraction in (*fractions, *[fractions[-1]] * motion.pause_steps):
            self.arm_model.advance(fraction, motion.step_s, force, np.zeros(3))
        self.sliding.move(self._sensor())

    def tip_state(self) -> TipState:
        """Return the tip's present state."""
        contact = self.sliding.contact
        return TipState(
            pin_tips=contact.pin_tips,
            directions=contact.directions,
            skin=self.sliding.skin(),
            force=contact.force_n,
            penetration_m=contact.penetration_m,
            speed_m_s=contact.speed_m_s,
            steps=contact.steps,
            clearance_m=self._clearance(),
        )
