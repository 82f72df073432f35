"""A surface that is bent, evenly or in waves: what the tip feels on curved things."""

from dataclasses import dataclass

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


WAVES_M = (20e-3, 60e-3)
"""Lengths of the waves in which curvature goes up and down along a surface, m: from the tip's radius to three of it."""

_THIRD = 1 / 6
"""The third harmonic in a wave: it flattens the tops, as solids made of round parts go from one radius to the other. With
a sixth the greatest value is that of the first alone at 60 degrees, sqrt(3)/2, where the third is zero."""


def drawn_surface(draw, low_per_m, high_per_m, wavy):
    """A bent_surface (Solid) whose principal curvatures are drawn from low to high, 1/m, and turned at random.

    draw: numpy Generator. wavy: bool; with it the curvatures go up and down along their directions, within the range
    everywhere, between ends that are drawn from twice the range and cut to it: things are often as round as they may be.
    """
    if not wavy:
        return bent_surface(*draw.uniform(low_per_m, high_per_m, 2), draw.uniform(0, np.pi))
    spare = (high_per_m - low_per_m) / 2
    ends = np.clip(draw.uniform(low_per_m - spare, high_per_m + spare, (2, 2)), low_per_m, high_per_m)
    lengths = np.exp(draw.uniform(*np.log(WAVES_M), 2))
    phases = draw.uniform(0, 2 * np.pi, 2)
    waves = [Wave((b - a) / 2, length, phase) for (a, b), length, phase in zip(ends, lengths, phases, strict=True)]
    return bent_surface(*ends.mean(1), draw.uniform(0, np.pi), waves)


@dataclass(frozen=True)
class Wave:
    """How a curvature goes up and down about its mean along its direction: by height (sin t + sin 3t / 6) 2 / sqrt(3)."""

    height_per_m: float
    """By how much at most, 1/m; negative turns it over."""

    length_m: float
    """From one top to the next, m."""

    phase_rad: float
    """Of t at the origin, rad: t = 2 pi s / length + phase."""

    def top(self, s):
        """What it adds to z at s, m: (n,), m. Its second derivative is minus the curvature; at 0 it is 0, and level."""
        out = np.zeros_like(s)
        for order, part in ((1, 1.0), (3, _THIRD)):
            per_m, phase = order * 2 * np.pi / self.length_m, order * self.phase_rad
            out += part / per_m**2 * (np.sin(per_m * s + phase) - np.sin(phase) - per_m * s * np.cos(phase))
        return self.height_per_m * out * 2 / np.sqrt(3)


def bent_surface(first_per_m, second_per_m, turn_rad, waves=()):
    """A Solid whose top is z = -(k1 u^2 + k2 v^2) / 2 and what the waves add, level at the origin.

    first_per_m, second_per_m: float, its principal curvatures k1 and k2, 1/m, positive where it bulges out. turn_rad: float,
    from x to u. waves: up to two Waves, along u and along v.
    """
    count = round(2 * HALF_WIDTH_M / _SPACING_M) + 1
    line = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, count)
    u, v = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    top = -(first_per_m * u**2 + second_per_m * v**2) / 2
    for wave, s in zip(waves, (u, v), strict=False):
        top += wave.top(s)
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
