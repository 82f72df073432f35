"""Symmetries of contacts: a flat surface and an edge look the same rotated or mirrored, and so does a round tip.

Rotating or mirroring everything but the pins gives another valid contact. Its pins are read from the transformed skin, so
neither their lattice nor the built sensor needs to have the symmetry.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.pose import FACING
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import Mesh
from tactip_twin.tactip_model.pins import PinReader


@dataclass(frozen=True)
class Symmetry:
    """A rotation about the normal, or a mirror whose plane contains the normal."""

    plane: tuple[tuple[float, float], tuple[float, float]]
    """(2, 2) matrix that acts on x and y of the contact frame."""

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3), the same in the contact frame and in label axes."""
        out = np.eye(3)
        out[:2, :2] = self.plane
        return out

    def label(self, label: ArrayLike) -> np.ndarray:
        """Return a pose or shear (6,) rotated or mirrored. Its rotation vector is axial: a mirror reverses its sense."""
        label = np.asarray(label, float)
        sense = np.linalg.det(self.matrix)
        return np.concatenate([self.matrix @ label[:3], sense * self.matrix @ label[3:]])

    @property
    def in_sensor(self) -> np.ndarray:
        """(3, 3), in the sensor frame."""
        return FACING @ self.matrix @ FACING


_ROTATIONS = tuple(((c, -s), (s, c)) for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)))
_MIRRORED_ROTATIONS = tuple((x, (-y[0], -y[1])) for x, y in _ROTATIONS)

SYMMETRIES = {
    "surface": tuple(Symmetry(plane) for plane in _ROTATIONS + _MIRRORED_ROTATIONS),
    "edge": (Symmetry(_ROTATIONS[0]), Symmetry(_MIRRORED_ROTATIONS[0])),
}
"""Symmetries by task, the identity first. Surface: quarter turns and their mirrors, under which the square ranges of Table 1
are invariant. Edge: the mirror along it."""


def ranges_are_symmetric(symmetries: Iterable[Symmetry], ranges: Ranges) -> bool:
    """Return whether ranges are invariant under all symmetries."""
    low, high = ranges.bounds().T
    images = (np.sort([s.label(low), s.label(high)], axis=0) for s in symmetries)
    return all(np.allclose(image, [low, high]) for image in images)


class SymmetricReader:
    """Reader of the pins of a contact and of its images under symmetries."""

    def __init__(self, design: Design, mesh: Mesh, symmetries: Sequence[Symmetry]) -> None:
        """Prepare a reader of pins for each symmetry. mesh: undeformed mesh of the tip."""
        self._symmetries = symmetries
        self._readers = [PinReader(design, _transformed(mesh, s)) for s in symmetries]

    def read(self, contact: Contact, skin: np.ndarray) -> list[Contact]:
        """Return the image of a contact under each symmetry. skin: its skin vertices (s, 3), m, sensor frame."""
        contacts = []
        for symmetry, reader in zip(self._symmetries, self._readers, strict=True):
            tips, directions = reader.read(skin @ symmetry.in_sensor.T)
            pose, shear = symmetry.label(contact.pose), symmetry.label(contact.shear)
            moved = {"pose": pose, "shear": shear, "effective_shear": symmetry.label(contact.effective_shear)}
            moved |= {"force_n": symmetry.in_sensor @ contact.force_n, "pin_tips": tips, "directions": directions}
            contacts.append(replace(contact, **moved))
        return contacts


def _transformed(mesh: Mesh, symmetry: Symmetry) -> Mesh:
    """Return a mesh rotated or mirrored; the triangles of a mirrored one are reversed, so they still face outward."""
    mirrored = np.linalg.det(symmetry.matrix) < 0
    triangles = mesh.triangles[:, ::-1] if mirrored else mesh.triangles
    return replace(mesh, vertices=mesh.vertices @ symmetry.in_sensor.T, triangles=triangles)
