"""Curved surfaces, with constant or varying curvature, for contacts on curved objects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh

HALF_WIDTH_M = 30e-3
"""Half the width of the piece of surface, m, which is more than the tip reaches."""

MAX_CURVATURE_PER_M = 100.0
"""Maximum curvature, 1/m: a radius of 10 mm."""

MAX_HOLLOW_PER_M = 30.0
"""Maximum curvature of a hollow, 1/m. The tip does not fit into a hollow of 20 mm radius."""

_SPACING_M = 1e-3
"""Spacing of the triangles' corners, m: the surface is less than 40 µm off at the maximum curvature
(tests/sim/contact/test_curved_surface.py)."""

_THICKNESS_M = 10e-3
"""Thickness of the solid below the lowest point of its top, m."""


STRETCHES_M = (4e-3, 40e-3)
"""Minimum and maximum length of a stretch of constant curvature, m: from barely noticeable to twice the tip's radius [?]."""


@dataclass(frozen=True)
class Curvatures:
    """Curvatures of a surface, level at the origin, in its axes u and v."""

    first_per_m: float
    """Principal curvature along u, 1/m; positive where the surface bulges out."""
    second_per_m: float
    """Principal curvature along v, 1/m."""
    turn_rad: float
    """Angle from x to u, rad."""
    profiles: "tuple[()] | tuple[Profile, Profile]" = ()
    """Curvatures along u and along v that are added, if they vary; the first two numbers are then 0."""

    def solid(self) -> SignedDistanceMesh:
        """Return the surface as the top of a closed mesh."""
        return curved_surface(self.first_per_m, self.second_per_m, self.turn_rad, self.profiles)


def sample_curvatures(
    rng: np.random.Generator, low_per_m: float, high_per_m: float, varying_curvature_fraction: float
) -> Curvatures:
    """Return random principal curvatures with a random rotation about the normal.

    Args:
        rng: Random generator.
        low_per_m: Minimum curvature, 1/m.
        high_per_m: Maximum curvature, 1/m.
        varying_curvature_fraction: Probability of curvatures that change abruptly along both directions after stretches
            of STRETCHES_M, as on solids with round parts. Their values are sampled from twice the range and
            clipped to it, so surfaces are often as curved as allowed.
    """
    # Without varying curvature no number is sampled for it, so sets made before that option keep their bytes.
    if not (varying_curvature_fraction and rng.uniform() < varying_curvature_fraction):
        first_per_m, second_per_m = rng.uniform(low_per_m, high_per_m, 2)
        return Curvatures(first_per_m, second_per_m, rng.uniform(0, np.pi))
    first, second = (_sample_profile(rng, low_per_m, high_per_m) for _ in range(2))
    return Curvatures(0.0, 0.0, rng.uniform(0, np.pi), (first, second))


def _sample_profile(rng: np.random.Generator, low_per_m: float, high_per_m: float) -> "Profile":
    """Return a random profile over the whole piece of surface."""
    margin, ends = (high_per_m - low_per_m) / 2, []
    end = -HALF_WIDTH_M * np.sqrt(2)
    while not ends or ends[-1] < HALF_WIDTH_M * np.sqrt(2):
        length = np.exp(rng.uniform(*np.log(STRETCHES_M)))
        # The piece begins at a random position within its first stretch.
        end += length * (rng.uniform() if not ends else 1.0)
        ends.append(end)
    values = np.clip(rng.uniform(low_per_m - margin, high_per_m + margin, len(ends)), low_per_m, high_per_m)
    return Profile(tuple(ends[:-1]), tuple(values))


@dataclass(frozen=True)
class Profile:
    """Piecewise constant curvature of a surface along one direction."""

    changes_m: tuple[float, ...]
    """(n) positions where the curvature changes, m, rising."""

    per_m: tuple[float, ...]
    """(n + 1) curvatures before, between and after the changes, 1/m."""

    def top(self, s: np.ndarray) -> np.ndarray:
        """Return the height z (n,) m at positions s (n,) m: its second derivative is minus the curvature, and at s = 0 it is
        zero and level."""
        out = -self.per_m[0] * s**2 / 2
        for at, step in zip(self.changes_m, np.diff(self.per_m), strict=True):
            out -= step * (np.maximum(s - at, 0) ** 2 - max(-at, 0) ** 2 - 2 * s * max(-at, 0)) / 2
        return out


def curved_surface(
    first_per_m: float, second_per_m: float, turn_rad: float, profiles: Sequence[Profile] = ()
) -> SignedDistanceMesh:
    """Return a solid whose top is z = -(k1 u^2 + k2 v^2) / 2 plus the profiles, level at the origin.

    Args:
        first_per_m: Principal curvature k1 along u, 1/m; positive where the surface bulges out.
        second_per_m: Principal curvature k2 along v, 1/m.
        turn_rad: Angle from x to u, rad.
        profiles: Up to two, along u and along v.
    """
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)

    def height(at: np.ndarray) -> np.ndarray:
        """Return heights (...) m at positions (..., 2) m along u and v."""
        top = -(first_per_m * at[..., 0] ** 2 + second_per_m * at[..., 1] ** 2) / 2
        for profile, k in zip(profiles, (0, 1), strict=False):
            top += profile.top(at[..., k])
        return top

    return SignedDistanceMesh(*slab(height, _SPACING_M, np.array([[cos, -sin], [sin, cos]])))


_NO_TURN = np.eye(2)


def slab(
    height: Callable[[np.ndarray], np.ndarray], spacing_m: float, axes: np.ndarray = _NO_TURN
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3), m, and triangles (k, 3) of a solid whose top has heights over a square of twice HALF_WIDTH_M.

    Args:
        height: Heights (...) m at positions (..., 2) m in the square.
        spacing_m: Spacing of the triangles' corners, m.
        axes: Matrix (2, 2) that turns positions in the square to x and y of the solid.
    """
    count = round(2 * HALF_WIDTH_M / spacing_m) + 1
    line = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, count)
    square = np.stack([a.ravel() for a in np.meshgrid(line, line, indexing="ij")], -1)
    # Written out: a matrix product rounds differently from machine to machine, and sets must keep their bytes.
    top, across = height(square), square[:, :1] * axes[:, 0] + square[:, 1:] * axes[:, 1]
    low = np.full(len(top), top.min() - _THICKNESS_M)
    vertices = np.concatenate([np.column_stack([across, top]), np.column_stack([across, low])])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(count - 1), np.arange(count - 1), indexing="ij"))
    corner, beside, ahead, diagonal = i * count + j, i * count + j + 1, (i + 1) * count + j, (i + 1) * count + j + 1
    upper = np.concatenate([np.stack([corner, ahead, beside], 1), np.stack([beside, ahead, diagonal], 1)])
    lower = upper[:, ::-1] + len(top)
    k = np.arange(count - 1)
    rim = np.concatenate([k * count, (count - 1) * count + k, (count - 1 - k) * count + count - 1, count - 1 - k])
    after = np.roll(rim, -1)
    sides = np.concatenate([
        np.stack([rim, rim + len(top), after], 1), np.stack([after, rim + len(top), after + len(top)], 1)
    ])  # fmt: skip
    return vertices, np.concatenate([upper, lower, sides])
