"""A surface that is bent, evenly or not: what the tip feels on curved things."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh

HALF_WIDTH_M = 30e-3
"""Half the width of the piece of surface, m: more than the tip reaches."""

MAX_CURVATURE_PER_M = 100.0
"""Greatest curvature, 1/m: a radius of 10 mm."""

MAX_HOLLOW_PER_M = 30.0
"""Greatest curvature of a hollow, 1/m: into one of 20 mm radius the tip fits without room."""

_SPACING_M = 1e-3
"""Spacing of the triangles' corners, m: they are less than 40 µm off at the greatest curvature
(tests/sim/contact/test_curved_surface.py)."""

_THICK_M = 10e-3
"""What is below the lowest point, m."""


STRETCHES_M = (4e-3, 40e-3)
"""Lengths over which an unevenly bent surface is as round, m: from what is just felt to twice the tip's radius [?]."""


def sample_curved_surface(draw, low_per_m, high_per_m, uneven):
    """A curved_surface (Solid) whose principal curvatures are drawn from low to high, 1/m, and turned at random.

    draw: numpy Generator. uneven: float, the chance that the curvature along each direction goes from one value to another
    at once, after a length of STRETCHES_M, as on solids made of round parts. So things are often as round as they may be:
    values are drawn from twice the range and cut to it.
    """
    # An even surface draws nothing for it: its set keeps the bytes that it had before there were others.
    if not (uneven and draw.uniform() < uneven):
        return curved_surface(*draw.uniform(low_per_m, high_per_m, 2), draw.uniform(0, np.pi))
    profiles = [_drawn_profile(draw, low_per_m, high_per_m) for _ in range(2)]
    return curved_surface(0.0, 0.0, draw.uniform(0, np.pi), profiles)


def _drawn_profile(draw, low_per_m, high_per_m):
    """A Profile, over the whole piece of surface."""
    spare, ends = (high_per_m - low_per_m) / 2, []
    end = -HALF_WIDTH_M * np.sqrt(2)
    while not ends or ends[-1] < HALF_WIDTH_M * np.sqrt(2):
        length = np.exp(draw.uniform(*np.log(STRETCHES_M)))
        # Where the piece begins, the first stretch has begun at random.
        end += length * (draw.uniform() if not ends else 1.0)
        ends.append(end)
    values = np.clip(draw.uniform(low_per_m - spare, high_per_m + spare, len(ends)), low_per_m, high_per_m)
    return Profile(tuple(ends[:-1]), tuple(values))


@dataclass(frozen=True)
class Profile:
    """How a surface is bent along one direction: as round as one value, and then as another."""

    changes_m: tuple[float, ...]
    """(n) where it changes, m, rising."""

    per_m: tuple[float, ...]
    """(n + 1) curvatures before, between and after, 1/m."""

    def top(self, s):
        """z at s, m: (n,), m. Its second derivative is minus the curvature; at 0 it is 0, and level."""
        out = -self.per_m[0] * s**2 / 2
        for at, step in zip(self.changes_m, np.diff(self.per_m), strict=True):
            out -= step * (np.maximum(s - at, 0) ** 2 - max(-at, 0) ** 2 - 2 * s * max(-at, 0)) / 2
        return out


def curved_surface(first_per_m, second_per_m, turn_rad, profiles=()):
    """A Solid whose top is z = -(k1 u^2 + k2 v^2) / 2 and what the profiles add, level at the origin.

    first_per_m, second_per_m: float, its principal curvatures k1 and k2, 1/m, positive where it bulges out. turn_rad: float,
    from x to u. profiles: up to two Profiles, along u and along v.
    """
    count = round(2 * HALF_WIDTH_M / _SPACING_M) + 1
    line = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, count)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    top = -(first_per_m * u**2 + second_per_m * v**2) / 2
    for profile, s in zip(profiles, (u, v), strict=False):
        top += profile.top(s)
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    across = np.stack([cos * u - sin * v, sin * u + cos * v], -1)
    low = np.full(len(u), top.min() - _THICK_M)
    vertices = np.concatenate([np.column_stack([across, top]), np.column_stack([across, low])])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(count - 1), np.arange(count - 1), indexing="ij"))
    corner, beside, ahead, across_it = i * count + j, i * count + j + 1, (i + 1) * count + j, (i + 1) * count + j + 1
    upper = np.concatenate([np.stack([corner, ahead, beside], 1), np.stack([beside, ahead, across_it], 1)])
    under = upper[:, ::-1] + len(u)
    k = np.arange(count - 1)
    rim = np.concatenate([k * count, (count - 1) * count + k, (count - 1 - k) * count + count - 1, count - 1 - k])
    after = np.roll(rim, -1)
    sides = np.concatenate([
        np.stack([rim, rim + len(u), after], 1), np.stack([after, rim + len(u), after + len(u)], 1)
    ])  # fmt: skip
    return SignedDistanceMesh(vertices, np.concatenate([upper, under, sides]))
