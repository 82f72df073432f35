"""The deformation of the skin as a sum of modes that can be turned and mirrored exactly.

The tip is round, so a contact that is turned about the tip's axis turns the skin's deformation with it. Displacements and
changes of the normal are sampled on rings around the apex, in components along, around and across each ring. A Fourier
series along each ring gives coefficients that a turn by an angle a multiplies by exp(-i m a), where m is the order, and
that a mirror conjugates. Modes are the principal components of each order over many contacts.

The field lives in label axes (sim/pose.py), whose x is the sensor's and whose y and z are the sensor's reversed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from tactip_twin.sim.pose import FACING
from tactip_twin.tactip_model.mesh import Mesh
from tactip_twin.tactip_model.pins import SkinReader

RING_ANGLES = np.radians(np.linspace(1.5, 88.0, 28))
"""Polar angles of the rings, rad: 1.1 mm apart on a dome of 20 mm, closer than the vertices of `standard`."""

AZIMUTHS = 64
"""Number of points on a ring."""

MAX_ORDER = 20
"""Highest order of the Fourier series along a ring. Higher ones hold less than a micrometre each [M]."""

NORMAL_LEVER_M = 2e-3
"""Length that converts a change of the normal into a displacement, m: about that of a pin."""

_MM = 1e3
_ODD = np.array([False, True, False, False, True, False])
"""Components that change sign in a mirror: those along the ring."""


def ring_directions() -> np.ndarray:
    """Return the outward directions (rings * azimuths, 3) of the points on the rings, in the sensor frame."""
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    sine, cosine = np.sin(RING_ANGLES)[:, None], np.cos(RING_ANGLES)[:, None]
    # Azimuths are counted in label axes, whose y is the sensor's reversed.
    points = np.stack([sine * np.cos(azimuth), -sine * np.sin(azimuth), cosine + 0 * azimuth], -1)
    return points.reshape(-1, 3)


class SkinSampler:
    """Samples the deformation of a meshed skin on the rings."""

    def __init__(self, mesh: Mesh) -> None:
        """Prepare the interpolation for an undeformed mesh."""
        self._reader = SkinReader(mesh, ring_directions())

    def harmonics(self, skin: np.ndarray) -> np.ndarray:
        """Return the Fourier coefficients (n, rings, 6, MAX_ORDER + 1) complex64 of deformed skins.

        Components are the displacement outward, along the ring, and along z, in mm, then the change of the normal times
        NORMAL_LEVER_M likewise; all in label axes.

        Args:
            skin: (n, s, 3) m, vertices of the skin in the sensor frame.
        """
        moved, turned = self._reader.read(np.asarray(skin, float))
        both = np.concatenate([self._in_rings(moved), self._in_rings(NORMAL_LEVER_M * turned)], 2)
        return (np.fft.rfft(_MM * both, axis=-1)[..., : MAX_ORDER + 1] / AZIMUTHS).astype(np.complex64)

    @staticmethod
    def _in_rings(vectors: np.ndarray) -> np.ndarray:
        """Return vectors (n, rings * azimuths, 3) of the sensor frame as components (n, rings, 3, azimuths)."""
        x, y, z = np.moveaxis((vectors @ FACING).reshape(len(vectors), len(RING_ANGLES), AZIMUTHS, 3), -1, 0)
        azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
        cosine, sine = np.cos(azimuth), np.sin(azimuth)
        return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], 2)


def _stacked(harmonics: np.ndarray) -> np.ndarray:
    """Return harmonics (n, rings, 6, orders) as (n, rings * 6, orders), weighted by the area of the rings.

    Odd components are multiplied by i, so a mirror conjugates all of them.
    """
    weighted = harmonics * np.sqrt(np.sin(RING_ANGLES))[:, None, None]
    weighted[:, :, _ODD] *= 1j
    return weighted.reshape(len(harmonics), -1, harmonics.shape[-1])


def principal_modes(stacked: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` principal components with the largest mean square, over all orders.

    Args:
        stacked: (k, size, orders) complex, of fields whose mirror images are their conjugates.
        count: Number of components; fewer if there are not as many.

    Returns:
        Their orders (count,), and profiles (count, size), orthonormal within an order.
    """
    found = []
    for order in range(stacked.shape[-1]):
        # Over mirrored fields too, the covariance is real.
        parts = np.concatenate([stacked[:, :, order].real, stacked[:, :, order].imag]).astype(float)
        power, vectors = np.linalg.eigh(parts.T @ parts / len(stacked))
        found += [(power[-k], order, vectors[:, -k]) for k in range(1, min(count, len(power)) + 1)]
    found.sort(key=lambda mode: -mode[0])
    chosen = found[:count]
    return np.array([order for _, order, _ in chosen]), np.array([vector for _, _, vector in chosen])


