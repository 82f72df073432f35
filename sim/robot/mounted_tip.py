"""A soft tip that is carried over an object, and goes on from where it is: the scene of a servo.

The tip stays fixed in its world and the object moves, as in the data-set scene: a tip that hung on an arm in MuJoCo would
cost several times as much a step. What carries it (sim/robot/arm_models.py) says where it is.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.simulator import LEVER_M, Diverged, motion_fractions
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.tip_state import read_tip_state
from tactip_twin.sim.pose import angle_between, inverse
from tactip_twin.sim.robot.irb120 import housing_points
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import PinReader

_CLEAR_M = 0.5e-3
"""Gap between tip and object that counts as clear, m."""


class MountedTip:
    """A tip, an object, and what carries the one over the other."""

    def __init__(self, design, solid, fidelity, carrier, T_base_object, settle_steps=None, pace=1.0):
        """design: Design. solid: Solid. fidelity: Fidelity. carrier: ArmModel. T_base_object: (4, 4), where the solid is.

        settle_steps: int, time steps at rest before a touch is taken; the fidelity's Motion.pause_steps if None. pace:
        float, way a time step over the fidelity's.
        Raises TactipError on what cannot be built.
        """
        self.scene = Scene(design, SolidStimulus(solid), fidelity)
        self.carrier, self.T_base_object = carrier, np.array(T_base_object, float)
        self._solid, self._radius = solid, design.shape.radius_m
        self._reader = PinReader(design, self.scene.mesh)
        self._settle = fidelity.motion.pause_steps if settle_steps is None else settle_steps
        self._pace = pace
        self._housing = housing_points(self._radius)
        self._since = 0
        self.warnings = 0
        """MuJoCo's warnings so far."""

    def put(self, T_base_tcp, wrist_rad=0.0):
        """Begin at a pose (4, 4) with the tip undeformed, and joint 6 about wrist_rad, rad.

        Raises Unreachable, and TactipError where the tip is not clear.
        """
        if self.gap(T_base_tcp) < 0:
            raise TactipError("the tip cannot begin inside of the object: begin further off")
        self.carrier.put(T_base_tcp, wrist_rad)
        self._undeform()

    def gap(self, T_base_tcp):
        """Distance (m) from the undeformed dome at a pose (4, 4) to the object; negative where they overlap."""
        T = inverse(self.T_base_object) @ T_base_tcp
        centre = (T @ [0, 0, -self._radius, 1])[:3]
        # The dome is the sphere's outer half; behind it is the housing, as wide.
        back = T[:3, 3] - np.outer(np.linspace(self._radius, 3 * self._radius, 9), T[:3, 2])
        return float(min(self._solid.distance(centre[None])[0], self._solid.distance(back).min()) - self._radius)

    def go(self, T_base_tcp):
        """Go to a pose (4, 4) at the fidelity's pace, in contact or not, and come to rest there. Returns a TipState.

        Raises Unreachable, without having moved, and Diverged.
        """
        motion, here = self.scene.fidelity.motion, self.carrier.pose
        travel = np.linalg.norm(T_base_tcp[:3, 3] - here[:3, 3]) + LEVER_M * angle_between(here, T_base_tcp)
        step = motion.shear_step_m if self.scene.data.ncon or self.gap(T_base_tcp) < _CLEAR_M else motion.press_step_m
        count = max(int(np.ceil(motion.least_steps / self._pace)), int(np.ceil(travel / (step * self._pace))))
        count = self.carrier.aim(T_base_tcp, count, motion.step_s)
        with counted_warnings() as messages:
            self.scene.stiffen(resting=False)
            for share in motion_fractions(count, motion)[1:]:
                self._step(share)
            self.scene.stiffen(resting=True)
            for _ in range(self._settle):
                self._step(1.0)
        self.warnings += len(messages)
        return self.touch()

    def touch(self):
        """The Touch of this moment. Raises Diverged."""
        touch = read_tip_state(self.scene, self._reader, self._since, self._clearance())
        if not (np.isfinite(touch.skin).all() and np.abs(touch.skin).max() < 4 * self._radius):
            raise Diverged("the simulated tip is lost: its state is not that of a tip any more")
        self._since = 0
        return touch

    def _clearance(self):
        """Distance (m) of the housing to the object, at rings of points on it."""
        T = inverse(self.T_base_object) @ self.carrier.pose
        return float(self._solid.distance(self._housing @ T[:3, :3].T + T[:3, 3]).min())

    def _undeform(self):
        self.scene.reset()
        self._place(self.carrier.pose)
        self._since = 0

    def _step(self, share):
        """One time step, towards a share of the carrier's way."""
        h, before = self.scene.fidelity.motion.step_s, self.carrier.pose
        force, torque = (before[:3, :3] @ x for x in self.scene.contact_wrench())
        after = self.carrier.advance(share, h, force, torque)
        self._place(before, after, h)
        self.scene.step()
        self._since += 1
        if not np.isfinite(self.scene.max_vertex_speed()):
            raise Diverged("the simulated tip is lost: its state is not finite any more")

    def _place(self, before, after=None, h=1.0):
        """Put the object where it is to the sensor, with the speed that takes it where it will be."""
        T = inverse(before) @ self.T_base_object
        linear = angular = np.zeros(3)
        if after is not None:
            T_next = inverse(after) @ self.T_base_object
            linear = (T_next[:3, 3] - T[:3, 3]) / h
            angular = Rotation.from_matrix(T[:3, :3].T @ T_next[:3, :3]).as_rotvec() / h
        self.scene.place(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True), linear, angular)
