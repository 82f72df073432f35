"""Options of tracking a moving object. Nothing heavy is imported here, because the command line is made from this class."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tactip_twin.control.options import GainsName
from tactip_twin.sim.labels import FidelityName
from tactip_twin.sim.robot.arm_names import ArmName
from tactip_twin.sim.robot.object_motion import ObjectMotion
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.renderer import RendererName


@dataclass(frozen=True)
class TrackOptions:
    """Options of tracking a moving object."""

    out: Path
    """Folder of the results."""
    object: str = "plate"
    """Object with a flat top: one of the project's, or a mesh file in mm."""
    position_mm: tuple[float, float, float] = within(-1e4, 1e4, default=(400.0, 0.0, 150.0))
    """Position of the centre of the object's underside in the base frame, mm."""
    model: str = "surface-curved-tactip-127"
    """Network that estimates pose and shear: a shipped one, or the folder of a training. `oracle` uses the true ones."""
    design: str = "tactip-127"
    """Sensor: a preset's name, or a design file (.json)."""
    fidelity: FidelityName | Literal["fast"] = "standard"
    """Fidelity of the contact simulation; fast: predict the contact by the learned tip (errors: docs/tracking.md)."""
    impratio: float = within(0.1, 1000, default=3.0)
    """Ratio of frictional to normal impedance of the simulation, -. Skin that sticks to a moving object creeps, the less the
    higher it is, and the longer a step takes (docs/tracking.md). Without effect on --fidelity fast."""
    arm: ArmName = "dynamic"
    """Arm model: none (the sensor moves exactly), kinematic (inverse kinematics), dynamic (with masses and motors)."""
    renderer: RendererName = "raster"
    """Renderer of the pins."""
    gains: GainsName = "paper"
    """Controller gains."""
    depth_mm: float = within(0.5, 5, default=4.0)
    """Commanded contact depth, mm. A deep contact withstands more shear before it slips."""
    seconds: float = within(0.1, 10000, default=60.0)
    """Duration, s."""
    rate_hz: float = within(1, 200, default=30.0)
    """Control steps per second; the object moves on meanwhile [?]."""
    motion: Annotated[ObjectMotion, tyro.conf.arg(name="")] = field(default_factory=ObjectMotion)
    """Motion of the object."""

    def __post_init__(self) -> None:
        check(self)
