"""A surface that is bent: what the tip feels on curved things, to second order."""

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


def bent_surface(first_per_m, second_per_m, turn_rad):
    """A Solid whose top is z = -(k1 u^2 + k2 v^2) / 2, highest (or lowest) at the origin.

    first_per_m, second_per_m: float, its principal curvatures k1 and k2 at the origin, 1/m, positive where it bulges out.
    turn_rad: float, from x to u.
    """
    count = round(2 * HALF_WIDTH_M / _SPACING_M) + 1
    line = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, count)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    top = -(first_per_m * u**2 + second_per_m * v**2) / 2
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    across = np.stack([c * u - s * v, s * u + c * v], -1)
    low = np.full(len(u), top.min() - _THICK_M)
    vertices = np.concatenate([np.column_stack([across, top]), np.column_stack([across, low])])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(count - 1), np.arange(count - 1), indexing="ij"))
    a, b, d, e = i * count + j, i * count + j + 1, (i + 1) * count + j, (i + 1) * count + j + 1
    upper = np.concatenate([np.stack([a, d, b], 1), np.stack([b, d, e], 1)])
    under = upper[:, ::-1] + len(u)
    k = np.arange(count - 1)
    rim = np.concatenate([k * count, (count - 1) * count + k, (count - 1 - k) * count + count - 1, count - 1 - k])
    after = np.roll(rim, -1)
    sides = np.concatenate([
        np.stack([rim, rim + len(u), after], 1), np.stack([after, rim + len(u), after + len(u)], 1)
    ])  # fmt: skip
    return Solid(vertices, np.concatenate([upper, under, sides]))
