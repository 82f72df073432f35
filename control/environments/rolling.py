"""ObjectRoll: roll a ball on a table under the tip, to a goal that moves with the tip."""

from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.control.environments.environment import Failure, TouchEnvironment
from tactip_twin.control.environments.options import RollOptions
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.free_ball import FreeBall
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.pose import inverse, matrix
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.free_ball_tip import FreeBallTip
from tactip_twin.sim.robot.mounted_tip import TipOnArm
from tactip_twin.sim.robot.recording import RecordedScene
from tactip_twin.sim.view.geometry import Color, ColoredMesh, SceneGeometry
from tactip_twin.tactip_model.errors import TactipError

_START_M = (0.38, 0.0)
"""Where the tip touches down, base frame, m: in front of the arm."""

_GAP_M = 1e-3
"""Height of the tip above the ball before it is pressed on, m."""

_LOST_M = 10e-3
"""Distance of the ball from the tip's axis, m, that ends an episode: there the dome is too high to press on it."""

_STEP_COST = 0.05
"""Cost of a step, in mm of progress [?]."""

_TURN = np.diag([-1.0, 1.0, -1.0])
"""Rotation of a sensor that points down."""

_GOAL_M = 1.5e-3
"""Radius of the sphere that shows the goal, m."""

_BALL_COLOR: Color = (150.0, 160.0, 175.0)
_GOAL_COLOR: Color = (40.0, 160.0, 70.0)


class ObjectRoll(TouchEnvironment):
    """Roll a ball to a goal, by motions of the tip along the table.

    The ball rolls about half as far as the tip, so in the tip's frame it goes back by half. The goal lies in that frame.
    """

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        """Args:
            render_mode: None, rgb_array, or human: a page in the browser.
            **options: See RollOptions.

        Raises:
            TactipError: An option is invalid.
        """
        try:
            roll = RollOptions(**options)
        except TypeError as error:
            raise TactipError(f"unknown option: {error}") from error
        if roll.fidelity == "fast":
            raise TactipError(
                "fidelity must be draft, standard or reference, got 'fast': the learned tip does not know free objects"
            )
        if roll.observation_mode == "pose":
            raise TactipError(
                "observation_mode must be oracle, tactile or tactile_and_feature, got 'pose': no network estimates where a "
                "ball is"
            )
        self._roll = roll
        super().__init__(roll, "xy", 3, render_mode)

    def _kept(self) -> set[str]:
        return super()._kept() | {"_roll"}

    def _forget(self) -> None:
        super()._forget()
        self._tip: FreeBallTip | None = None
        self._geometry: SceneGeometry | None = None

    @property
    def tip(self) -> TipOnArm:
        """The tip over the ball."""
        return self._built

    @property
    def _built(self) -> FreeBallTip:
        if self._tip is None:
            raise TactipError("the environment has no episode: call reset first")
        return self._tip

    def _start(self) -> TipState:
        rng, r = self.np_random, self._roll
        radius = rng.uniform(*r.radius_mm) / 1e3
        depth = rng.uniform(*r.depth_mm) / 1e3
        offset, angles = r.offset_mm / 1e3 * np.sqrt(rng.uniform()), rng.uniform(-np.pi, np.pi, 2)
        distance = rng.uniform(*r.goal_mm) / 1e3
        if self._tip is None or self._tip.ball.radius_m != radius:
            ball, fidelity = FreeBall(radius, r.density_kg_m3), fidelity_named(r.fidelity)
            arm = arm_model_named(r.arm)
            self._tip = FreeBallTip(self.design, ball, fidelity, arm, r.table_friction)
        self._geometry = None
        self._tip.put_ball(np.array(_START_M) + offset * np.array([np.cos(angles[0]), np.sin(angles[0])]))
        self._goal_in_tip = distance * np.array([np.cos(angles[1]), np.sin(angles[1])])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = _TURN, [*_START_M, 2 * radius + _GAP_M]
        self._tip.reset_to(T)
        T[2, 3] = 2 * radius - depth
        state = self._tip.go(T)
        self._left_m = self._distance()
        return state

    def _ball(self) -> np.ndarray:
        """Return the ball's centre (3,), m, in the frame of the measured sensor."""
        return (inverse(self._built.arm_model.measured_pose()) @ self._built.T_base_object)[:3, 3]

    def _distance(self) -> float:
        """Return the distance of the ball from the goal, m, square to the tip's axis."""
        return float(np.linalg.norm(self._ball()[:2] - self._goal_in_tip))

    def _forward(self) -> np.ndarray:
        return np.zeros(3)

    def _state(self, estimated: bool) -> np.ndarray:
        return 1e3 * self._ball()

    def _feature_count(self) -> int:
        return 2

    def _features(self) -> np.ndarray:
        return 1e3 * self._goal_in_tip

    def _outcome(self) -> tuple[float, bool]:
        off = float(np.linalg.norm(self._ball()[:2]))
        if not off <= _LOST_M:
            raise Failure(f"the ball is {1e3 * off:.1f} mm from the tip's axis (at most {1e3 * _LOST_M:g} mm)")
        before, self._left_m = self._left_m, self._distance()
        return 1e3 * (before - self._left_m) - _STEP_COST, 1e3 * self._left_m <= self._roll.reached_mm

    def _info(self) -> dict[str, Any]:
        return {"ball_mm": 1e3 * self._ball(), "goal_mm": 1e3 * self._goal_in_tip, "distance_mm": 1e3 * self._distance()}

    def _meshes(self) -> tuple[list[ColoredMesh], list[ColoredMesh], np.ndarray]:
        tip = self._built
        if self._geometry is None:
            solid, radius = tip.solid, self.design.shape.radius_m
            scenery = RecordedScene(
                solid.vertices, solid.triangles, tip.T_base_object, tip.mesh.triangles, radius, self.options.arm != "none"
            )
            self._geometry = SceneGeometry(scenery)
        pose = tip.arm_model.pose
        goal = matrix((pose @ [*self._goal_in_tip, self._ball()[2], 1])[:3], Rotation.identity())
        moving = self._geometry.moving_meshes(tip.arm_model.angles, pose, self.touch.skin)
        moving += [_sphere(tip.ball.radius_m, _BALL_COLOR).transformed(tip.T_base_object)]
        moving += [_sphere(_GOAL_M, _GOAL_COLOR).transformed(goal)]
        return [self._geometry.table], moving, pose[:3, 3]


def _sphere(radius_m: float, color: Color) -> ColoredMesh:
    """Return the mesh of a sphere about the origin."""
    mesh = trimesh.creation.icosphere(2, radius_m)
    vertices = np.asarray(mesh.vertices)
    return ColoredMesh(vertices, np.asarray(mesh.faces), vertices / radius_m, color)
