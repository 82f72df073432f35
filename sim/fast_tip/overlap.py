"""How far the undeformed tip reaches into an object: what the sliding tip knows of the object's shape.

The dome is sampled on rings around its apex. How deep each point would lie inside the object describes depth, tilt,
curvature, edges and ridges alike, and turns and mirrors as the skin's deformation does (skin_field.py).
"""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.fast_tip.skin_field import RING_ANGLES, principal_modes

RINGS, AZIMUTHS = 20, 32
"""Number of rings, the first of RING_ANGLES, up to a polar angle of 62 degrees; and of points on each."""

MAX_ORDER = 12
"""Highest order of the Fourier series along a ring."""

NEAR_M = 0.5e-3
"""Distance from the object up to which a point counts, m: skin that may touch soon."""

_MM = 1e3
_WEIGHT = np.sqrt(np.sin(RING_ANGLES[:RINGS]))


def dome_points(radius_m: float) -> np.ndarray:
    """Return the points (RINGS * AZIMUTHS, 3), m, on an undeformed dome of a radius, in the sensor frame."""
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    sine, cosine = np.sin(RING_ANGLES[:RINGS])[:, None], np.cos(RING_ANGLES[:RINGS])[:, None]
    # Azimuths are counted in label axes, whose y is the sensor's reversed.
    directions = np.stack([sine * np.cos(azimuth), -sine * np.sin(azimuth), cosine + 0 * azimuth], -1)
    return radius_m * (directions.reshape(-1, 3) - [0.0, 0.0, 1.0])


def overlap_harmonics(distances: np.ndarray) -> np.ndarray:
    """Return the Fourier coefficients (k, RINGS, MAX_ORDER + 1) complex64, mm, of overlaps, weighted by the rings' areas.

    Args:
        distances: (k, RINGS * AZIMUTHS) m, signed distances of the points to the object, negative inside.
    """
    overlap = _MM * np.maximum(NEAR_M - distances, 0.0).reshape(-1, RINGS, AZIMUTHS)
    spectrum = np.fft.rfft(overlap, axis=-1)[..., : MAX_ORDER + 1] / AZIMUTHS
    return (spectrum * _WEIGHT[:, None]).astype(np.complex64)


@dataclass(frozen=True)
class OverlapModes:
    """Modes of the overlap, the largest first. (n modes)"""

    orders: np.ndarray
    """(n,) int, order of each mode."""
    profiles: np.ndarray
    """(n, RINGS) float, orthonormal within an order."""

    @staticmethod
    def fit(harmonics: np.ndarray, count: int) -> "OverlapModes":
        """Return the `count` modes with the largest mean square over overlaps (k, RINGS, MAX_ORDER + 1)."""
        return OverlapModes(*principal_modes(harmonics, count))

    def coefficients(self, harmonics: np.ndarray) -> np.ndarray:
        """Return the coefficients (k, n) complex of overlaps with harmonics (k, RINGS, MAX_ORDER + 1)."""
        return np.einsum("kpn,np->kn", harmonics[:, :, self.orders], self.profiles)

    def turned(self, coefficients: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return coefficients (k, n) of overlaps that are turned about the tip's axis by angles (k,), rad."""
        return coefficients * np.exp(-1j * np.multiply.outer(angles, self.orders))

    def check(self) -> None:
        """Raise ValueError unless orders and profiles are those of modes."""
        orders, size = self.orders, (len(self.orders), RINGS)
        if orders.dtype != np.int64 or not ((orders >= 0) & (orders <= MAX_ORDER)).all():
            raise ValueError(f"orders of the overlap must be integers from 0 to {MAX_ORDER}")
        if self.profiles.shape != size or not np.isfinite(self.profiles).all():
            raise ValueError(f"profiles of the overlap must be finite numbers of shape {size}")