@dataclass(frozen=True)
class Modes:
    """Modes of the skin's deformation, the largest first. (n modes)"""

    orders: np.ndarray
    """(n,) int, order m of each mode."""
    profiles: np.ndarray
    """(n, rings * 6) float, orthonormal within an order: principal components, with the weights of `_stacked`."""

    @staticmethod
    def fit(harmonics: np.ndarray, count: int) -> "Modes":
        """Return the `count` modes with the largest mean square over deformations.

        Args:
            harmonics: (n, rings, 6, MAX_ORDER + 1), as of SkinSampler.harmonics.
            count: Number of modes.
        """
        return Modes(*principal_modes(_stacked(harmonics), count))

    def check(self) -> None:
        """Raise ValueError unless orders and profiles are those of modes."""
        orders, size = self.orders, (len(self.orders), 6 * len(RING_ANGLES))
        if orders.dtype != np.int64 or not ((orders >= 0) & (orders <= MAX_ORDER)).all():
            raise ValueError(f"orders must be integers from 0 to {MAX_ORDER}")
        if self.profiles.shape != size or not np.isfinite(self.profiles).all():
            raise ValueError(f"profiles must be finite numbers of shape {size}")

    def coefficients(self, harmonics: np.ndarray) -> np.ndarray:
        """Return the coefficients (k, n) complex of deformations with harmonics (k, rings, 6, MAX_ORDER + 1)."""
        stacked = _stacked(harmonics)
        return np.einsum("kpn,np->kn", stacked[:, :, self.orders], self.profiles)

    def turned(self, coefficients: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return coefficients (k, n) of deformations that are turned about the tip's axis.

        Args:
            coefficients: (k, n) complex.
            angles: (k,) rad, about z of the label axes.
        """
        return coefficients * np.exp(-1j * np.multiply.outer(angles, self.orders))

    def at(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacement (2n, p, 3), m, and the change of the normal (2n, p, 3) at points for unit coefficients.

        The first n belong to the real parts of coefficients, the others to their imaginary parts.

        Args:
            directions: (p, 3) unit, sensor frame, from the dome's centre to the points on the skin.
        """
        label = directions @ FACING
        azimuth, polar = np.arctan2(label[:, 1], label[:, 0]), np.arccos(np.clip(directions[:, 2], -1, 1))
        profiles = self.profiles.reshape(-1, len(RING_ANGLES), 6) / np.sqrt(np.sin(RING_ANGLES))[:, None]
        # Across the apex, components along and around a ring change sign, and so does a field of odd order.
        parity = np.array([-1, -1, 1, -1, -1, 1]) * ((-1.0) ** self.orders)[:, None]
        mirrored = (profiles * parity[:, None])[:, 2::-1]
        knots = np.concatenate([-RING_ANGLES[2::-1], RING_ANGLES])
        spline = CubicSpline(knots, np.concatenate([mirrored, profiles], 1), axis=1)
        values = spline(polar).astype(complex)  # (n, p, 6)
        values[..., _ODD] /= 1j
        wave = np.where(self.orders > 0, 2, 1)[:, None] * np.exp(1j * np.multiply.outer(self.orders, azimuth))
        values *= wave[..., None]
        real = np.concatenate([values.real, -values.imag])  # Re(c v) = Re c Re v - Im c Im v
        cosine, sine = np.cos(azimuth), np.sin(azimuth)

        def vectors(part: np.ndarray) -> np.ndarray:
            outward, along, z = np.moveaxis(part, -1, 0)
            return np.stack([cosine * outward - sine * along, sine * outward + cosine * along, z], -1) @ FACING / _MM

        return vectors(real[..., :3]), vectors(real[..., 3:]) / NORMAL_LEVER_M
