"""Options of a servo run. Nothing heavy is imported here, because the command line is made from these classes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from tactip_twin.sim.labels import FidelityName, Task
from tactip_twin.sim.robot.arm_names import ArmName
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.renderer import RendererName

GainsName = Literal["paper", "tactile-servo-control"]
"""Names of the gains (servo.GAINS)."""

RouteKind = Literal["serpentine", "straight", "geodesic"]
"""Kinds of routes over a surface."""

UnitName = Literal["mm", "cm", "m"]
"""Units of mesh files."""


@dataclass(frozen=True)
class Settings:
    """How an object is explored."""

    step_mm: float = within(0.05, 10, default=1.0)
    """Tangential step, mm [P]."""
    slowdown_angle_deg: float | None = within(0, 90, default=None)
    """Felt angle to the normal at which the step would be nothing, degrees: it shrinks evenly with the angle, to a fifth at
    0.8 of it, and no further. 0: never, as the paper. If not given 2 over surfaces (docs/servo.md has what it buys on the
    bust, and at what price), and 0 along edges, whose pitch is felt to 2 degrees only."""
    contact_threshold: float = within(0.01, 0.99, default=0.12)
    """How far an image must be from that of a tip in the air to count as touched, -: on a ball and a rim, presses of half a
    millimetre gave 0.1, of one 0.2. An estimate: what a camera's noise gives is not measured."""
    search_mm: float = within(0, 50, default=12.0)
    """How far contact is looked for along the sensor's axis, mm."""
    search_step_mm: float = within(0.05, 2, default=0.5)
    """Steps of that, mm."""
    alignment_steps: int = within(1, 100, default=12)
    """Steps without going on, in which the servo finds the reference after contact is made."""
    range_margin: float = within(0, 10, default=0.5)
    """How far an estimate may be out of the range that was learned, in its half width: farther, it is none."""
    max_force_n: float = within(0.1, 100, default=8.0)
    """Force at which the arm stops and backs off, N; an estimate, above what a press as deep as was learned takes."""
    retract_mm: float = within(0.1, 20, default=2.0)
    """How far it backs off along the sensor's axis, mm."""
    max_recoveries: int = within(0, 1000, default=5)
    """Reactions in a row, without three good steps between, after which it gives up."""
    max_steps: int = within(1, 1000000, default=20000)
    """Steps after which it stops."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class RouteOptions:
    """Where to go."""

    kind: RouteKind = "serpentine"
    """Over a surface: serpentine, straight, or geodesic, which keeps its heading as the sensor feels it."""
    middle_mm: tuple[float, float] | None = None
    """Middle of the region in the base frame, x and y, mm; that of the object (of the bust, its face) if not given."""
    length_mm: float = within(1, 1000, default=60.0)
    """Length of a pass, mm."""
    width_mm: float = within(0, 1000, default=40.0)
    """Width of the region, mm."""
    spacing_mm: float = within(1, 100, default=10.0)
    """Distance between passes, mm."""
    heading_deg: float = within(-360, 360, default=90.0)
    """Direction of the passes in the base frame, from x towards y, degrees."""
    reverse: bool = False
    """Along an edge: clockwise as seen from above."""
    start_fraction: float = within(0, 1, default=0.0)
    """Along an edge: where to begin, as a share of it."""
    max_length_mm: float = within(1, 10000, default=1000.0)
    """Along an edge: longest way, mm."""

    def __post_init__(self) -> None:
        check(self)
        lookup("route", self.kind, dict.fromkeys(get_args(RouteKind)))


@dataclass(frozen=True)
class ServoOptions:
    """A servo run."""

    out: Path
    """Folder of the run."""
    task: Task = "surface"
    """Task."""
    object: str = "bust"
    """One of the project's objects, or a mesh file (.stl, .obj, .ply, .glb)."""
    unit: UnitName | None = None
    """What a file's numbers are in: mm, which it is if not given, cm or m."""
    scale: float = within(1e-6, 1e6, default=1.0)
    """Size of the object over that."""
    position_mm: tuple[float, float, float] | None = within(-1e4, 1e4, default=None)
    """Where the middle of its underside is in the base frame, mm; in front of the arm if not given."""
    rotation_deg: tuple[float, float, float] | None = None
    """How it is turned, rotation vector, degrees."""
    model: str = ""
    """A shipped network or the folder of a training; `oracle` is the truth. If empty the shipped one: for surfaces, that
    which has felt bent ones."""
    design: str = "tactip-127"
    """Sensor."""
    fidelity: FidelityName = "standard"
    """Fidelity of the simulation."""
    arm: ArmName = "dynamic"
    """Arm model."""
    renderer: RendererName = "pyrender"
    """Renderer of the pins; raster works without OpenGL."""
    gains: GainsName = "paper"
    """Gains of the controller: the paper's, or those of the authors' later work."""
    depth_mm: float | None = within(0.2, 8, default=None)
    """Depth that is kept, mm; if not given 2 over surfaces, where a shallow touch feels finer things, and 3 along edges."""
    noise_grey: float = within(0, 255, default=0.0)
    """Standard deviation of the camera's noise, of 255."""
    friction: float | None = within(0, 2, default=None)
    """Friction between tip and object, -; the design's if not given."""
    stiffness: float = within(0.05, 20, default=1.0)
    """Moduli of skin and gel, over the design's."""
    seed: int | None = within(0, 2**63 - 1, default=None)
    """Seed of a start that is off the mark: by up to 3 mm and 8 degrees. Without, it is on it."""
    video: bool = False
    """Make a film of the run, too."""
    settle_steps: int | None = within(1, 1000, default=None)
    """Time steps at rest before an image is taken; half of the fidelity's over surfaces and a quarter along edges if not
    given."""
    speed_scale: float = within(0.1, 4, default=1.0)
    """Way of the tip in a time step, over the fidelity's."""
    route: RouteOptions = field(default_factory=RouteOptions)
    """Where to go."""
    settings: Settings = field(default_factory=Settings)
    """How to explore."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def network(self) -> str:
        """Name or folder of the network. With the ground truth as estimator, its label ranges are still used."""
        return f"{_SHIPPED[self.task]}-{self.design}" if self.model in ("", "oracle") else self.model


_SHIPPED: dict[Task, str] = {"surface": "surface-bent", "edge": "edge"}
"""First part of the shipped networks' names by task."""
