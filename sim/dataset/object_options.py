"""Options of a mesh to press on. Light to import, for the command line."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh


UnitName = Literal["mm", "cm", "m", "in"]
"""Units of mesh files."""


@dataclass(frozen=True)
class ObjectOptions:
    """A mesh to press on, and where."""

    object: str = ""
    """Mesh file, or one of the project's objects such as bust, to press on instead of the flat surface."""
    unit: UnitName | None = None
    """Unit of the mesh file. Default: mm, or m for a mesh that is too small in mm."""
    scale: float = 1.0
    """Scale factor of the object."""
    rotation_deg: tuple[float, float, float] | None = None
    """Rotation vector of the object, degrees: it is pressed from above. Default: none; the bust lies on its back."""
    at_mm: tuple[float, float] = (0.0, 0.0)
    """Place to press on: x and y from the middle of the object as seen from above, mm."""

    def solid(self, log: Callable[[str], None] = lambda text: None) -> "SignedDistanceMesh":
        """Return the object, its middle at the origin. Raises TactipError if it cannot be used.

        Args:
            log: Callback for its size and the repairs of its mesh.
        """
        from tactip_twin.sim.robot.objects import load_object

        found = load_object(self.object, self.unit, self.scale, None, self.rotation_deg)
        for note in (found.summary, *found.notes):
            log(f"{self.object}: {note}")
        T = found.T_base_object
        return found.solid.moved(T[:3, :3].T, T[:3, :3].T @ (found.middle_m - T[:3, 3]))
