"""A soft tip that an arm model moves over an object, keeping its state from motion to motion: the scene of a servo.

The tip stays fixed in its world and the object moves, as in the data-set scene: a tip mounted on an arm within MuJoCo would
cost several times as much per step. The arm model (sim/robot/arm_models.py) gives the sensor's pose.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.mujoco_warnings import counted_warnings
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.rigid_points import RigidPoints
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import LEVER_M, Diverged, motion_fractions
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.tip_state import StoppedBy, TipState, read_tip_state
from tactip_twin.sim.pose import angle_between, inverse
from tactip_twin.sim.robot.arm_models import ArmModel
from tactip_twin.sim.robot.irb120 import housing_points
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import Mesh
from tactip_twin.tactip_model.pins import PinReader

_CLEAR_M = 0.5e-3
"""Gap between tip and object that counts as clear, m."""

_BACK_M, _MAX_BACKS = 1e-3, 100
"""Step by which a pose is moved back, m, and the number of such steps."""

MAX_FORCE_N = 100.0
"""Force on the tip above which the simulation counts as diverged, N: some twenty times that of the deepest press."""

_MAX_EXTRA_STEPS, _MAX_PENETRATION_M = 12, QualityLimits().while_sliding().penetration_m
"""Maximum number of further time steps at rest, and penetration, m, above which they are made. The dynamic arm needs some
100 ms to come to rest after a fast turn, and presses the skin into steep flanks meanwhile [M]."""

_SLOW_FORCE, _SLOW_PACE = 0.5, 4
"""Force, as a fraction of its limit, above which the arm moves at a fraction of its pace, and the inverse of that one [?].
The last rise of the force is added to it, because in a narrow hollow it doubles from one time step to the next [M]."""

_SKIN_PACE = 0.7
"""Largest ratio of the mean travel per time step of skin near the object to the fidelity's shear_step_m. A turn about the
apex moves the flanks further than the apex. In four time steps, a turn of 4° threw them at the object, with up to 7 N more
than at the end [M]."""

_NEAR_M = 2e-3
"""Distance from the object within which skin counts as near it, m: about the longest way of a servo step."""

GIVE_M = 0.1e-3
"""Overlap of the housing with the object at which the arm stops, m: both are rigid [?]."""

_HOUSING_GROUPS = 12
"""Number of groups of the points on the housing [M]."""


class TipOnArm(ABC):
    """A tip on an arm model, and an object: what a servo moves."""

    mesh: Mesh
    """Undeformed mesh of the tip."""

    def __init__(
        self, design: Design, solid: SignedDistanceMesh, fidelity: Fidelity, arm_model: ArmModel, T_base_object: ArrayLike
    ) -> None:
        """Take the parts: see MountedTip."""
        self.arm_model, self.T_base_object = arm_model, np.array(T_base_object, float)
        self._solid, self._radius, self._motion = solid, design.shape.radius_m, fidelity.motion
        self._housing = RigidPoints(housing_points(self._radius), _HOUSING_GROUPS)
        self.warnings = 0
        """Number of MuJoCo's warnings so far."""

    def reset_to(self, T_base_tcp: np.ndarray, wrist_rad: float = 0.0) -> None:
        """Place the sensor at a pose with the tip undeformed.

        Args:
            T_base_tcp: (4, 4).
            wrist_rad: Desired angle of joint 6, rad.

        Raises:
            Unreachable: If the arm cannot take the pose.
            TactipError: If the tip is not clear of the object there.
        """
        if self.gap(T_base_tcp) < 0:
            raise TactipError("the start pose puts the tip inside the object: start farther away from it")
        self.arm_model.reset_to(T_base_tcp, wrist_rad)
        self._reset()

    def gap(self, T_base_tcp: np.ndarray) -> float:
        """Return the distance, m, from the undeformed dome at a pose (4, 4) to the object; negative where they overlap."""
        T = inverse(self.T_base_object) @ T_base_tcp
        centre = (T @ [0, 0, -self._radius, 1])[:3]
        # The dome is the sphere's outer half; behind it is the housing, as wide.
        back = T[:3, 3] - np.outer(np.linspace(self._radius, 3 * self._radius, 9), T[:3, 2])
        return float(min(self._solid.distance(centre[None])[0], self._solid.distance(back).min()) - self._radius)

    @abstractmethod
    def go(self, T_base_tcp: np.ndarray, max_force_n: float = np.inf) -> TipState:
        """Move to a pose at the fidelity's pace, in contact or not, and settle there.

        Args:
            T_base_tcp: (4, 4).
            max_force_n: Force on the tip at which the arm stops on its way, N, unless the force has only fallen. It also
                stops where the housing runs against the object.

        Returns:
            The tip's state at rest.

        Raises:
            Unreachable: If the arm cannot take the pose; nothing has moved.
            Diverged: If the simulation diverges.
        """

    @abstractmethod
    def tip_state(self) -> TipState:
        """Return the tip's present state. Raises Diverged."""

    @abstractmethod
    def _reset(self) -> None:
        """Make the tip undeformed at the arm model's pose."""

    def _clearance(self) -> float:
        """Return the distance, m, from the object to the nearest of the points on the housing."""
        T = inverse(self.T_base_object) @ self.arm_model.pose
        return float(self._housing.distances(self._solid.distance, T, -np.inf).min())

    def _overlap(self) -> float:
        """Return how far the housing is in the object, m."""
        T = inverse(self.T_base_object) @ self.arm_model.pose
        return max(0.0, -self._housing.nearest(self._solid.distance, T, 0.0))

    def _set_target(self, T_base_tcp: np.ndarray, step_m: float, pace: float, min_steps: int = 1) -> np.ndarray:
        """Set the arm model's target (4, 4), and return the fractions (n,) of the path at the time steps to it.

        Args:
            T_base_tcp: (4, 4).
            step_m: Travel per time step of the fidelity, m.
            pace: Ratio of the travel per time step to that, -.
            min_steps: Minimum number of time steps, beside that of the fidelity.

        Raises:
            Unreachable: If the arm cannot take the pose.
        """
        motion, here = self._motion, self.arm_model.pose
        travel = np.linalg.norm(T_base_tcp[:3, 3] - here[:3, 3]) + LEVER_M * angle_between(here, T_base_tcp)
        count = max(min_steps, int(np.ceil(motion.min_steps / pace)), int(np.ceil(travel / (step_m * pace))))
        return motion_fractions(self.arm_model.set_target(T_base_tcp, count, motion.step_s), motion)[1:]


