"""Rims that are hard to follow: one with a gap, and one with sharp corners."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.assets.meshes.rims import Rim, closed, filled

_WALL_MM = 1.5
"""Length along the edge over which the wall of a gap falls, mm."""


@dataclass(frozen=True)
class GappedRim(Rim):
    """A container with a gap in its wall. The edge runs on across the gap."""

    gap_mm: float = 25.0
    """Width of the gap along the edge, mm."""
    gap_depth_mm: float = 20.0
    """Depth of the gap, mm."""
    gap_turn_rad: float = 2.0
    """Angle around the edge of the middle of the gap, rad."""

    lip_mm: float = 3.0
    """Radius of the gap's upper ends, mm."""

    def top(self, turn: np.ndarray) -> np.ndarray:
        """Return points of the top's outer edge (n, 3), mm, at angles (n,), rad: those of the edge, lowered in the gap."""
        away = np.abs((turn - self.gap_turn_rad + np.pi) % (2 * np.pi) - np.pi) * self.radius_mm - self.gap_mm / 2
        lip = self.lip_mm - np.sqrt(self.lip_mm**2 - np.clip(self.lip_mm - away, 0, self.lip_mm) ** 2)
        wall = (self.gap_depth_mm - self.lip_mm) * np.clip(-away / _WALL_MM, 0, 1)
        return self.edge(turn) - np.outer(lip + wall, [0, 0, 1])

    def mesh(self, sectors: int = 960) -> tuple[np.ndarray, np.ndarray]:
        """See Rim; the gap needs more sectors."""
        return super().mesh(sectors)


@dataclass(frozen=True)
class CorneredRim(Rim):
    """A block whose top is a square with rounded corners; radius_mm is half its width."""

    corner_mm: float = 5.0
    """Radius of the corners, mm."""

    def edge(self, turn: np.ndarray) -> np.ndarray:
        """Return points of the edge (n, 3), mm, at angles around it (n,), rad, that are even in its length."""
        straight, arc = 2 * (self.radius_mm - self.corner_mm), np.pi / 2 * self.corner_mm
        side, along = np.divmod(np.asarray(turn) / (np.pi / 2) * (straight + arc), straight + arc)
        # A side from the middle of the right one's lower corner upward, then the corner.
        bend = np.clip(along - straight, 0, arc) / self.corner_mm
        x = self.radius_mm - self.corner_mm + self.corner_mm * np.cos(bend)
        y = -straight / 2 + np.minimum(along, straight) + self.corner_mm * np.sin(bend)
        c, s = np.cos(side * np.pi / 2), np.sin(side * np.pi / 2)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros_like(x)], -1)

    def mesh(self, sectors: int = 960) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (n, 3), mm, and triangles (k, 3) of the block, divided into sectors."""
        rings = self._outside(np.arange(sectors) * 2 * np.pi / sectors)
        rings = filled(np.array([*rings, rings[-1] * [0.05, 0.05, 1.0]]))
        return closed(rings, np.array([0, 0, -self.height_mm]), np.zeros(3))


HARD_RIMS: dict[str, Rim] = {"rim-gap": GappedRim(60.0), "rim-corners": CorneredRim(50.0)}
"""Rims by name."""
