"""A surface that is bent: what the tip feels on curved things, to second order, and to third where its curvatures change."""

import numpy as np

from sim.solid import Solid

HALF_WIDTH_M = 30e-3
"""Half the width of the piece of surface, m: more than the tip reaches."""

MOST_BENT_PER_M = 100.0
"""Greatest curvature, 1/m: a radius of 10 mm."""

MOST_HOLLOW_PER_M = 30.0
"""Greatest curvature of a hollow, 1/m: into one of 20 mm radius the tip fits without room."""

_SPACING_M = 1e-3
"""Spacing of the triangles' corners, m: they are less than 40 µm off at the greatest curvature (tests/test_bent.py)."""

_THICK_M = 10e-3
"""What is below the lowest point, m."""


SKEW_M = 10e-3
"""How far from the origin the curvatures of a skewed surface are drawn, m: about as wide as what is touched."""

_DRAWS = 1000
"""Draws after which a surface is left without a skew: one in four or so is good."""


def drawn_surface(draw, low_per_m, high_per_m, skewed):
    """A bent_surface (Solid) whose principal curvatures are drawn from low to high, 1/m, and turned at random.

    draw: numpy Generator. skewed: bool; with it the curvatures change evenly along the surface, by as much as leaves them
    within the range as far as SKEW_M: how they do is drawn again until it does.
    """
    if not skewed:
        return bent_surface(*draw.uniform(low_per_m, high_per_m, 2), draw.uniform(0, np.pi))
    (first, second), turn = draw.uniform(low_per_m, high_per_m, 2), draw.uniform(0, np.pi)
    around = 2 * np.pi * np.arange(16) / 16
    u, v = SKEW_M * np.concatenate([[np.cos(around), np.sin(around)], 0.5 * np.array([np.cos(around), np.sin(around)])], 1)
    room = np.array([min(k - low_per_m, high_per_m - k) for k in (first, second)]) / SKEW_M
    for _ in range(_DRAWS):
        skew = draw.uniform(-1, 1, 4) * room[[0, 0, 1, 1]]
        mean, half, twist = _second_order(first, second, skew, u, v)
        off = np.hypot(half, twist)
        if np.all(mean - off >= low_per_m) and np.all(mean + off <= high_per_m):
            return bent_surface(first, second, turn, tuple(skew))
    return bent_surface(first, second, turn)


def _second_order(first, second, skew, u, v):
    """Half the sum and half the difference of the second derivatives along u and v, and the mixed one, of -z: (n,) each."""
    a, b, c, d = skew
    along, across = first + a * u + b * v, second + c * u + d * v
    return (along + across) / 2, (along - across) / 2, b * u + c * v


def bent_surface(first_per_m, second_per_m, turn_rad, skew_per_m2=(0.0, 0.0, 0.0, 0.0)):
    """A Solid whose top is z = -(k1 u^2 + k2 v^2) / 2 - (a u^3 + 3 b u^2 v + 3 c u v^2 + d v^3) / 6, level at the origin.

    first_per_m, second_per_m: float, its principal curvatures k1 and k2 at the origin, 1/m, positive where it bulges out.
    turn_rad: float, from x to u. skew_per_m2: (4,), how the curvatures change: a to d, 1/m^2.
    """
    count = round(2 * HALF_WIDTH_M / _SPACING_M) + 1
    line = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, count)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    a, b, c, d = skew_per_m2
    top = -(first_per_m * u**2 + second_per_m * v**2) / 2
    top -= (a * u**3 + 3 * b * u**2 * v + 3 * c * u * v**2 + d * v**3) / 6
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
    return Solid(vertices, np.concatenate([upper, under, sides]))
