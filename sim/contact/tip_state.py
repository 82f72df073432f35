"""What there is to know of a tip at one moment, on its way or at rest."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TipState:
    """What there is to know of the tip at one moment, sensor frame. (p pins, s vertices of the skin)"""

    tips: np.ndarray
    """(p, 3) m."""
    directions: np.ndarray
    """(p, 3), unit."""
    skin: np.ndarray
    """(s, 3) m."""
    force: np.ndarray
    """(3,) N, of the object on the tip."""
    penetration_m: float
    """Greatest penetration, m."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    steps: int
    """Time steps since the touch before."""
    clearance_m: float = np.inf
    """Distance from the sensor's housing, which is not soft, to the object, m; negative inside."""


def read_tip_state(scene, reader, steps=0, clearance_m=np.inf):
    """The Touch of a scene.Scene as it is now. reader: PinReader of its skin. steps, clearance_m: as of TipState."""
    skin = scene.vertices()[: scene.mesh.surface_count]
    force, speed = scene.contact_force(), scene.max_vertex_speed()
    return TipState(*reader.read(skin), skin, force, scene.penetration(), speed, steps, clearance_m)