def check_force(force_n: np.ndarray) -> None:
    """Raise Diverged if a force (3,), N, on the tip is beyond MAX_FORCE_N."""
    size = float(np.linalg.norm(force_n))
    if not size <= MAX_FORCE_N:
        raise Diverged(f"the simulation diverged: a force of {size:.0f} N on the tip (at most {MAX_FORCE_N:g} N)")


def _finer(path: np.ndarray) -> np.ndarray:
    """Return the fractions (_SLOW_PACE (n - 1) + 1,) of a path (n,) with steps as long as _SLOW_PACE allows."""
    return np.interp(np.arange(_SLOW_PACE * (len(path) - 1) + 1) / _SLOW_PACE, np.arange(len(path)), path)


def clear_pose(mounted_tip: TipOnArm, T_base_tcp: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4), moved back along the sensor's axis until the undeformed tip is clear of the object.

    In a narrow hollow, the tip's flanks touch before its apex does.
    """
    back = np.eye(4)
    back[2, 3] = -_BACK_M
    for _ in range(_MAX_BACKS):
        if mounted_tip.gap(T_base_tcp) > _CLEAR_M:
            break
        T_base_tcp = T_base_tcp @ back
    return T_base_tcp


SomeScene = TypeVar("SomeScene", bound=Scene)


class SimulatedTip(TipOnArm, Generic[SomeScene]):
    """A simulated tip on an arm model."""

    def __init__(
        self, design: Design, solid: SignedDistanceMesh, scene: SomeScene, arm_model: ArmModel, T_base_object: ArrayLike
    ) -> None:
        """Take the parts: see MountedTip."""
        super().__init__(design, solid, scene.fidelity, arm_model, T_base_object)
        self.scene, self.mesh = scene, scene.mesh
        self._reader = PinReader(design, scene.mesh)
        self._steps_since_read = 0

    def tip_state(self) -> TipState:
        """Return the tip's present state. Raises Diverged."""
        state = read_tip_state(self.scene, self._reader, self._steps_since_read, self._clearance())
        if not (np.isfinite(state.skin).all() and np.abs(state.skin).max() < 4 * self._radius):
            raise Diverged("the simulation diverged: the tip is deformed beyond four times its radius")
        check_force(state.force)
        self._steps_since_read = 0
        return state


