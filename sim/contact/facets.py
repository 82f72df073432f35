"""Points on the facets of the skin."""

from typing import Any

import mujoco
import numpy as np

from tactip_twin.tactip_model.mesh import Mesh


def skin_flex(model: mujoco.MjModel) -> int:
    """Return the number of the skin's flex in a model with a soft tip (soft_body.add_soft_tip)."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "tip/skin")


def touched_facets(contacts: Any, skin: int) -> np.ndarray:
    """Return the number of the facet of the skin that each contact touches, (ncon,) int; -1 for none.

    Args:
        contacts: MjData.contact.
        skin: Number of the skin's flex; a stimulus may be a flex too.
    """
    return np.where(contacts.flex == skin, contacts.elem, -1).max(1)


def barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return barycentric coordinates (k, 3), at least 0, of the projections of points (k, 3) onto triangles (k, 3, 3)."""
    u, v, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    uu, uv, vv, pu, pv = ((x * y).sum(1) for x, y in ((u, u), (u, v), (v, v), (p, u), (p, v)))
    determinant = np.maximum(uu * vv - uv**2, 1e-30)
    b, c = (vv * pu - uv * pv) / determinant, (uu * pv - uv * pu) / determinant
    fractions = np.maximum(np.stack([1 - b - c, b, c], 1), 0.0)
    return fractions / fractions.sum(1, keepdims=True)


def held_weights(mesh: Mesh, vertices: np.ndarray, facets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weight of the clamped corners at points on facets, (k,), 0 to 1.

    Args:
        mesh: Mesh of the tip.
        vertices: (n, 3) m, deformed mesh.
        facets: (k,) numbers of the facets of the skin on which the points lie.
        points: (k, 3) m, in the frame of the vertices.
    """
    held = np.zeros(len(facets))
    clamped = mesh.bonded[mesh.triangles[facets]]
    near = np.flatnonzero(clamped.any(1))
    if len(near):
        weights = barycentric(points[near], vertices[mesh.triangles[facets[near]]])
        held[near] = (weights * clamped[near]).sum(1)
    return held
