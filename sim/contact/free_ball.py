"""A soft tip, a ball that is free to move, and a table: one MuJoCo model, so all their contacts are solved together.

The world frame is the sensor frame, as in every scene (scene.py), so the table moves instead of the tip. The ball's weight
and the inertia of its motion with the accelerated frame act on it as forces, because the vertices of the tip, whose masses
are numerical, must not feel them.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.stimuli import Ball, ContactAttributes
from tactip_twin.sim.pose import matrix
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, TOUCHES_VERTICES, contact_attributes

GRAVITY_M_S2 = 9.81

_TABLE_BIT = 8
"""Contact bit of the table, which only the ball collides with."""

_TABLE_M = (1.0, 1.0, 0.01)
"""Half sizes of the table, m."""

_MIN_INERTIA_KG = 0.02
"""Smallest inertial mass of the ball, kg [M]: its contacts are as stiff as its inertia allows, and motions are quasi-static.
Its weight is its own."""

_SKIN_IMPEDANCE, _TABLE_IMPEDANCE = 0.995, 0.95
"""Constant impedances of the ball's contacts, - [M]: a ball of 10 mm under 0.3 N sinks 0.05 mm into the table."""

_DRAG = 0.5
"""Fraction of its velocity over the table that a force on the ball would take away in a time step, -. Motions are
quasi-static, so it does not affect where the ball settles, only that it does: between table and skin it would swing."""

_TABLE_KG = 1000.0
"""Mass of the table, kg: its motion is set at every step, as that of a stimulus is."""


@dataclass(frozen=True)
class FreeBall(Ball):
    """A ball whose frame is at its centre."""

    density_kg_m3: float = 7850.0
    """Density, kg/m^3."""

    @property
    def mass_kg(self) -> float:
        """Mass, kg."""
        return self.density_kg_m3 * 4 / 3 * np.pi * self.radius_m**3

    @property
    def inertia_kg(self) -> float:
        """Inertial mass, kg."""
        return max(self.mass_kg, _MIN_INERTIA_KG)

    @property
    def top_m(self) -> float:
        """See Stimulus."""
        return self.radius_m

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus. The body gets the ball's mass, too."""
        kind, both = mujoco.mjtGeom.mjGEOM_SPHERE, TOUCHES_VERTICES | TOUCHES_FACETS
        body.mass, body.inertia = self.inertia_kg, [0.4 * self.inertia_kg * self.radius_m**2] * 3
        body.add_geom(name="ball", type=kind, size=[self.radius_m, 0, 0], contype=0, conaffinity=both | _TABLE_BIT, **touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus."""
        return np.linalg.norm(points, axis=-1) - self.radius_m


class FreeBallScene(Scene):
    """A tip, a free ball and a table."""

    def __init__(self, design: Design, ball: FreeBall, fidelity: Fidelity, table_friction: float) -> None:
        """Build the scene.

        Args:
            design: The tip.
            ball: The ball.
            fidelity: Mesh, steps and solver.
            table_friction: Coefficient of friction between ball and table, -.

        Raises:
            TactipError: The tip cannot be built.
        """
        self._ball, self._table_friction = ball, table_friction
        super().__init__(design, ball, fidelity)
        self._table = self.model.geom("table").id
        # The solver's tolerance is relative to the mean inertia: the ball must not loosen it.
        masses = self.model.body_mass[[self.model.body(f"tip/{i}").id for i in np.flatnonzero(self._free)]]
        self.model.stat.meaninertia = masses.mean()
        for attribute in (self.model.geom_solimp, self.model.flex_solimp):
            attribute[:, :2] = _SKIN_IMPEDANCE
        self.model.geom_solimp[self._table, :2] = _TABLE_IMPEDANCE
        self._table_velocity = np.zeros(3)

    def stiffen(self, resting: bool) -> None:
        """Set contact stiffness and solver tolerance: see Scene.

        The stiffness of a scene whose stimulus is moved would throw the ball off, because it has no gel behind it. Here a
        contact removes gap and velocity in one time step, which is as stiff as a free body allows.
        """
        h, solver = self.fidelity.motion.step_s, self.fidelity.solver
        for attribute in (self.model.geom_solref, self.model.flex_solref):
            attribute[:] = -1 / h**2, -1 / h
        self.model.opt.tolerance = solver.settle_tolerance if resting else solver.tolerance

    def _add_bodies(self, spec: mujoco.MjSpec) -> None:
        table = spec.worldbody.add_body(name="table", mass=_TABLE_KG, inertia=[10.0] * 3, explicitinertial=True)
        table.add_freejoint(name="table")
        touch = contact_attributes(self._table_friction, self.fidelity.contact)
        kind, place = mujoco.mjtGeom.mjGEOM_BOX, [0, 0, -_TABLE_M[2]]
        table.add_geom(
            name="table", type=kind, size=_TABLE_M, pos=place, contype=_TABLE_BIT, conaffinity=0, priority=1, **touch
        )

    def reset(self) -> None:
        """Reset to the undeformed tip: see Scene."""
        super().reset()
        self._table_velocity = np.zeros(3)

    def place_table(self, T_sensor_table: np.ndarray, T_next: np.ndarray | None = None) -> None:
        """Set the pose of the table and, towards the pose of the next step, its velocity; load the ball accordingly.

        Args:
            T_sensor_table: (4, 4), the middle of the table's top, z up.
            T_next: (4, 4), the same after the time step; None: at rest.
        """
        h, turn = self.fidelity.motion.step_s, T_sensor_table[:3, :3]
        linear = angular = np.zeros(3)
        if T_next is not None:
            linear = (T_next[:3, 3] - T_sensor_table[:3, 3]) / h
            angular = Rotation.from_matrix(turn.T @ T_next[:3, :3]).as_rotvec() / h
        self.data.qpos[-7:-4] = T_sensor_table[:3, 3]
        self.data.qpos[-4:] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
        self.data.qvel[-6:-3], self.data.qvel[-3:] = linear, angular
        # The table is at rest in the world, so in this frame everything accelerates as it does.
        acceleration = (linear - self._table_velocity) / h - _DRAG / h * (self.data.qvel[:3] - linear)
        weight = -GRAVITY_M_S2 * self._ball.mass_kg * turn[:, 2]
        self.data.xfrc_applied[self._stimulus_body, :3] = weight + self._ball.inertia_kg * acceleration
        self._table_velocity = linear

    def put_ball(self, centre: ArrayLike) -> None:
        """Place the ball with its centre at a point (3,), m, sensor frame, at rest."""
        self.place(centre, [1, 0, 0, 0])

    def ball_pose(self) -> np.ndarray:
        """Return T_sensor_ball (4, 4)."""
        return matrix(self.data.qpos[:3], Rotation.from_quat(self.data.qpos[3:7], scalar_first=True))

    def ball_velocity(self) -> np.ndarray:
        """Return the velocity (3,) m/s of the ball relative to the table, in the sensor frame."""
        return self.data.qvel[:3] - self._table_velocity

    def _on_tip(self) -> np.ndarray:
        return super()._on_tip() & ~(self.data.contact.geom == self._table).any(1)
