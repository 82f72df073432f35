"""State of the tip at one moment, moving or at rest."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tactip_twin.sim.contact.scene import Scene
from tactip_twin.tactip_model.pins import PinReader

StoppedBy = Literal["", "force", "housing"]
"""What stops an arm on its way: too much force on the tip, or the sensor's housing that runs against the object."""


@dataclass(frozen=True)
class TipState:
    """State of the tip at one moment, in the sensor frame. (p pins, s vertices of the skin)"""

    pin_tips: np.ndarray
    """(p, 3) pin tips, m."""
    directions: np.ndarray
    """(p, 3) unit vectors from the pins' roots to their tips."""
    skin: np.ndarray
    """(s, 3) vertices of the skin, m."""
    force: np.ndarray
    """(3,) force of the object on the tip, N."""
    penetration_m: float
    """Maximum penetration, m."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    steps: int
    """Number of time steps since the previous state."""
    clearance_m: float = np.inf
    """Distance from the sensor's rigid housing to the object, m; negative inside."""
    peak_force_n: float = 0.0
    """Maximum force on the tip during the motion that led here, N; 0 without a motion."""
    stopped_by: StoppedBy = ""
    """What stopped the arm on that motion, so that it moved back; empty if nothing did."""


def read_tip_state(scene: Scene, reader: PinReader, steps: int = 0, clearance_m: float = np.inf) -> TipState:
    """Return the current state of the tip.

    Args:
        scene: The scene.
        reader: Pin reader for the scene's skin.
        steps: Number of time steps since the previous state.
        clearance_m: Distance from the housing to the object.
    """
    skin = scene.vertices()[: scene.mesh.surface_count]
    tips, directions = reader.read(skin)
    return TipState(
        pin_tips=tips,
        directions=directions,
        skin=skin,
        force=scene.contact_force(),
        penetration_m=scene.penetration(),
        speed_m_s=scene.max_vertex_speed(),
        steps=steps,
        clearance_m=clearance_m,
    )
