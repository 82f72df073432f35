"""The patch of skin in contact: its area, how far the rim has moved relative to it, and the fraction of it that slides."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tactip_twin.sim.contact.facets import barycentric, skin_flex, touched_facets
from tactip_twin.sim.contact.slip_weakening import sliding
from tactip_twin.tactip_model.mesh import Mesh

_MIN_SPREAD_M2 = (0.1e-3) ** 2
"""Smallest mean square radius of a patch that can show a twist, m^2: a single vertex cannot."""


@dataclass(frozen=True)
class ContactPatch:
    """The patch of skin in contact. All zero without contact."""

    area_m2: float
    """Area of the skin in contact, m^2: a third of each facet for each of its vertices that bears force."""
    shear: np.ndarray
    """(6,) m and rad, in the axes of a label: motion of the rim relative to the patch, along the surface and about its
    normal; the other components are 0. Skin that sticks has the shear of its contact; skin that has slid has less."""


NO_PATCH = ContactPatch(0.0, np.zeros(6))


def slip_fraction(data: mujoco.MjData) -> float:
    """Return the fraction of the normal force whose contacts slid at the last step, -; 1 without friction."""
    contacts = data.contact
    active = contacts.efc_address >= 0
    rows = contacts.efc_address[active]
    normal = data.efc_force[rows]
    slides = sliding(data)[active] | (contacts.dim[active] == 1)
    total = float(normal.sum())
    return float(normal[slides].sum()) / total if total > 0 else 0.0


class PatchReader:
    """Reader of the contact patch of a scene."""

    def __init__(self, model: mujoco.MjModel, mesh: Mesh) -> None:
        """Find the skin's vertices among the geoms of a compiled model with a soft tip (soft_body.add_soft_tip)."""
        self._mesh = mesh
        self._vertex = np.full(model.ngeom, -1)
        self._skin = skin_flex(model)
        for i in np.flatnonzero(~mesh.bonded[: mesh.surface_count]):
            self._vertex[model.geom(f"tip/{i}").id] = i

    def read(self, data: mujoco.MjData, vertices: np.ndarray, contact_axes: np.ndarray) -> ContactPatch:
        """Return the patch after a step.

        Args:
            data: State of the scene.
            vertices: (n, 3) m, deformed mesh in the sensor frame.
            contact_axes: (3, 3) rotation from the sensor frame to the contact frame.
        """
        contacts = data.contact
        active = contacts.efc_address >= 0
        rows = contacts.efc_address[active]
        normal = data.efc_force[rows]
        if not normal.sum() > 0:
            return NO_PATCH
        weight = self._on_vertices(contacts, active, normal, vertices)
        count = self._mesh.surface_count
        skin, rest = vertices[:count] @ contact_axes.T, self._mesh.vertices[:count] @ contact_axes.T
        weight /= weight.sum()
        moved = (skin - rest)[:, :2]
        mean = weight @ moved
        arm = (rest - weight @ rest)[:, :2]
        spread = float(weight @ (arm**2).sum(1))
        turned = moved - mean
        twist = (
            float(weight @ (arm[:, 0] * turned[:, 1] - arm[:, 1] * turned[:, 0])) / spread
            if spread > _MIN_SPREAD_M2
            else 0.0
        )
        a, b, c = (vertices[self._mesh.triangles[:, i]] for i in range(3))
        facets = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        area = float(facets @ (weight > 0)[self._mesh.triangles].sum(1)) / 3
        return ContactPatch(area, np.array([-mean[0], -mean[1], 0, 0, 0, -twist]))

    def _on_vertices(self, contacts: Any, active: np.ndarray, normal: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Return the normal force at each vertex of the skin (s,), N; that on a facet is divided between its corners."""
        weight = np.zeros(self._mesh.surface_count)
        geoms = contacts.geom[active]
        vertex = np.where(geoms >= 0, self._vertex[geoms], -1).max(1)
        at_vertex = vertex >= 0
        np.add.at(weight, vertex[at_vertex], normal[at_vertex])
        facets = self._mesh.triangles[touched_facets(contacts, self._skin)[active][~at_vertex]]
        if len(facets):
            fractions = barycentric(contacts.pos[active][~at_vertex], vertices[facets])
            np.add.at(weight, facets, fractions * normal[~at_vertex, None])
        return weight
