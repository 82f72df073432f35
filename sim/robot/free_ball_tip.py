"""A soft tip that an arm model moves over a ball on a table; the ball is free to roll."""

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.free_ball import FreeBall, FreeBallScene
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.pose import inverse
from tactip_twin.sim.robot.arm_models import ArmModel
from tactip_twin.sim.robot.mounted_tip import SimulatedTip
from tactip_twin.tactip_model.design import Design

_SUBDIVISIONS = 3
"""Subdivisions of the ball's mesh, which only the gap to the housing needs."""


class FreeBallTip(SimulatedTip[FreeBallScene]):
    """A tip on an arm model, and a ball on a table at the height zero of the base frame."""

    def __init__(
        self, design: Design, ball: FreeBall, fidelity: Fidelity, arm_model: ArmModel, table_friction: float
    ) -> None:
        """Build the scene.

        Args:
            design: Design of the sensor.
            ball: The ball.
            fidelity: Fidelity of the simulation.
            arm_model: Model that positions the sensor.
            table_friction: Coefficient of friction between ball and table, -.

        Raises:
            TactipError: The scene cannot be built.
        """
        mesh = trimesh.creation.icosphere(_SUBDIVISIONS, ball.radius_m)
        solid = SignedDistanceMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        super().__init__(design, solid, FreeBallScene(design, ball, fidelity, table_friction), arm_model, np.eye(4))
        self.solid, self.ball = solid, ball

    def put_ball(self, place: ArrayLike) -> None:
        """Set where the ball lies at the next `reset_to`: (2,), m, base frame."""
        self.T_base_object = np.eye(4)
        self.T_base_object[:3, 3] = [*np.asarray(place, float), self.ball.radius_m]

    def _reset(self) -> None:
        self.scene.reset()
        to_sensor = inverse(self.arm_model.pose)
        self.scene.put_ball((to_sensor @ self.T_base_object)[:3, 3])
        self.scene.place_table(to_sensor)
        self._steps_since_read = 0

    def go(self, T_base_tcp: np.ndarray, max_force_n: float = np.inf) -> TipState:
        """Move to a pose and settle there: see TipOnArm. The ball moves with it."""
        motion, fraction = self._motion, 0.0
        limit = max(max_force_n, float(np.linalg.norm(self.scene.contact_force())))
        fractions = self._set_target(T_base_tcp, motion.shear_step_m, 1.0)
        with counted_warnings() as messages:
            self.scene.stiffen(resting=False)
            for fraction in fractions:
                self._step(fraction)
                if np.linalg.norm(self.scene.contact_force()) > limit:
                    break
            self.scene.stiffen(resting=True)
            for k in range(motion.settle_limit):
                if k >= motion.pause_steps and np.linalg.norm(self.scene.ball_velocity()) < motion.settle_speed_m_s:
                    break
                self._step(fraction)
        self.warnings += len(messages)
        return self.tip_state()

    def _step(self, fraction: float) -> None:
        """Make one time step, to a fraction of the arm model's path."""
        scene, h, before = self.scene, self._motion.step_s, self.arm_model.pose
        force, torque = (before[:3, :3] @ x for x in scene.contact_wrench())
        after = self.arm_model.advance(fraction, h, force, torque)
        scene.place_table(inverse(before), inverse(after))
        scene.step()
        self.T_base_object = after @ scene.ball_pose()
        self._steps_since_read += 1
        if not (np.isfinite(scene.max_vertex_speed()) and np.isfinite(self.T_base_object).all()):
            raise Diverged("the simulation diverged: the state is not finite")
