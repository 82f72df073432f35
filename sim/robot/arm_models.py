"""What carries the sensor: nothing but a wish, the arm's kinematics, or the arm with its masses and motors.

All of them go from pose to pose along shares of a way, a time step at a time, and say where the sensor is. `none` is where
it should be. `kinematic` goes straight in joint angles, within limits and speeds. `dynamic` adds what motors, masses and the
contact's force do to that: a model of the arm alone, in steps of its own, which gets the force on the tip from the contact
and gives back where the tip is. The two exchange at each time step, which is exact to what the arm moves in one.
"""

from abc import ABC, abstractmethod

import mujoco
import numpy as np

from tactip_twin.sim.pose import interpolate
from tactip_twin.sim.robot.irb120 import JOINTS, SPEEDS_RAD_S, Arm, Unreachable, arm_spec
from tactip_twin.tactip_model.errors import lookup

_LONGEST_SUBSTEP_S = 1e-3
"""Time step of the arm's model, s: a sixth of what its stiffest joint swings in."""


class ArmModel(ABC):
    """Carries the sensor."""

    pose: np.ndarray
    """T_base_tcp (4, 4): where the sensor is."""

    def told(self):
        """T_base_tcp (4, 4): where the arm's joint angles say that the sensor is. All that a controller may know."""
        return self.pose

    @property
    def angles(self):
        """Joint angles (6,), rad; not a number without an arm."""
        return np.full(6, np.nan)

    @abstractmethod
    def put(self, T_base_tcp, wrist_rad=0.0):
        """Be at a pose (4, 4), at rest, with joint 6 about wrist_rad. Raises Unreachable."""

    @abstractmethod
    def aim(self, T_base_tcp, steps, step_s) -> int:
        """Set out for a pose (4, 4) in `steps` time steps of `step_s`, or as many more as are needed: returns how many.

        Raises Unreachable, and stays as it is.
        """

    @abstractmethod
    def advance(self, share, step_s, force, torque):
        """Go to a share (0 to 1) of the way in one time step of step_s. force, torque: (3,) each, N and N m, on the tip
        about its apex in the base frame. Returns T_base_tcp (4, 4)."""


class IdealArm(ArmModel):
    """No arm: the sensor is where it should be, on a straight way."""

    def put(self, T_base_tcp, wrist_rad=0.0):
        """See Carrier."""
        self.pose = self._from = self._to = np.array(T_base_tcp, float)

    def aim(self, T_base_tcp, steps, step_s):
        """See Carrier."""
        self._from, self._to = self.pose, np.array(T_base_tcp, float)
        return steps

    def advance(self, share, step_s, force, torque):
        """See Carrier."""
        self.pose = interpolate(self._from, self._to, share)
        return self.pose


class KinematicArm(ArmModel):
    """The arm as its kinematics: joints go straight from angle to angle."""

    def __init__(self):
        self.arm = Arm()

    @property
    def angles(self):
        """See Carrier."""
        return self._angles

    def put(self, T_base_tcp, wrist_rad=0.0):
        """See Carrier."""
        self._be(self.arm.find(T_base_tcp, wrist_rad))

    def _be(self, angles):
        self._angles = self._from = self._to = angles
        self.pose = self.arm.forward(angles)

    def aim(self, T_base_tcp, steps, step_s):
        """See Carrier."""
        to = self.arm.near(T_base_tcp, self._to)
        least = np.abs((to - self._to) / SPEEDS_RAD_S).max() * _PEAK / step_s
        if least > _LONGEST_STEPS:
            raise Unreachable("the arm would have to turn right round to go on: it is close to singular")
        self._from, self._to = self._to, to
        return max(steps, int(np.ceil(least)))

    def advance(self, share, step_s, force, torque):
        """See Carrier."""
        self._angles = self._from + share * (self._to - self._from)
        self.pose = self.arm.forward(self._angles)
        return self.pose


_PEAK = 1.9
"""Greatest pace of a motion over its mean one (fidelity.Motion.ease_in and ease_out), with some room."""

_LONGEST_STEPS = 400
"""Time steps after which a small motion is no small one."""


class DynamicArm(KinematicArm):
    """The arm with its masses, motors and gravity."""

    def __init__(self):
        super().__init__()
        spec = arm_spec()
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model = spec.compile()
        """mujoco.MjModel."""
        self.data = mujoco.MjData(self.model)
        self._link = self.model.body("sensor").id
        self._site = self.model.site("tcp").id
        ids = [self.model.actuator(name).id for name in JOINTS]
        # What damping would hold back of a motion is asked for beforehand.
        self._lead_s = -self.model.actuator_biasprm[ids, 2] / self.model.actuator_gainprm[ids, 0]

    @property
    def angles(self):
        """See Carrier: as the joints' encoders tell them."""
        return self.data.qpos.copy()

    def _be(self, angles):
        super()._be(angles)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.data.ctrl[:] = angles
        self._wished = angles
        mujoco.mj_forward(self.model, self.data)

    def advance(self, share, step_s, force, torque):
        """See Carrier."""
        wished = self._from + share * (self._to - self._from)
        count = int(np.ceil(step_s / _LONGEST_SUBSTEP_S))
        self.model.opt.timestep = step_s / count
        speed = (wished - self._wished) / step_s
        for k in range(count):
            self.data.ctrl[:] = self._wished + (k + 1) / count * (wished - self._wished) + self._lead_s * speed
            self.data.qfrc_applied[:] = 0
            place = self.data.site_xpos[self._site]
            mujoco.mj_applyFT(self.model, self.data, force, torque, place, self._link, self.data.qfrc_applied)
            mujoco.mj_step(self.model, self.data)
        self._wished = wished
        self.pose = self.arm.forward(self.data.qpos)
        return self.pose


ARM_MODELS = {"none": IdealArm, "kinematic": KinematicArm, "dynamic": DynamicArm}
"""What can carry the sensor, by name."""


def arm_model_named(name):
    """A new Carrier. Raises TactipError that lists the names."""
    return lookup("arm", name, ARM_MODELS)()
