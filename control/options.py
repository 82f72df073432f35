"""Options of a servo run. Nothing heavy is imported here, because the command line is made from these classes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.sim.dataset.object_options import UnitName
from tactip_twin.sim.labels import FidelityName, Task
from tactip_twin.sim.robot.arm_names import ArmName
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.renderer import RendererName

GainsName = Literal["paper", "tactile-servo-control"]
"""Names of the gains (servo.GAINS)."""

RouteKind = Literal["serpentine", "straight", "geodesic"]
"""Kinds of routes over a surface."""


@dataclass(frozen=True)
class Settings:
    """Settings of the follower."""

    step_mm: float = within(0.05, 10, default=1.0)
    """Tangential step, mm [P]."""
    slowdown_angle_deg: float | None = within(0, 90, default=None)
    """Predicted tilt at which the tangential step would reach zero, degrees. The step shrinks linearly with the tilt,
    below 20 % more slowly, so it is zero at four times this tilt. 0 disables this, as in the paper. Default: 2 on
    surfaces (effect: docs/servo.md), 0 along edges."""
    contact_threshold: float = within(0.01, 0.99, default=0.12)
    """Difference between an image and that of the undeformed tip, 0 to 1, above which the tip is in contact [?]. Presses of
    0.5 mm on a ball and a rim gave 0.1, presses of 1 mm 0.2."""
    search_mm: float = within(0, 50, default=12.0)
    """Distance along the sensor's axis over which contact is searched for, mm."""
    search_step_mm: float = within(0.05, 2, default=0.5)
    """Step of the search for contact, mm."""
    alignment_steps: int = within(1, 100, default=12)
    """Number of steps in place after contact, in which the controller aligns the sensor; up to three times as many where it
    is far from the normal."""
    range_margin: float = within(0, 10, default=0.5)
    """Distance beyond the trained label range at which an estimate is rejected, as a fraction of the range's half
    width."""
    max_force_n: float = within(0.1, 100, default=4.5)
    """Contact force at which the arm stops and moves back, N [?]. For presses deeper than by default it rises with the
    depth."""
    ease_force_n: float = within(0.1, 100, default=2.0)
    """Estimated contact force above which the tip moves back, N [M]; below it, it presses no deeper than the rest allows. It
    rises as max_force_n. Along the face of the bust the force is 1.4 N at most; in hollows narrower than the tip it is more,
    because flanks touch."""
    retract_mm: float = within(0.1, 20, default=2.0)
    """Distance of a retraction along the sensor's axis, mm."""
    max_recoveries: int = within(0, 1000, default=2)
    """Maximum number of searches for contact on the spot after failures, before a piece of the route is skipped."""
    skip_mm: float = within(0.1, 100, default=4.0)
    """Length of the first piece of the route that is skipped at an obstacle, mm. Every second skip is longer by as much."""
    max_skips: int = within(0, 1000, default=6)
    """Maximum number of skips at one obstacle. After them, the rest of the pass is left out, or the edge is given up."""
    clearance_mm: float = within(1, 200, default=15.0)
    """Height of the lifted tip above the part of the object touched so far, mm."""
    max_steps: int = within(1, 1000000, default=20000)
    """Maximum number of steps of a run."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class RouteOptions:
    """Route over a surface or along an edge."""

    kind: RouteKind = "serpentine"
    """Route over a surface: serpentine, straight, or geodesic, which keeps its heading relative to the surface as
    estimated by touch."""
    middle_mm: tuple[float, float] | None = None
    """Centre of the region in the base frame, x and y, mm. Default: the centre of the object, or of the bust's face."""
    length_mm: float = within(1, 1000, default=60.0)
    """Length of a pass over a surface, mm."""
    width_mm: float = within(0, 1000, default=40.0)
    """Width of the region of a serpentine, mm."""
    spacing_mm: float = within(1, 100, default=10.0)
    """Distance between the passes of a serpentine, mm."""
    heading_deg: float = within(-360, 360, default=90.0)
    """Direction of the passes in the base frame, degrees from x towards y."""
    reverse: bool = False
    """Follow an edge clockwise, as seen from above."""
    start_fraction: float = within(0, 1, default=0.0)
    """Start of an edge route, as a fraction of the edge's length."""
    max_length_mm: float = within(1, 10000, default=1000.0)
    """Maximum length of an edge route, mm."""

    def __post_init__(self) -> None:
        check(self)
        lookup("route", self.kind, dict.fromkeys(get_args(RouteKind)))


