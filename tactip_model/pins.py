"""The pins: rigid, rooted in the skin, moving with it and tilting with its normal."""

import numpy as np
from scipy.sparse import coo_matrix

from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M


def hexagonal(rings):
    """Triangular lattice in a hexagon, (3 rings² + 3 rings + 1, 2) float in units of the pitch, first neighbour on +x."""
    span = range(-rings, rings + 1)
    lattice = np.array([(i, j) for i in span for j in span if abs(i + j) <= rings], float)
    return np.stack([lattice[:, 0] + lattice[:, 1] / 2, np.sqrt(3) / 2 * lattice[:, 1]], 1)


def circular(rings):
    """Rings of 6k points about a centre point, same count and units as `hexagonal`."""
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        azimuth = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k * np.stack([np.cos(azimuth), np.sin(azimuth)], 1))
    return np.concatenate(points)


LAYOUTS = {"hexagonal": hexagonal, "circular": circular}


def plan_positions(pins):
    """Plan positions of the pins, (p, 2) float, m, x and y of the sensor frame. pins: design.Pins.

    Raises TactipError on an unknown layout, and where `as_built_m` has not one offset a pin.
    """
    points = pins.pitch_m * lookup("pin layout", pins.layout, LAYOUTS)(pins.rings)
    c, s = np.cos(np.radians(pins.rotation_deg)), np.sin(np.radians(pins.rotation_deg))
    points = points @ np.array([[c, s], [-s, c]])
    count = len(pins.as_built_m)
    require(count in (0, len(points)), "the number of Pins.as_built_m", count, f"{len(points)}, one a pin, or 0")
    return points + np.reshape(pins.as_built_m, (-1, 2)) if count else points


def neutral_pins(design):
    """Tips (p, 3) m and directions (p, 3), unit, root to tip, of the undeformed design's pins in the sensor frame."""
    plan = plan_positions(design.pins)
    radius = design.shape.radius_m
    outer = np.concatenate([plan, np.sqrt(radius**2 - (plan**2).sum(1, keepdims=True))], 1)
    centre = np.array([0, 0, -radius])
    return centre + outer * (1 - design.pins.length_m / radius), -outer / radius


class PinReader:
    """Reads pins off a deformed skin.

    A pin's root moves with its triangle, and its tip by the root's displacement plus the lever arm's turn with the
    skin's normal. Displacements are added to the exact undeformed position: the mesh's facets do not show at rest.
    """

    def __init__(self, design, mesh):
        """design: Design. mesh: mesh.Mesh of that design."""
        self.tips, self.directions = neutral_pins(design)
        self._triangles = mesh.triangles
        self._rest = mesh.vertices[: mesh.surface_count]
        self._lever = design.pins.length_m - CONTACT_RADIUS_M
        self._weights = _interpolation(self._rest - mesh.centre, mesh.triangles, -self.directions)
        rows, columns = mesh.triangles.ravel(), np.repeat(np.arange(len(mesh.triangles)), 3)
        shape = (mesh.surface_count, len(mesh.triangles))
        self._gather = coo_matrix((np.ones(rows.size), (rows, columns)), shape).tocsr()
        self._rest_normals = self._normals(self._rest)

    def read(self, skin):
        """Tips (..., p, 3) m and directions (..., p, 3) for skin vertices (..., s, 3), m, all in the sensor frame."""
        skin = np.asarray(skin, float)
        moved = self._at_roots(skin - self._rest)
        turned = self._normals(skin) - self._rest_normals
        directions = self.directions - turned
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return self.tips + moved - self._lever * turned, directions

    @staticmethod
    def _spread(values, matrix):
        """A sparse matrix (b, a) times values (..., a, 3): (..., b, 3)."""
        flat = values.reshape(-1, values.shape[-2], 3)
        return np.stack([matrix @ v for v in flat]).reshape(*values.shape[:-2], -1, 3)

    def _at_roots(self, values):
        """Values (..., s, 3) at vertices to values (..., p, 3) at the pins' roots."""
        return self._spread(values, self._weights)

    def _normals(self, skin):
        """Outward unit normals (..., p, 3) at the roots: area-weighted at the vertices, interpolated."""
        corners = skin[..., self._triangles, :]
        face = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        vertex = self._spread(face, self._gather)
        vertex /= np.linalg.norm(vertex, axis=-1, keepdims=True)
        normals = self._at_roots(vertex)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _interpolation(vertices, triangles, rays):
    """Sparse (p, s): barycentric weights of the triangle that each ray (p, 3) from the origin meets."""
    inverse = np.linalg.inv(np.swapaxes(vertices[triangles], 1, 2))
    weights = np.einsum("tij,pj->pti", inverse, rays)
    met = weights.min(2).argmax(1)
    weights = weights[np.arange(len(rays)), met]
    weights /= weights.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(rays)), 3)
    return coo_matrix((weights.ravel(), (rows, triangles[met].ravel())), (len(rays), len(vertices))).tocsr()
