"""Options of the environments: the keyword arguments of `gymnasium.make`. Nothing heavy is imported here.

Names of modes are those of Tactile Gym [R] (Church et al., CoRL 2021; Lin et al., RA-L 2022), so its users find them.
"""

import re
from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.sim.labels import COMPONENTS, FidelityName
from tactip_twin.sim.robot.arm_names import ArmName
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.renderer import RendererName

ObservationMode = Literal["oracle", "pose", "tactile", "tactile_and_feature"]
"""What is observed: oracle (the true errors), pose (the same, as the shipped network estimates them), tactile (the image),
tactile_and_feature (the image, and what a robot knows: goal and last action)."""

ControlMode = Literal["TCP_position_control", "TCP_velocity_control"]
"""What an action commands: a motion from the measured pose, or a velocity for one control period."""

RewardMode = Literal["dense", "sparse"]
"""Reward at every step, or only at the goal."""

CONTROL_PERIOD_S = 0.1
"""Control period of velocities, s [R]. Contacts are quasi-static, so no time passes between two actions."""

_MOVEMENT = re.compile("(T?)" + "".join(f"({c})?" for c in COMPONENTS))


@dataclass(frozen=True)
class Movement:
    """The axes that an action moves, in the sensor's frame (x right and y down in the image, z out of the tip)."""

    forward: bool
    """Whether the environment moves along the route by itself."""
    axes: tuple[int, ...]
    """Indices of COMPONENTS."""


def movement_named(mode: str) -> Movement:
    """Return the movement of a mode such as xyRz or TzRxRy; a T in front is the environment's own step along the route.

    Raises:
        TactipError: The mode has no axes, or not in the order of COMPONENTS.
    """
    found = _MOVEMENT.fullmatch(mode)
    allowed = "some of x, y, z, Rx, Ry and Rz in this order, with or without a T in front"
    if found is None or not any(found.groups()[1:]):
        raise TactipError(f"movement_mode must be {allowed}, got {mode!r}")
    return Movement(bool(found[1]), tuple(k for k, axis in enumerate(found.groups()[1:]) if axis))


@dataclass(frozen=True)
class EnvironmentOptions:
    """Options of every environment."""

    observation_mode: ObservationMode = "oracle"
    """Observation."""
    control_mode: ControlMode = "TCP_position_control"
    """Meaning of an action."""
    movement_mode: str = ""
    """Axes that an action moves, in the sensor's frame, such as xyRz; T in front: the environment itself moves along the
    route. Default: that of the task."""
    reward_mode: RewardMode = "dense"
    """Reward."""
    fidelity: FidelityName | Literal["fast"] = "fast"
    """Fidelity of the contact: fast (the learned tip), draft, standard or reference."""
    design: str = "tactip-127"
    """Sensor: a preset's name, or a design file."""
    arm: ArmName = "none"
    """Arm model; none: the sensor moves exactly."""
    renderer: RendererName = "raster"
    """Renderer of the tactile image; raster needs no OpenGL."""
    image_size_px: int = within(16, 512, default=128)
    """Width of the tactile image, px. The shipped networks need 128."""
    max_move_mm: float = within(0.01, 1.5, default=0.5)
    """Longest translation of an action along each axis, mm; ten times as much per second for velocities."""
    max_turn_deg: float = within(0.01, 6, default=2.0)
    """Largest rotation of an action about each axis, degrees; ten times as much per second for velocities."""
    step_mm: float = within(0.05, 1.5, default=1.0)
    """The environment's own step along the route, mm."""
    max_steps: int = within(1, 100000, default=200)
    """Steps after which an episode is truncated."""
    max_force_n: float = within(0.1, 100, default=8.0)
    """Force on the tip that ends an episode, N."""

    def __post_init__(self) -> None:
        check(self)
        for name, names in _CHOICES.items():
            lookup(name.replace("_", " "), getattr(self, name), dict.fromkeys(get_args(names)))
        if self.movement_mode:
            movement_named(self.movement_mode)


_CHOICES = {"observation_mode": ObservationMode, "control_mode": ControlMode, "reward_mode": RewardMode}


@dataclass(frozen=True)
class FollowOptions(EnvironmentOptions):
    """Options of EdgeFollow and SurfaceFollow."""

    objects: tuple[str, ...] = ()
    """Objects, of which each episode takes one: the project's names, or mesh files in mm for surfaces. Default: those of the
    task."""
    depth_mm: float | None = within(0.5, 5, default=None)
    """Depth to keep, mm. Default: the servo's, 2 on surfaces and 3 along edges."""
    length_mm: float = within(1, 1000, default=40.0)
    """Length of the path to the goal, mm."""
    start_mm: float = within(0, 3, default=1.0)
    """Largest error of the first pose in depth and, along an edge, across it, mm; 0 in axes that an action does not
    move."""
    start_deg: float = within(0, 10, default=5.0)
    """Largest error of the first pose about each axis, degrees, likewise."""


@dataclass(frozen=True)
class RollOptions(EnvironmentOptions):
    """Options of ObjectRoll."""

    fidelity: FidelityName | Literal["fast"] = "draft"
    """Fidelity of the contact: draft, standard or reference. The learned tip does not know free objects."""
    radius_mm: tuple[float, float] = within(3, 15, default=(5.0, 5.0))
    """Range of the ball's radius, mm."""
    density_kg_m3: float = within(100, 20000, default=7850.0)
    """Density of the ball, kg/m^3: steel."""
    table_friction: float = within(0.05, 2, default=0.8)
    """Coefficient of friction between ball and table, - [?]."""
    depth_mm: tuple[float, float] = within(0.5, 4, default=(2.0, 2.0))
    """Range of the depth to which the tip is pressed on the ball, mm."""
    offset_mm: float = within(0, 5, default=0.0)
    """Largest distance of the ball from the tip's axis at the start, mm."""
    goal_mm: tuple[float, float] = within(0, 12, default=(2.0, 5.0))
    """Range of the distance of the goal from the tip's axis, mm. The goal moves with the tip [R]."""
    reached_mm: float = within(0.1, 5, default=0.5)
    """Distance of the ball from the goal that counts as reached, mm."""
