"""The force on a tip as an arrow beside it: at the apex the tip or the object would hide it."""

import numpy as np
import trimesh

from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.palette import FORCE_COLOR

SHAFT_M, HEAD_M, HEAD_LENGTH_M = 0.9e-3, 2.4e-3, 5e-3
"""Radii of the arrow's shaft and head, and length of its head, m."""

_M_PER_N, _MIN_M = 0.02, 1e-3
"""Length of the arrow, and below which there is none, m."""

_BESIDE_M, _RAISED_M = 8e-3, 12e-3
"""Distance of the arrow from the tip along x of the sensor frame, and its height over the apex, m."""

_LEANING = 0.1
"""Fraction of the force against x beyond which the arrow stands on the other side, so that it leans away from the tip."""


def force_arrow(skin: np.ndarray, force: np.ndarray, radius_m: float) -> np.ndarray | None:
    """Return start and end (2, 3) of the arrow, m, sensor frame; None if the force is too small.

    Args:
        skin: (s, 3) m, vertices of the skin, sensor frame.
        force: (3,) N, sensor frame.
        radius_m: Radius of the undeformed skin, m.
    """
    length = float(np.linalg.norm(force))
    if _M_PER_N * length <= _MIN_M:
        return None
    side = -1.0 if force[0] < -_LEANING * length else 1.0
    start = np.array([side * (radius_m + _BESIDE_M), 0.0, skin[:, 2].max() - _RAISED_M])
    return np.stack([start, start + _M_PER_N * force])


def skin_radius_m(rest_skin: np.ndarray) -> float:
    """Return the radius, m, of an undeformed skin (s, 3) m."""
    return float(np.hypot(*rest_skin[:, :2].T).max())


def arrow_meshes(ends: np.ndarray) -> list[ColoredMesh]:
    """Return the meshes of an arrow from its start to its end (2, 3), m."""
    length = np.linalg.norm(ends[1] - ends[0])
    neck = ends[1] - min(1.0, HEAD_LENGTH_M / length) * (ends[1] - ends[0])
    shaft = trimesh.creation.cylinder(SHAFT_M, segment=[ends[0], neck], sections=16)
    head = trimesh.creation.cone(HEAD_M, np.linalg.norm(ends[1] - neck), sections=16)
    head.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], ends[1] - neck))
    head.apply_translation(neck)
    return [ColoredMesh(m.vertices, m.faces, np.asarray(m.vertex_normals), FORCE_COLOR) for m in (shaft, head)]
