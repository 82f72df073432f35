"""The arm: an ABB IRB 120 that carries the sensor; its kinematics, and its limits.

T_base_tcp is the sensor frame (sim/pose.py) in the frame of the arm's base: origin at the tip's apex, z out of it. The
sensor sits on the flange, its z the flange's, its x the flange's too.
"""

import mink
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.assets import ARM
from tactip_twin.tactip_model.errors import TactipError

JOINTS = tuple(f"joint_{k}" for k in range(1, 7))
"""Names of the joints, from the base."""

SPEEDS_RAD_S = np.radians([250.0, 250.0, 250.0, 320.0, 320.0, 420.0])
"""Greatest speeds of the joints, rad/s: ABB's data, by ros-industrial's abb_irb120_support."""

APEX_FROM_FLANGE_M = 89.1e-3
"""Distance of the tip's apex from the flange, m: of a rig with this arm (85 to 89 mm elsewhere)."""

TOOL_KG = 0.2
"""Mass of the sensor, kg: an estimate, of a printed body, a camera and 20 ml of gel."""

READY_RAD = np.radians([0.0, 20.0, 10.0, 0.0, 60.0, 0.0])
"""Joint angles with the sensor pointing down in front of the arm, rad."""

LEAST_SINGULAR = 0.03
"""Least singular value of the Jacobian, lengths in units of LEVER_M: below it the arm can hardly move one way, and joints
race. It is 0.25 or so where the arm works well."""

LEVER_M = 0.3
"""Length that makes a translation comparable to a turn, m: half the arm's reach."""

_POSITION_M, _TURN_RAD = 1e-6, 1e-5
"""How closely a pose is met, m and rad: a tenth of the arm's repeatability."""

_TRIES = 8
_ITERATIONS = 150


class Unreachable(TactipError):
    """A pose that the arm cannot take, or not by going on from where it is."""


class Arm:
    """Kinematics of the arm and the sensor it carries."""

    def __init__(self):
        self.model = arm_spec().compile()
        """mujoco.MjModel of the arm alone."""
        self._data = mujoco.MjData(self.model)
        self._site = self.model.site("tcp").id
        self.limits = self.model.jnt_range.copy()
        """Lowest and highest angle of each joint, (6, 2) rad."""
        self._task = mink.FrameTask("tcp", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
        self._limits = [mink.ConfigurationLimit(self.model)]

    def forward(self, angles):
        """T_base_tcp (4, 4) at joint angles (6,), rad."""
        self._at(angles)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self._data.site_xmat[self._site].reshape(3, 3), self._data.site_xpos[self._site]
        return T

    def jacobian(self, angles):
        """(6, 6): velocity of the apex, m/s, and turning of the sensor, rad/s, both in the base frame, by joint speeds."""
        self._at(angles)
        out = np.zeros((6, 6))
        mujoco.mj_jacSite(self.model, self._data, out[:3], out[3:], self._site)
        return out

    def manoeuvrability(self, angles):
        """Least singular value of the Jacobian (-), lengths in units of LEVER_M: nothing where the arm is singular."""
        jacobian = self.jacobian(angles)
        jacobian[:3] /= LEVER_M
        return float(np.linalg.svd(jacobian, compute_uv=False)[-1])

    def near(self, T_base_tcp, angles):
        """Joint angles (6,), rad, of a pose (4, 4), by going on from `angles` (6,).

        Raises Unreachable where it is out of reach, beyond a joint's limit or singular.
        """
        found, apart = self._solve(T_base_tcp, angles)
        if found is None:
            raise Unreachable(self._why(apart))
        value = self.manoeuvrability(found)
        if value < LEAST_SINGULAR:
            raise Unreachable(f"the arm is singular there: it can move {value:.3f} as far as it should, {LEAST_SINGULAR}")
        return found

    def find(self, T_base_tcp, wrist_rad=0.0):
        """Joint angles (6,), rad, of a pose (4, 4), from wherever the arm is: those with the most room.

        wrist_rad: float, where joint 6, which can turn more than once round, is to be, as near as a whole turn allows.
        Raises Unreachable where there are none.
        """
        best, most, apart = None, -np.inf, []
        shoulder = np.arctan2(T_base_tcp[1, 3], T_base_tcp[0, 3])
        draw = np.random.default_rng(0)
        for k in range(_TRIES):
            start = READY_RAD + (draw.normal(0, 0.4, 6) if k else 0)
            start[0] += shoulder
            found, missed = self._solve(T_base_tcp, np.clip(start, *self.limits.T))
            if found is None:
                apart.append(missed)
                continue
            found[5] += 2 * np.pi * np.round((wrist_rad - found[5]) / (2 * np.pi))
            found[5] -= 2 * np.pi * np.sign(found[5]) * (abs(found[5]) > self.limits[5, 1])
            room = min(self.manoeuvrability(found) / LEAST_SINGULAR, self.room(found[:5]) / np.radians(10))
            room -= abs(found[5] - wrist_rad) / 10
            if room > most:
                best, most = found, room
        if best is None:
            raise Unreachable(self._why(min(apart)))
        if self.manoeuvrability(best) < LEAST_SINGULAR:
            raise Unreachable("the arm can only be singular there")
        return best

    def room(self, angles):
        """Angle (rad) from the nearest limit of a joint; negative beyond it. angles: (6,) rad, or of the first joints."""
        low, high = self.limits[: len(angles)].T
        return float(np.minimum(angles - low, high - angles).min())

    def _at(self, angles):
        self._data.qpos[:] = angles
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)

    def _solve(self, T_base_tcp, start):
        """Angles (6,) or None, and what was missed in the end (m, rad)."""
        configuration = mink.Configuration(self.model, q=np.array(start, float))
        self._task.set_target(mink.SE3.from_matrix(np.asarray(T_base_tcp, float)))
        missed = (np.inf, np.inf)
        for _ in range(_ITERATIONS):
            error = self._task.compute_error(configuration)
            missed = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
            if missed[0] < _POSITION_M and missed[1] < _TURN_RAD:
                return configuration.q.copy(), missed
            step = mink.solve_ik(configuration, [self._task], 1.0, "daqp", limits=self._limits)
            length = np.abs(step).max()
            configuration.integrate_inplace(step * min(1.0, 0.5 / max(length, 1e-12)), 1.0)
        return None, missed

    def _why(self, missed):
        return (
            f"the arm cannot take that pose: with every joint in its limits it stays {1e3 * missed[0]:.1f} mm and "
            f"{np.degrees(missed[1]):.1f} degrees away"
        )


_HOUSING_WIDER_M = 2e-3
"""Radius of the sensor's housing over the tip's, m."""


def housing_points(radius_m=20e-3, rings=4, sides=24):
    """Points (rings * sides, 3) m, sensor frame, on the sensor's housing from its edge behind the tip to the flange.

    radius_m: of the tip, m.
    """
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = (radius_m + _HOUSING_WIDER_M) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    back = np.linspace(radius_m, APEX_FROM_FLANGE_M, rings)
    return (ring - back[:, None, None] * [0, 0, 1.0]).reshape(-1, 3)


def arm_spec(radius_m=20e-3):
    """The MjSpec of the arm with the sensor's housing on its flange, and the site `tcp` at its apex.

    radius_m: of the tip, m. The housing is there to be seen and weighed; the soft tip is another model's
    (sim/contact/scene.py).
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
