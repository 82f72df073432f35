"""The robot arm, an ABB IRB 120: its kinematics and limits.

T_base_tcp is the sensor frame (sim/pose.py) in the frame of the arm's base, with its origin at the tip's apex and z out of
the tip. The sensor sits on the flange; its x and z are parallel to the flange's.
"""

import mink
import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from tactip_twin.assets import ARM
from tactip_twin.tactip_model.errors import TactipError

JOINTS = tuple(f"joint_{k}" for k in range(1, 7))
"""Names of the joints, from the base."""

MAX_SPEEDS_RAD_S = np.radians([250.0, 250.0, 250.0, 320.0, 320.0, 420.0])
"""Maximum speeds of the joints, rad/s: ABB's data, from ros-industrial's abb_irb120_support."""

APEX_FROM_FLANGE_M = 89.1e-3
"""Distance of the tip's apex from the flange, m: of a rig with this arm (85 to 89 mm elsewhere)."""

TOOL_KG = 0.2
"""Mass of the sensor, kg: an estimate, of a printed body, a camera and 20 ml of gel."""

READY_RAD = np.radians([0.0, 20.0, 10.0, 0.0, 60.0, 0.0])
"""Joint angles with the sensor pointing down in front of the arm, rad."""

MIN_SINGULAR_VALUE = 0.03
"""Lower limit of the Jacobian's smallest singular value, lengths in units of LEVER_M. Below it the arm can hardly move in
one direction, and its joints turn fast. Where the arm works well, the value is about 0.25."""

LEVER_M = 0.3
"""Length that makes a translation comparable to a rotation, m: half the arm's reach."""

_POSITION_TOLERANCE_M, _ANGLE_TOLERANCE_RAD = 1e-6, 1e-5
"""Tolerances of the inverse kinematics, m and rad: a tenth of the arm's repeatability."""

_STARTS = 8
_ITERATIONS = 150


class Unreachable(TactipError):
    """The arm cannot take a pose, or cannot move to it from its present one."""


