"""The pins: rigid, rooted in the skin, moving with it and tilting with its normal."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array, csr_array

from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design, PinLayout, Pins
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, Mesh


def hexagonal(rings: int) -> np.ndarray:
    """Return a hexagonal lattice, (3 rings² + 3 rings + 1, 2), in units of the pitch, first neighbour on +x."""
    span = range(-rings, rings + 1)
    lattice = np.array([(i, j) for i in span for j in span if abs(i + j) <= rings], float)
    return np.stack([lattice[:, 0] + lattice[:, 1] / 2, np.sqrt(3) / 2 * lattice[:, 1]], 1)


def circular(rings: int) -> np.ndarray:
    """Return rings of 6k points around a centre point, with the count and units of `hexagonal`."""
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        azimuth = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k * np.stack([np.cos(azimuth), np.sin(azimuth)], 1))
    return np.concatenate(points)


LATTICES: dict[PinLayout, Callable[[int], np.ndarray]] = {"hexagonal": hexagonal, "circular": circular}
"""Functions that return plan positions, in pitches, for a number of rings; by layout; `free` has none."""


def plan_positions(pins: Pins) -> np.ndarray:
    """Return the pins' plan positions (p, 2), m, x and y of the sensor frame.

    Raises:
        TactipError: The layout is unknown, or `as_built_m` does not have one offset per pin.
    """
    if pins.layout == "free":
        return np.array(pins.as_built_m, float)
    points = pins.pitch_m * lookup("pin layout", pins.layout, LATTICES)(pins.rings)
    c, s = np.cos(np.radians(pins.rotation_deg)), np.sin(np.radians(pins.rotation_deg))
    points = points @ np.array([[c, s], [-s, c]])
    count = len(pins.as_built_m)
    require(
        count in (0, len(points)), "the number of offsets in Pins.as_built_m", count, f"{len(points)}, one per pin, or 0"
    )
    return points + np.reshape(pins.as_built_m, (-1, 2)) if count else points


def neutral_pins(design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Return the undeformed pins in the sensor frame: pin tips (p, 3), m, and directions (p, 3), unit, from root to tip."""
    plan = plan_positions(design.pins)
    radius = design.shape.radius_m
    outer = np.concatenate([plan, np.sqrt(radius**2 - (plan**2).sum(1, keepdims=True))], 1)
    centre = np.array([0, 0, -radius])
    return centre + outer * (1 - design.pins.length_m / radius), -outer / radius


class SkinReader:
    """Reads the skin's displacement and the change of its normal at points, from its deformed vertices."""

    def __init__(self, mesh: Mesh, directions: np.ndarray) -> None:
        """Prepare the interpolation.

        Args:
            mesh: Undeformed mesh.
            directions: (p, 3) unit, sensor frame, from the dome's centre to the points.
        """
        self._triangles = mesh.triangles
        self._rest = mesh.vertices[: mesh.surface_count]
        self._weights = _interpolation(self._rest - mesh.centre, mesh.triangles, directions)
        rows, columns = mesh.triangles.ravel(), np.repeat(np.arange(len(mesh.triangles)), 3)
        shape = (mesh.surface_count, len(mesh.triangles))
        self._gather = coo_array((np.ones(rows.size), (rows, columns)), shape).tocsr()
        self._rest_normals = self._normals(self._rest)

    def read(self, skin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the displacements (..., p, 3), m, and the changes of the normals (..., p, 3).

        Args:
            skin: (..., s, 3) m, vertices of the skin in the sensor frame.
        """
        return self._at_points(skin - self._rest), self._normals(skin) - self._rest_normals

    @staticmethod
    def _spread(values: np.ndarray, matrix: csr_array) -> np.ndarray:
        """Return a sparse matrix (b, a) times values (..., a, 3): (..., b, 3)."""
        flat = values.reshape(-1, values.shape[-2], 3)
        return np.stack([matrix @ v for v in flat]).reshape(*values.shape[:-2], -1, 3)

    def _at_points(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values (..., s, 3) at vertices to the points, (..., p, 3)."""
        return self._spread(values, self._weights)

    def _normals(self, skin: np.ndarray) -> np.ndarray:
        """Return outward unit normals (..., p, 3) at the points: area-weighted at the vertices, interpolated."""
        corners = skin[..., self._triangles, :]
        face = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        vertex = self._spread(face, self._gather)
        vertex /= np.linalg.norm(vertex, axis=-1, keepdims=True)
        normals = self._at_points(vertex)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


class PinReader:
    """Computes the pins' positions from a deformed skin.

    A pin's root moves with its triangle. Its tip moves by the root's displacement plus the rotation of the lever arm with
    the skin's normal. Displacements are added to the exact undeformed position, so the mesh's facets have no effect at rest.
    """

    def __init__(self, design: Design, mesh: Mesh) -> None:
        """Prepare the interpolation for a design and its mesh."""
        self.pin_tips, self.directions = neutral_pins(design)
        self._lever = pin_lever_m(design)
        self._skin = SkinReader(mesh, -self.directions)

    def read(self, skin: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return pin tips (..., p, 3), m, and directions (..., p, 3) for skin vertices (..., s, 3), m; sensor frame."""
        moved, turned = self._skin.read(np.asarray(skin, float))
        directions = self.directions - turned
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return self.pin_tips + moved - self._lever * turned, directions


def pin_lever_m(design: Design) -> float:
    """Return the length of a pin from the skin's vertices to its tip, m."""
    return design.pins.length_m - CONTACT_RADIUS_M


def _interpolation(vertices: np.ndarray, triangles: np.ndarray, rays: np.ndarray) -> csr_array:
    """Return barycentric weights, sparse (p, s), of the triangle that each ray (p, 3) from the origin intersects."""
    inverse = np.linalg.inv(np.swapaxes(vertices[triangles], 1, 2))
    weights = np.einsum("tij,pj->pti", inverse, rays)
    hit = weights.min(2).argmax(1)
    weights = weights[np.arange(len(rays)), hit]
    weights /= weights.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(rays)), 3)
    return coo_array((weights.ravel(), (rows, triangles[hit].ravel())), (len(rays), len(vertices))).tocsr()