@dataclass(frozen=True)
class ServoOptions:
    """Options of a servo run."""

    out: Path
    """Folder of the run."""
    task: Task = "surface"
    """Task: follow a surface or an edge."""
    object: str = "bust"
    """Object to follow: one of the project's, or a mesh file (.stl, .obj, .ply, .glb)."""
    unit: UnitName | None = None
    """Unit of the mesh file. Default: mm, or m for a mesh that is too small in mm."""
    scale: float = within(1e-6, 1e6, default=1.0)
    """Scale factor applied to the mesh."""
    position_mm: tuple[float, float, float] | None = within(-1e4, 1e4, default=None)
    """Position of the centre of the object's underside in the base frame, mm. Default: in front of the arm."""
    rotation_deg: tuple[float, float, float] | None = None
    """Rotation of the object, as a rotation vector in degrees. Default: none."""
    model: str = ""
    """Network: a shipped one or the folder of a training. `oracle` uses the true pose instead. Default: the shipped
    network of the task; for surfaces, the one trained on curved surfaces."""
    design: str = "tactip-127"
    """Sensor: tactip-127, tactip-331, or a design file (.json) as `tactip calibrate` writes it."""
    fidelity: FidelityName | Literal["fast"] = "standard"
    """Fidelity of the contact simulation; fast: predict the contact by a learned tip, and simulate the motions that it has
    not learned."""
    sliding_tip: Path | None = None
    """Learned tip of --fidelity fast, a file of `tactip sliding-tip`. Default: the shipped one of task and
    design."""
    arm: ArmName = "dynamic"
    """Arm model: none (the sensor moves exactly), kinematic (inverse kinematics), dynamic (with masses and motors)."""
    renderer: RendererName | Literal["auto"] = "auto"
    """Renderer of the pins. auto: raster with --fidelity fast, because it is several times as fast, else pyrender; raster:
    without OpenGL, and without pictures of the run."""
    gains: GainsName = "paper"
    """Controller gains: of the paper, or of the authors' later Tactile Servo Control."""
    depth_mm: float | None = within(0.2, 8, default=None)
    """Commanded contact depth, mm. Default: 2 on surfaces and 3 along edges."""
    noise_grey: float = within(0, 255, default=0.0)
    """Standard deviation of the camera noise, grey levels (0 to 255)."""
    friction: float | None = within(0, 2, default=None)
    """Coefficient of friction between skin and object. Default: the design's."""
    stiffness: float = within(0.05, 20, default=1.0)
    """Factor on the Young's moduli of skin and gel."""
    seed: int | None = within(0, 2**63 - 1, default=None)
    """Seed for a random initial pose error, up to 3 mm and 8°. Default: no error."""
    video: bool = False
    """Write a video of the run."""
    settle_steps: int | None = within(1, 1000, default=None)
    """Number of time steps at rest before each image; for a simulated tip. Default: half the fidelity's on surfaces, a
    quarter along edges."""
    speed_scale: float = within(0.1, 4, default=1.0)
    """Factor on the distance that the tip moves per time step; for a simulated tip."""
    route: RouteOptions = field(default_factory=RouteOptions)
    """Route."""
    settings: Settings = field(default_factory=Settings)
    """Settings of the follower."""
    filter: FilterSettings = field(default_factory=FilterSettings)
    """Filter of poses over steps."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def network(self) -> str:
        """Name or folder of the network. With the ground truth as estimator, its label ranges are still used."""
        return f"{_SHIPPED[self.task]}-{self.design}" if self.model in ("", "oracle") else self.model


_SHIPPED: dict[Task, str] = {"surface": "surface-curved-256px", "edge": "edge"}
"""First part of the shipped networks' names by task. Wide images tell more where a surface bends (docs/learning.md)."""
