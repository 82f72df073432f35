"""Objects that move while a tip on an arm touches them: their motion, and tips that take part in it.

The motion is that of Lloyd & Lepora [R], "Pose-and-shear-based tactile servoing" (IJRR 2024): sinusoids in all six axes at
once, about the place of the object at the start.
"""

from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.pose import from_mm_deg, interpolate, inverse, matrix
from tactip_twin.sim.robot.arm_models import ArmModel
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.object_motion import ObjectMotion
from tactip_twin.tactip_model.mesh import Mesh

_PHASES_RAD = np.radians([0.0, 90.0, 180.0, 45.0, 135.0, 270.0])
"""Phases of the axes, rad [?]: with different ones, the object also turns while it is far away."""


def moved_object(T_base_object: np.ndarray, pivot: np.ndarray, motion: ObjectMotion, seconds: float) -> np.ndarray:
    """Return the pose (4, 4) of a moving object at a time.

    Args:
        T_base_object: (4, 4), its pose at the start.
        pivot: (3,), m, base frame: the point about which it turns at the start.
        motion: Its motion.
        seconds: Time since the start, s.
    """
    u = min(max(seconds / motion.ramp_s, 0.0), 1.0)
    swing = u**2 * (3 - 2 * u) * np.sin(2 * np.pi * seconds / motion.period_s + _PHASES_RAD)
    moved = from_mm_deg(swing * ([motion.amplitude_mm] * 3 + [motion.amplitude_deg] * 3))
    turn = Rotation.from_rotvec(moved[3:])
    return matrix(moved[:3] + pivot - turn.apply(pivot), turn) @ T_base_object


class TipOnMovingObject(Protocol):
    """A tip on an arm model, and an object that moves during the tip's next motion."""

    arm_model: ArmModel
    T_base_object: np.ndarray
    mesh: Mesh

    def tip_state(self) -> TipState:
        """See TipOnArm."""
        ...

    def reset_to(self, T_base_tcp: np.ndarray, wrist_rad: float = 0.0) -> None:
        """See TipOnArm."""
        ...

    def move_object(self, T_base_object: np.ndarray) -> None:
        """Set where the object (4, 4) goes during the next motion of the tip."""
        ...

    def go(self, T_base_tcp: np.ndarray) -> TipState:
        """See TipOnArm."""
        ...


class MovingMountedTip(MountedTip):
    """A simulated tip on an arm model, and an object that moves with every time step."""

    T_base_object: np.ndarray
    """(4, 4), present pose of the object."""

    _motion_of_object: tuple[np.ndarray, np.ndarray] | None = None
    """Poses (4, 4) of the object at the ends of the next motion of the tip; None: it stands still."""

    _fraction: float = 0.0
    """Fraction of the next motion at the end of the present time step."""

    def move_object(self, T_base_object: np.ndarray) -> None:
        """Set where the object (4, 4) goes: see TipOnMovingObject."""
        self._motion_of_object = self.T_base_object, np.array(T_base_object, float)

    def _step(self, fraction: float) -> float:
        self._fraction = fraction
        return super()._step(fraction)

    def _place(self, before: np.ndarray, after: np.ndarray | None = None, h: float = 1.0) -> None:
        if after is None or self._motion_of_object is None:
            super()._place(before, after, h)
            return
        # In the frame of the object's present pose, the sensor ends where it would if the object stood still.
        T_next = interpolate(*self._motion_of_object, self._fraction)
        super()._place(before, self.T_base_object @ inverse(T_next) @ after, h)
        self.T_base_object = T_next


class MovingFastTip(FastMountedTip):
    """A learned tip on an arm model, and an object that moves between its states: only relative motions matter to it."""

    T_base_object: np.ndarray
    """(4, 4), present pose of the object."""

    def move_object(self, T_base_object: np.ndarray) -> None:
        """Set where the object (4, 4) goes: see TipOnMovingObject."""
        self.T_base_object = np.array(T_base_object, float)