class MountedTip(SimulatedTip[Scene]):
    """A simulated tip on an arm model, and an object."""

    def __init__(
        self,
        design: Design,
        solid: SignedDistanceMesh,
        fidelity: Fidelity,
        arm_model: ArmModel,
        T_base_object: ArrayLike,
        settle_steps: int | None = None,
        pace: float = 1.0,
    ) -> None:
        """Build the scene.

        Args:
            design: Design of the sensor.
            solid: Shape of the object, in the object's frame.
            fidelity: Fidelity of the simulation.
            arm_model: Model that positions the sensor.
            T_base_object: (4, 4).
            settle_steps: Time steps at rest before the tip's state is read; the fidelity's Motion.pause_steps if None.
            pace: Ratio of the travel per time step to that of the fidelity, -.

        Raises:
            TactipError: If the scene cannot be built.
        """
        super().__init__(design, solid, Scene(design, SolidStimulus(solid), fidelity), arm_model, T_base_object)
        self._settle_steps = fidelity.motion.pause_steps if settle_steps is None else settle_steps
        self._pace = pace
        self._wrench = (np.zeros(3), np.zeros(3))

    def _reset(self) -> None:
        self.scene.reset()
        self._place(self.arm_model.pose)
        self._steps_since_read, self._wrench = 0, (np.zeros(3), np.zeros(3))

    def go(self, T_base_tcp: np.ndarray, max_force_n: float = np.inf) -> TipState:
        """Move to a pose and settle there: see TipOnArm. Where it stops, the arm moves back along its path until the force
        is below the limit and the housing is free, as industrial arms do after a collision."""
        motion, limit = self._motion, max(max_force_n, self._force_n())
        overlap = self._overlap()
        give = max(GIVE_M, overlap)
        near = self.scene.data.ncon or self.gap(T_base_tcp) < _CLEAR_M
        steps = int(np.ceil(self._skin_travel_m(T_base_tcp) / (_SKIN_PACE * motion.shear_step_m * self._pace)))
        fractions = self._set_target(T_base_tcp, motion.shear_step_m if near else motion.press_step_m, self._pace, steps)
        path, reached, slow = np.append(0.0, fractions), 0, False
        stopped_by: StoppedBy = ""
        force_n, rise_n, peak_n = self._force_n(), 0.0, 0.0
        with counted_warnings() as messages:
            self.scene.stiffen(resting=False)
            while reached + 1 < len(path) and not stopped_by:
                if force_n + rise_n > _SLOW_FORCE * limit and not slow:
                    path, slow = np.append(path[:reached], _finer(path[reached:])), True
                reached += 1
                before_n, force_n = force_n, self._step(path[reached])
                rise_n, peak_n, overlap = max(0.0, force_n - before_n), max(peak_n, force_n), self._overlap()
                if force_n > limit:
                    stopped_by = "force"
                elif overlap > give:
                    stopped_by = "housing"
            # At the stiffness of a tip at rest, a contact that is this deep would throw the tip off, and so would skin that
            # still moves back meet the object.
            while (force_n > limit or overlap > give) and reached > 0:
                reached -= 1
                force_n, overlap = self._step(path[reached]), self._overlap()
                peak_n = max(peak_n, force_n)
            for _ in range(self._settle_steps if stopped_by else 0):
                force_n = self._step(path[reached])
                peak_n = max(peak_n, force_n)
            for k in range(self._settle_steps + _MAX_EXTRA_STEPS):
                above = force_n > limit
                if k >= self._settle_steps and not above and self.scene.penetration() <= _MAX_PENETRATION_M:
                    break
                if above:
                    reached, stopped_by = max(reached - 1, 0), "force"
                self.scene.stiffen(resting=not above)
                force_n = self._step(path[reached])
                peak_n = max(peak_n, force_n)
            self.scene.stiffen(resting=True)
        self.warnings += len(messages)
        return replace(self.tip_state(), peak_force_n=peak_n, stopped_by=stopped_by)

    def _skin_travel_m(self, T_base_tcp: np.ndarray) -> float:
        """Return the largest distance, m, by which a motion to a pose (4, 4) moves skin near the object; 0 if none is."""
        skin = self.scene.vertices()[: self.mesh.surface_count]
        points = skin[self._solid.distance(self.scene.skin_in_stimulus()) < _NEAR_M]
        T = inverse(self.arm_model.pose) @ T_base_tcp
        return float(np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - points, axis=1).max(initial=0.0))

    def _force_n(self) -> float:
        """Return the magnitude of the contact force, N."""
        return float(np.linalg.norm(self._wrench[0]))

    def _step(self, fraction: float) -> float:
        """Make one time step, to a fraction of the arm model's path, and return the contact force, N. Raises Diverged."""
        h, before = self._motion.step_s, self.arm_model.pose
        force, torque = (before[:3, :3] @ x for x in self._wrench)
        self._place(before, self.arm_model.advance(fraction, h, force, torque), h)
        self.scene.step()
        if not np.isfinite(self.scene.max_vertex_speed()):
            raise Diverged("the simulation diverged: the state is not finite")
        self._wrench = self.scene.contact_wrench()
        check_force(self._wrench[0])
        self._steps_since_read += 1
        return self._force_n()

    def _place(self, before: np.ndarray, after: np.ndarray | None = None, h: float = 1.0) -> None:
        """Place the object relative to the sensor's pose `before`, with the velocity that leads to `after` in h, s."""
        T = inverse(before) @ self.T_base_object
        linear = angular = np.zeros(3)
        if after is not None:
            T_next = inverse(after) @ self.T_base_object
            linear = (T_next[:3, 3] - T[:3, 3]) / h
            angular = Rotation.from_matrix(T[:3, :3].T @ T_next[:3, :3]).as_rotvec() / h
        self.scene.place(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True), linear, angular)
