"""Contacts that need not be played: a flat surface and an edge look the same turned or mirrored, and so does a round tip.

A contact of which everything but the pins is turned or mirrored is another contact, and a true one. Pins are read from its
skin anew, where they are: neither their lattice nor how they were built needs to have the symmetry.
"""

from dataclasses import dataclass, replace

import numpy as np

from tactip_twin.sim.pose import FACING
from tactip_twin.tactip_model.pins import PinReader


@dataclass(frozen=True)
class Symmetry:
    """A turn about the normal, or a mirror that holds it."""

    plane: tuple[tuple[float, float], tuple[float, float]]
    """(2, 2): what it does to x and y of the contact frame."""

    @property
    def matrix(self):
        """(3, 3), in the contact frame, and in label axes alike."""
        out = np.eye(3)
        out[:2, :2] = self.plane
        return out

    def label(self, label):
        """A pose or shear (6,) turned or mirrored: its rotation vector is an axial one, which a mirror turns round."""
        label = np.asarray(label, float)
        sense = np.linalg.det(self.matrix)
        return np.concatenate([self.matrix @ label[:3], sense * self.matrix @ label[3:]])

    @property
    def in_sensor(self):
        """(3, 3): the same in the sensor frame."""
        return FACING @ self.matrix @ FACING


_TURNS = tuple(((c, -s), (s, c)) for c, s in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)))
_MIRRORED_TURNS = tuple((x, (-y[0], -y[1])) for x, y in _TURNS)

SYMMETRIES = {
    "surface": tuple(Symmetry(plane) for plane in _TURNS + _MIRRORED_TURNS),
    "edge": (Symmetry(_TURNS[0]), Symmetry(_MIRRORED_TURNS[0])),
}
"""By task, the identity first. Of a surface: quarter turns and their mirrors, which leave the square ranges of Table 1 as
they are. Of an edge: the mirror along it."""


def ranges_are_symmetric(symmetries, ranges):
    """Whether sampling.Ranges are their own image under all symmetries."""
    low, high = ranges.bounds().T
    images = (np.sort([s.label(low), s.label(high)], axis=0) for s in symmetries)
    return all(np.allclose(image, [low, high]) for image in images)


class SymmetricReader:
    """Reads the pins of a contact and of all that are like it."""

    def __init__(self, design, mesh, symmetries):
        """design: Design. mesh: mesh.Mesh. symmetries: of SYMMETRIES."""
        self._symmetries = symmetries
        self._readers = [PinReader(design, _moved(mesh, s)) for s in symmetries]

    def read(self, contact, skin):
        """The Contacts (list), one a symmetry, of a tactip_twin.sim.contact.simulator.Contact and its skin vertices (s,
        3), m."""
        contacts = []
        for symmetry, reader in zip(self._symmetries, self._readers, strict=True):
            tips, directions = reader.read(skin @ symmetry.in_sensor.T)
            pose, shear = symmetry.label(contact.pose), symmetry.label(contact.shear)
            contacts.append(replace(contact, pose=pose, shear=shear, tips=tips, directions=directions))
        return contacts


def _moved(mesh, symmetry):
    """A Mesh turned or mirrored; mirrored triangles are turned over, so that they face outward still."""
    turned_over = np.linalg.det(symmetry.matrix) < 0
    triangles = mesh.triangles[:, ::-1] if turned_over else mesh.triangles
    return replace(mesh, vertices=mesh.vertices @ symmetry.in_sensor.T, triangles=triangles)
