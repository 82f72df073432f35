"""Normals of a surface, averaged over a patch: what a tip can feel of it, and what is noise of a scan."""

from collections.abc import Iterator

import numpy as np

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh

PATCH_M = 1.5e-3
"""Radius around a point within which the normal is averaged, m: half of the distance between the pins of `tactip-127`, which
show nothing finer."""

_RINGS_M = (PATCH_M / 2, PATCH_M)
"""Radii of the circles on which it is taken, m: with the middle, they weigh the patch about evenly."""

_DIRECTIONS = 8

_PROBES = 1000
"""Number of places at which the scatter of the normals is measured."""


def mean_normals(solid: SignedDistanceMesh, places: np.ndarray) -> np.ndarray:
    """Return the mean normals (n, 3), unit, of a solid around places (n, 3), m, on it, within PATCH_M."""
    if not len(places):
        return np.zeros((0, 3))
    normals = solid.smooth_normal(places)
    around = [solid.smooth_normal(places + r * along) for along in tangents(normals, 2 * np.pi) for r in _RINGS_M]
    total = normals + sum(around)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def tangents(normals: np.ndarray, span_rad: float) -> Iterator[np.ndarray]:
    """Yield unit directions (n, 3) along a surface with unit normals (n, 3), spread over an angle."""
    u = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normals, u)
    for angle in span_rad * np.arange(_DIRECTIONS) / _DIRECTIONS:
        yield np.cos(angle) * u + np.sin(angle) * v


def scatter_deg(solid: SignedDistanceMesh) -> float:
    """Return the median angle, degrees, between the normal at a point of a solid and the mean normal around it: over its
    area, at the middles of facets."""
    a, b, c = solid.vertices[solid.triangles].transpose(1, 0, 2)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    chosen = np.searchsorted(area, area[-1] * (np.arange(_PROBES) + 0.5) / _PROBES)
    places = (a[chosen] + b[chosen] + c[chosen]) / 3
    cosines = (solid.smooth_normal(places) * mean_normals(solid, places)).sum(1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1)))))