class Arm:
    """Kinematics of the arm with the sensor on its flange."""

    def __init__(self) -> None:
        self.model: mujoco.MjModel = arm_spec().compile()
        """The arm alone."""
        self._data = mujoco.MjData(self.model)
        self._site = self.model.site("tcp").id
        self.limits: np.ndarray = self.model.jnt_range.copy()
        """Lower and upper limit of each joint, (6, 2) rad."""
        self._task = mink.FrameTask("tcp", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
        self._limits: list[mink.Limit] = [mink.ConfigurationLimit(self.model)]
        self._configuration = mink.Configuration(self.model)

    def forward(self, angles: ArrayLike) -> np.ndarray:
        """Return T_base_tcp (4, 4) at joint angles (6,), rad."""
        self._set_joints(angles)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._data.site_xmat[self._site].reshape(3, 3), self._data.site_xpos[self._site]
        return T

    def jacobian(self, angles: ArrayLike) -> np.ndarray:
        """Return the Jacobian at joint angles (6,), rad.

        Returns:
            (6, 6): rows are the apex's velocity, m/s, and the sensor's angular velocity, rad/s, both in the base frame, per
            rad/s of each joint.
        """
        self._set_joints(angles)
        out = np.zeros((6, 6))
        mujoco.mj_jacSite(self.model, self._data, out[:3], out[3:], self._site)
        return out

    def min_singular_value(self, angles: ArrayLike) -> float:
        """Return the Jacobian's smallest singular value, lengths in units of LEVER_M; 0 if the arm is singular."""
        jacobian = self.jacobian(angles)
        jacobian[:3] /= LEVER_M
        return float(np.linalg.svd(jacobian, compute_uv=False)[-1])

    def solve_near(self, T_base_tcp: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Solve the inverse kinematics close to given joint angles.

        Args:
            T_base_tcp: (4, 4).
            angles: (6,) rad, to start from.

        Returns:
            Joint angles (6,), rad.

        Raises:
            Unreachable: If the pose is out of reach, beyond a joint's limit or singular.
        """
        found, residual = self._iterate(T_base_tcp, angles)
        if found is None:
            raise Unreachable(_unreachable_message(residual))
        value = self.min_singular_value(found)
        if value < MIN_SINGULAR_VALUE:
            raise Unreachable(
                "the arm is close to a singularity at this pose: the smallest singular value of its Jacobian must be at "
                f"least {MIN_SINGULAR_VALUE}, got {value:.3f}"
            )
        return found

    def solve(self, T_base_tcp: np.ndarray, wrist_rad: float = 0.0) -> np.ndarray:
        """Solve the inverse kinematics from several starts, and take the solution farthest from limits and singularities.

        Args:
            T_base_tcp: (4, 4).
            wrist_rad: Desired angle of joint 6, rad. It can turn more than once round; the nearest whole turn is taken.

        Returns:
            Joint angles (6,), rad.

        Raises:
            Unreachable: If there is no solution.
        """
        best, best_score, residuals = None, -np.inf, []
        shoulder = np.arctan2(T_base_tcp[1, 3], T_base_tcp[0, 3])
        rng = np.random.default_rng(0)
        for k in range(_STARTS):
            start = READY_RAD + (rng.normal(0, 0.4, 6) if k else 0)
            start[0] += shoulder
            found, residual = self._iterate(T_base_tcp, np.clip(start, *self.limits.T))
            if found is None:
                residuals.append(residual)
                continue
            found[5] += 2 * np.pi * np.round((wrist_rad - found[5]) / (2 * np.pi))
            found[5] -= 2 * np.pi * np.sign(found[5]) * (abs(found[5]) > self.limits[5, 1])
            score = min(self.min_singular_value(found) / MIN_SINGULAR_VALUE, self.limit_margin(found[:5]) / np.radians(10))
            score -= abs(found[5] - wrist_rad) / 10
            if score > best_score:
                best, best_score = found, score
        if best is None:
            raise Unreachable(_unreachable_message(min(residuals)))
        if self.min_singular_value(best) < MIN_SINGULAR_VALUE:
            raise Unreachable("the arm is close to a singularity at this pose in every configuration")
        return best

    def limit_margin(self, angles: np.ndarray) -> float:
        """Return the angle, rad, to the nearest joint limit; negative beyond it. angles: (6,) rad, or the first joints'."""
        low, high = self.limits[: len(angles)].T
        return float(np.minimum(angles - low, high - angles).min())

    def _set_joints(self, angles: ArrayLike) -> None:
        self._data.qpos[:] = angles
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)

    def _iterate(self, T_base_tcp: np.ndarray, start: np.ndarray) -> tuple[np.ndarray | None, tuple[float, float]]:
        """Return joint angles (6,), or None without convergence, and the last residual, m and rad."""
        configuration = self._configuration
        configuration.update(np.array(start, float))
        self._task.set_target(mink.SE3.from_matrix(np.asarray(T_base_tcp, float)))
        residual = (np.inf, np.inf)
        for _ in range(_ITERATIONS):
            error = self._task.compute_error(configuration)
            residual = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            if residual[0] < _POSITION_TOLERANCE_M and residual[1] < _ANGLE_TOLERANCE_RAD:
                return configuration.q.copy(), residual
            step = mink.solve_ik(configuration, [self._task], 1.0, "daqp", limits=self._limits)
            length = np.abs(step).max()
            configuration.integrate_inplace(step * min(1.0, 0.5 / max(length, 1e-12)), 1.0)
        return None, residual


def _unreachable_message(residual: tuple[float, float]) -> str:
    return (
        f"the arm cannot reach this pose: within its joint limits it stays {1e3 * residual[0]:.1f} mm and "
        f"{np.degrees(residual[1]):.1f} degrees away"
    )


_HOUSING_WIDER_M = 2e-3
"""Radius of the sensor's housing minus the tip's, m."""


def housing_points(radius_m: float = 20e-3, rings: int = 4, sides: int = 24) -> np.ndarray:
    """Return points on the sensor's housing, from its edge behind the tip to the flange.

    Args:
        radius_m: Radius of the tip, m.
        rings: Number of rings of points along the axis.
        sides: Number of points per ring.

    Returns:
        (rings * sides, 3) m, sensor frame.
    """
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = (radius_m + _HOUSING_WIDER_M) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    back = np.linspace(radius_m, APEX_FROM_FLANGE_M, rings)
    return (ring - back[:, None, None] * [0, 0, 1.0]).reshape(-1, 3)


def arm_spec(radius_m: float = 20e-3) -> mujoco.MjSpec:
    """Return the spec of the arm with the sensor's housing on its flange and the site `tcp` at the apex.

    The housing is for rendering and for its mass; the soft tip has its own model (sim/contact/scene.py).

    Args:
        radius_m: Radius of the tip, m.
    """
    spec = mujoco.MjSpec.from_file(str(ARM))
    sensor, axis = spec.body("link_6").add_body(name="sensor", gravcomp=1), np.array([1.0, 0, 0])
    rim = APEX_FROM_FLANGE_M - radius_m
    look = {"contype": 0, "conaffinity": 0, "group": 2, "material": "irb120_dark"}
    cylinder, sphere = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE
    for name, radius, start, end, mass in (
        ("mount", 0.03, 0.0, 0.008, 0.0),
        ("housing", radius_m + _HOUSING_WIDER_M, 0.008, rim, TOOL_KG),
    ):
        ends = [*(start * axis), *(end * axis)]
        sensor.add_geom(name=name, type=cylinder, size=[radius, 0, 0], fromto=ends, mass=mass, **look)
    sensor.add_geom(name="dome", type=sphere, size=[radius_m, 0, 0], pos=rim * axis, mass=0, **look)
    turn = Rotation.from_euler("y", 90, degrees=True).as_quat(scalar_first=True)
    sensor.add_site(name="tcp", pos=APEX_FROM_FLANGE_M * axis, quat=turn, group=4)
    return spec
