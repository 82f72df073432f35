"""Arm models that position the sensor: ideal (no arm), kinematic, or dynamic.

Each moves from pose to pose, a time step at a time, and returns the sensor's pose. `none` follows the commanded path
exactly. `kinematic` moves the joints along straight lines in joint space, within their limits and speeds. `dynamic` adds
motors, masses and the contact force: a MuJoCo model of the arm alone, with its own time steps, which takes the force on the
tip from the contact model and returns the tip's pose. The two models are coupled once per time step, so the coupling is
exact up to the arm's motion in one step.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.pose import interpolate
from tactip_twin.sim.robot.irb120 import JOINTS, MAX_SPEEDS_RAD_S, Arm, Unreachable, arm_spec
from tactip_twin.tactip_model.errors import lookup

_MAX_SUBSTEP_S = 1e-3
"""Longest time step of the arm's own model, s: a sixth of the period of its stiffest joint."""

_PEAK_SPEED_RATIO = 1.9
"""Upper bound on a motion's peak speed over its mean speed (fidelity.Motion.ease_in and ease_out), -."""

_MAX_STEPS = 400
"""Time steps above which a small motion is refused, because the joints turn too far for it."""


class ArmModel(ABC):
    """A model of what positions the sensor."""

    pose: np.ndarray
    """T_base_tcp (4, 4): the sensor's true pose."""

    def measured_pose(self) -> np.ndarray:
        """Return T_base_tcp (4, 4) by forward kinematics of the measured joint angles: all that a controller knows."""
        return self.pose

    @property
    def angles(self) -> np.ndarray:
        """Measured joint angles (6,), rad; NaN without an arm."""
        return np.full(6, np.nan)

    @abstractmethod
    def reset_to(self, T_base_tcp: ArrayLike, wrist_rad: float = 0.0) -> None:
        """Place the sensor at a pose, at rest.

        Args:
            T_base_tcp: (4, 4).
            wrist_rad: Desired angle of joint 6, rad; of its whole turns, the nearest is taken.

        Raises:
            Unreachable: If the arm cannot take the pose.
        """

    @abstractmethod
    def set_target(self, T_base_tcp: ArrayLike, steps: int, step_s: float) -> int:
        """Set the pose that the next calls of `advance` move to.

        Args:
            T_base_tcp: (4, 4).
            steps: Number of time steps to get there.
            step_s: Time step, s.

        Returns:
            Number of time steps that the motion takes: `steps`, or more where the joints need them.

        Raises:
            Unreachable: If the arm cannot take the pose; the model is left unchanged.
        """

    @abstractmethod
    def advance(self, fraction: float, step_s: float, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Move to a fraction of the path to the target in one time step.

        Args:
            fraction: 0 to 1, of the path from the last pose to the target.
            step_s: Time step, s.
            force: (3,) N, on the tip, base frame.
            torque: (3,) N m, on the tip about its apex, base frame.

        Returns:
            T_base_tcp (4, 4), the sensor's true pose.
        """


class IdealArm(ArmModel):
    """No arm: the sensor follows the commanded straight path exactly."""

    def reset_to(self, T_base_tcp: ArrayLike, wrist_rad: float = 0.0) -> None:
        """Place the sensor: see ArmModel."""
        self.pose = self._from = self._to = np.array(T_base_tcp, float)

    def set_target(self, T_base_tcp: ArrayLike, steps: int, step_s: float) -> int:
        """Set the target: see ArmModel."""
        self._from, self._to = self.pose, np.array(T_base_tcp, float)
        return steps

    def advance(self, fraction: float, step_s: float, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Move towards the target: see ArmModel."""
        self.pose = interpolate(self._from, self._to, fraction)
        return self.pose


class KinematicArm(ArmModel):
    """The arm's kinematics alone: joints move along straight lines in joint space."""

    def __init__(self) -> None:
        self.arm = Arm()

    @property
    def angles(self) -> np.ndarray:
        """Joint angles (6,), rad."""
        return self._angles

    def reset_to(self, T_base_tcp: ArrayLike, wrist_rad: float = 0.0) -> None:
        """Place the sensor: see ArmModel."""
        self._set_angles(self.arm.solve(np.asarray(T_base_tcp, float), wrist_rad))

    def _set_angles(self, angles: np.ndarray) -> None:
        self._angles = self._from = self._to = self._commanded = angles
        self.pose = self.arm.forward(angles)

    def set_target(self, T_base_tcp: ArrayLike, steps: int, step_s: float) -> int:
        """Set the target: see ArmModel."""
        # The last motion may have been stopped on its way.
        to = self.arm.solve_near(np.asarray(T_base_tcp, float), self._commanded)
        min_steps = np.abs((to - self._commanded) / MAX_SPEEDS_RAD_S).max() * _PEAK_SPEED_RATIO / step_s
        if min_steps > _MAX_STEPS:
            raise Unreachable("the joints would have to turn too far for this motion: the arm is close to a singularity")
        self._from, self._to = self._commanded, to
        return max(steps, int(np.ceil(min_steps)))

    def advance(self, fraction: float, step_s: float, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Move towards the target: see ArmModel."""
        self._angles = self._commanded = self._from + fraction * (self._to - self._from)
        self.pose = self.arm.forward(self._angles)
        return self.pose


class DynamicArm(KinematicArm):
    """The arm with its masses, motors and gravity."""

    def __init__(self) -> None:
        super().__init__()
        spec = arm_spec()
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model: mujoco.MjModel = spec.compile()
        """The arm's own model."""
        self.data = mujoco.MjData(self.model)
        self._link = self.model.body("sensor").id
        self._site = self.model.site("tcp").id
        ids = [self.model.actuator(name).id for name in JOINTS]
        # The joints' damping delays a motion by this time, so the commands lead by it.
        self._lead_s = -self.model.actuator_biasprm[ids, 2] / self.model.actuator_gainprm[ids, 0]

    @property
    def angles(self) -> np.ndarray:
        """Joint angles (6,), rad, as the joints' encoders measure them."""
        return self.data.qpos.copy()

    def _set_angles(self, angles: np.ndarray) -> None:
        super()._set_angles(angles)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.data.ctrl[:] = angles
        mujoco.mj_forward(self.model, self.data)

    def advance(self, fraction: float, step_s: float, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Move towards the target under the motors, masses and the contact force: see ArmModel."""
        commanded = self._from + fraction * (self._to - self._from)
        count = int(np.ceil(step_s / _MAX_SUBSTEP_S))
        self.model.opt.timestep = step_s / count
        speed = (commanded - self._commanded) / step_s
        for k in range(count):
            reached = self._commanded + (k + 1) / count * (commanded - self._commanded)
            self.data.ctrl[:] = reached + self._lead_s * speed
            self.data.qfrc_applied[:] = 0
            apex = self.data.site_xpos[self._site]
            mujoco.mj_applyFT(self.model, self.data, force, torque, apex, self._link, self.data.qfrc_applied)
            mujoco.mj_step(self.model, self.data)
        self._commanded = commanded
        self.pose = self.arm.forward(self.data.qpos)
        return self.pose


ARM_MODELS: dict[str, Callable[[], ArmModel]] = {"none": IdealArm, "kinematic": KinematicArm, "dynamic": DynamicArm}
"""Arm models by name (arm_names.ArmName)."""


def arm_model_named(name: str) -> ArmModel:
    """Return a new arm model. Raises TactipError that lists the names."""
    return lookup("arm", name, ARM_MODELS)()
