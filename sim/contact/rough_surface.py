"""Rough surfaces: ridges, bumps, grooves, dents, folds and steps that are smaller than the tip, on a curved base.

A tip on such a surface touches a crest of a few millimetres, two flanks at once, or a flank beside its apex, as on a face or
a relief. The surface is a height over a plane, so nothing overhangs.
"""

from collections.abc import Callable

import numpy as np

from tactip_twin.sim.contact.curved_surface import slab
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.pose import shortest_turn

_MAX_FEATURES = 3
"""Maximum number of features: more would lie beside each other only outside of the tip's reach [?]."""

_REACH_M = 15e-3
"""Maximum distance of a feature's middle from the place that is pressed, m: about the radius of a contact patch and the
radius of a feature."""

_CONVEX_RADII_M = (2e-3, 15e-3)
"""Minimum and maximum radius of ridges and bumps, m: from a lip of a face to where curved surfaces begin [?]."""

_HOLLOW_RADII_M = (4e-3, 40e-3)
"""Minimum and maximum radius of grooves and dents, m; the tip fits into hollows of more than 20 mm [?]."""

_MAX_DENT_M = 6e-3
"""Maximum depth of a groove or dent, m: more than the tip is pressed [?]."""

_MAX_FOLD_RAD = np.radians(35.0)
"""Maximum angle of each side of a fold to the base, rad [?]."""

_STEP_M = (0.5e-3, 5e-3)
"""Minimum and maximum height of a step, m [?]."""

_BLEND_M = (0.3e-3, 4e-3)
"""Minimum and maximum width over which a feature passes into the base, m [?]."""

_MAX_SLOPE = np.tan(np.radians(45.0))
"""Maximum slope at the place that is pressed, -: steeper, and the rim of the piece would face the tip [?]."""

_SPACING_M = 0.75e-3
"""Spacing of the heights, m: a ridge of 2 mm radius has five of them [?]."""

_SLOPE_STEP_M = 0.4e-3
"""Distance over which the slope at the pressed place is measured, m [?]."""

Height = Callable[[np.ndarray], np.ndarray]
"""Heights (...) m at positions (..., 2) m."""


def sample_rough_surface(rng: np.random.Generator, low_per_m: float, high_per_m: float) -> SignedDistanceMesh:
    """Return a rough surface, in the contact frame of the place that is pressed: at the origin, level there.

    Args:
        rng: Random generator.
        low_per_m: Minimum principal curvature of the base, 1/m.
        high_per_m: Maximum principal curvature of the base, 1/m; positive is convex.
    """
    height = sample_heights(rng, low_per_m, high_per_m)
    while np.linalg.norm(_slopes(height)) > _MAX_SLOPE:  # about one surface in ten
        height = sample_heights(rng, low_per_m, high_per_m)
    vertices, triangles = slab(height, _SPACING_M)
    normal = np.array([*-_slopes(height), 1.0])
    turn = shortest_turn(np.array([0.0, 0.0, 1.0]), normal / np.linalg.norm(normal))
    place = np.array([0.0, 0.0, float(height(np.zeros(2)))])
    return SignedDistanceMesh((vertices - place) @ turn.as_matrix(), triangles)


def sample_heights(rng: np.random.Generator, low_per_m: float, high_per_m: float) -> Height:
    """Return the heights of a random rough surface. Arguments as of `sample_rough_surface`."""
    curvatures = rng.uniform(low_per_m, high_per_m, 2) / 2  # gentler than a surface without features
    axes = _axes(rng.uniform(0, np.pi))
    features = [_sample_feature(rng) for _ in range(rng.integers(1, _MAX_FEATURES + 1))]

    def height(at: np.ndarray) -> np.ndarray:
        """Return heights."""
        base = -((at @ axes.T) ** 2 @ curvatures) / 2
        for feature in features:
            base = feature(at, base)
        return base

    return height


def _sample_feature(rng: np.random.Generator) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function of positions (..., 2) and heights (...) that returns the heights with a random feature."""
    kind = rng.choice(["ridge", "bump", "groove", "dent", "fold", "step"])
    axes, distance = _axes(rng.uniform(0, 2 * np.pi)), rng.uniform(-_REACH_M, _REACH_M)
    middle = axes[0] * distance
    convex, hollow = (np.exp(rng.uniform(*np.log(limits))) for limits in (_CONVEX_RADII_M, _HOLLOW_RADII_M))
    blend, step = (np.exp(rng.uniform(*np.log(limits))) for limits in (_BLEND_M, _STEP_M))
    share, sign, fold = rng.uniform(0.2, 1.0), rng.choice([-1.0, 1.0]), np.tan(rng.uniform(0, _MAX_FOLD_RAD))

    def across(at: np.ndarray) -> np.ndarray:
        """Return distances (...) m from the line through the middle."""
        return (at - middle) @ axes[0]

    def radial(at: np.ndarray) -> np.ndarray:
        """Return distances (...) m from the middle."""
        return np.linalg.norm(at - middle, axis=-1)

    def add(at: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return the heights with the feature."""
        if kind in ("ridge", "bump"):
            # `share` of the radius stands out of the base.
            round_top = _arc(across(at) if kind == "ridge" else radial(at), convex) - (1 - share) * convex
            return smooth_maximum(base, base + round_top, blend)
        if kind in ("groove", "dent"):
            depth = share * min(hollow, _MAX_DENT_M)
            round_bottom = _arc(across(at) if kind == "groove" else radial(at), hollow) - (hollow - depth)
            return -smooth_maximum(-base, -base + round_bottom, blend)
        if kind == "fold":
            return base + sign * fold * (np.hypot(across(at), blend) - blend)
        return base + sign * step * 0.5 * (1 + np.tanh(across(at) / blend))

    return add


def smooth_maximum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return the maximum of heights (...) m, rounded where they differ by less than a width, m."""
    overlap = np.maximum(width - np.abs(a - b), 0.0)
    return np.maximum(a, b) + overlap**2 / (4 * width)


def _arc(distance: np.ndarray, radius: float) -> np.ndarray:
    """Return the height (...) m of a circle at a distance (...) m from its middle; beyond it, the height falls steeply."""
    inside = np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
    return inside - 4 * np.maximum(np.abs(distance) - radius, 0.0)


def _axes(turn: float) -> np.ndarray:
    """Return the unit vectors (2, 2) at an angle, rad, and across it."""
    return np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _slopes(height: Height) -> np.ndarray:
    """Return the slopes (2,) along x and y at the origin, -."""
    right, left, front, back = height(_SLOPE_STEP_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    return np.array([right - left, front - back]) / (2 * _SLOPE_STEP_M)
