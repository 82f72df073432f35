"""A mesh as the stimulus of a set: each contact has its own place on it, in whose contact frame its pose is labelled.

The set keeps the mesh in object.npz, so its contacts can be simulated again.
"""

import io
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.contact.press_place import in_contact_frame, place_below
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import MAX_BYTES, parse_arrays

OBJECT = "object.npz"
"""File of a set with vertices (n, 3), m, and triangles (k, 3) of its object; the origin is the object's middle."""

_MAX_PLACES = 1000
"""Number of places sampled for a contact before the range is rejected."""


@dataclass(frozen=True)
class PressedObject:
    """What decides the contacts of a set on an object."""

    name: str
    """Name of the object, or of its file."""
    sha256: str
    """Checksum of object.npz, in hex."""
    at_mm: tuple[float, float] = within(-1e4, 1e4, default=(0.0, 0.0))
    """Middle of the places, x and y from the middle of the object, mm."""
    spread_mm: float = within(0, 1e4, default=0.0)
    """Radius of the disc, as seen from above, in which places are sampled, mm."""

    def __post_init__(self) -> None:
        check(self)


class PressPlaces:
    """The places on the object of a set."""

    def __init__(self, chosen: PressedObject, solid: SignedDistanceMesh) -> None:
        """Take the object; `solid` has its middle at the origin."""
        self._chosen, self._solid = chosen, solid
        self._last: tuple[tuple[float, ...], SignedDistanceMesh] | None = None
        """The last place and the object in its contact frame, because a fine mesh takes long to be built."""

    def sample(self, rng: np.random.Generator) -> SignedDistanceMesh:
        """Return the object in the contact frame of a random place. Raises TactipError if there is none on it."""
        at, radius = np.array(self._chosen.at_mm) / 1e3, self._chosen.spread_mm / 1e3
        for _ in range(_MAX_PLACES if radius else 1):
            distance, heading = radius * np.sqrt(rng.random()), 2 * np.pi * rng.random()
            place = place_below(self._solid, at + distance * np.array([np.cos(heading), np.sin(heading)]))
            if place is not None:
                break
        else:
            x, y = self._chosen.at_mm
            raise TactipError(f"at_mm must lie on the object {self._chosen.name}, which has no surface at {x:g}, {y:g} mm")
        key = tuple(place.tolist())
        if self._last is None or self._last[0] != key:
            self._last = key, in_contact_frame(self._solid, place)
        return self._last[1]


def pack_object(solid: SignedDistanceMesh) -> bytes:
    """Return the content of object.npz. Raises TactipError if it could not be read back."""
    stream = io.BytesIO()
    np.savez(stream, vertices=solid.vertices, triangles=solid.triangles.astype(np.int32))
    if stream.tell() > MAX_BYTES:
        raise TactipError(f"the object must have fewer triangles than {len(solid.triangles)}: simplify it first")
    return stream.getvalue()


def places_on(data: bytes, chosen: PressedObject, where: str) -> PressPlaces:
    """Return the places on an object.

    Args:
        data: Content of object.npz.
        chosen: The object of the set.
        where: Origin of the data, for messages.

    Raises:
        TactipError: If the arrays are not a mesh.
    """
    arrays = parse_arrays(data, where)
    vertices, triangles = (arrays.get(name, np.zeros(0)) for name in ("vertices", "triangles"))
    good = vertices.dtype == np.float64 and triangles.dtype == np.int32 and np.isfinite(vertices).all()
    good = good and vertices.shape[1:] == triangles.shape[1:] == (3,) and len(triangles)
    if not good or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise TactipError(f"{where} must have vertices (n, 3) float64 and triangles (k, 3) int32")
    return PressPlaces(chosen, SignedDistanceMesh(vertices, triangles))
