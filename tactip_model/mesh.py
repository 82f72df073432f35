"""The finite-element mesh of the soft tip: gel in tetrahedra, skin in triangles on the gel's surface vertices.

Surface points lie on a golden-angle spiral, so no two of them have the same height: a pressed plate touches them one
by one, and the force does not rise in steps as it does with rings. Inner points lie on spirals of their own whose spacing
grows inward, where strains are smaller. The body is convex, so a Delaunay triangulation fills it; a few rounds of
averaging even out its elements.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import Delaunay

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.design import TipGeometry

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))

CONTACT_RADIUS_M = 0.25e-3
"""Contact radius of the skin, m: the mesh's surface lies this far inside the skin's outer surface."""


@dataclass(frozen=True)
class Resolution:
    """Spacings of the mesh, m; a spacing is the edge length of an equilateral triangle."""

    surface_m: float = within(0.5e-3, 5e-3, default=1.9e-3)
    """Spacing on the surface around the apex, where contact occurs, m."""
    rim_m: float = within(0.5e-3, 10e-3, default=5e-3)
    """Spacing at the rim, m."""
    fine_angle_deg: float = within(5, 90, default=25.0)
    """Polar angle up to which the surface spacing is finest, degrees; from there it coarsens linearly to the rim."""
    growth: float = within(1, 3, default=1.2)
    """Ratio of the spacing of one inner layer to that of the layer outside it, -."""
    coarsest_m: float = within(0.5e-3, 20e-3, default=7e-3)
    """Largest spacing inside, m."""
    smoothing: int = within(0, 200, default=30)
    """Rounds of averaging of the inner points."""
    poisson_limit: float = within(0, 0.5, default=0.43)
    """Largest Poisson's ratio of the elements, -; not a property of the material. Linear tetrahedra lock near
    incompressibility: a gel of 0.49 meshed as 0.49 is 35 to 55 % too stiff, or 20 to 27 % on the mesh of `reference`. The
    elements keep the gel's shear modulus, and one row of the solver adds the bulk modulus that they lack
    (sim/contact/gel_volume.py). The coarser the mesh, the lower the limit should be: 0.40, 0.43 and 0.45 for the meshes of
    `draft`, `standard` and `reference` (docs/mechanics.md)."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Mesh:
    """A meshed tip in the sensor frame (origin at the apex of the outer surface, z out of the tip).

    The first `surface_count` vertices are the skin's, `CONTACT_RADIUS_M` inside its outer surface.
    """

    vertices: np.ndarray
    """(n, 3) float, m."""
    surface_count: int
    """Number of skin vertices, which come first."""
    tetrahedra: np.ndarray
    """(m, 4) int; positive volume."""
    triangles: np.ndarray
    """(k, 3) int, all below `surface_count`; counter-clockwise seen from outside."""
    bonded: np.ndarray
    """(n,) bool: vertices fixed to the housing (base disc and rim)."""
    centre: np.ndarray
    """(3,) float: centre of the dome, m."""

    @cached_property
    def volumes(self) -> np.ndarray:
        """(m,) float: volume of each tetrahedron, m^3."""
        return tetrahedron_volumes(self.vertices, self.tetrahedra)


def tetrahedron_volumes(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return signed volumes (m,) of tetrahedra (m, 4) over vertices (n, 3)."""
    a, b, c, d = (vertices[tetrahedra[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def tetrahedron_quality(vertices: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the mean-ratio quality (m,) of tetrahedra: 1 for a regular one, 0 for a flat one (Liu & Joe 1994)."""
    corners = vertices[tetrahedra]
    edges = sum(((corners[:, i] - corners[:, j]) ** 2).sum(1) for i in range(4) for j in range(i))
    return 12 * np.cbrt(3 * np.abs(tetrahedron_volumes(vertices, tetrahedra))) ** 2 / edges


def _spiral(
    radius: Callable[[np.ndarray], np.ndarray], spacing: Callable[[np.ndarray], np.ndarray], polar_limit: float
) -> np.ndarray:
    """Return points (n, 3) on a dome around the origin, apex +z.

    Args:
        radius: Radius, m, as a function of the polar angle, rad.
        spacing: Spacing of the points, m, likewise.
        polar_limit: Polar angle at which the spiral ends, rad.
    """
    polar = np.linspace(0, polar_limit, 4001)
    per_angle = 2 * np.pi * np.sin(polar) * radius(polar) ** 2 / (spacing(polar) ** 2 * np.sqrt(3) / 2)
    count = np.concatenate([[0.0], np.cumsum((per_angle[1:] + per_angle[:-1]) / 2 * np.diff(polar))])
    n = max(1, round(count[-1]))
    t = np.interp((np.arange(n) + 0.5) * count[-1] / n, count, polar)
    azimuth, r = GOLDEN_ANGLE * np.arange(n), radius(t)
    return np.stack([r * np.sin(t) * np.cos(azimuth), r * np.sin(t) * np.sin(azimuth), r * np.cos(t)], 1)


def _circle(radius: float, spacing: float, z: float, rotated: int) -> np.ndarray:
    """Return points (n, 3) on a circle around the z axis, n at least 6, rotated by half a spacing if `rotated` is 1."""
    n = max(6, round(2 * np.pi * radius / spacing))
    azimuth = 2 * np.pi * (np.arange(n) + 0.5 * rotated) / n
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(n, z)], 1)


def _layers(radius: float, resolution: Resolution) -> list[np.ndarray]:
    """Return point sets (n, 3) of the hemisphere: the surface, then inner layers of growing spacing."""
    rim = np.array([np.pi / 2])
    fine = np.radians(resolution.fine_angle_deg)

    def spacing_at(layer: int, polar: np.ndarray) -> np.ndarray:
        ramp = np.clip((polar - fine) / (np.pi / 2 - fine), 0, 1)
        surface = resolution.surface_m + (resolution.rim_m - resolution.surface_m) * ramp
        return np.minimum(surface * resolution.growth**layer, max(resolution.coarsest_m, resolution.rim_m))

    def depth_at(layer: int, polar: np.ndarray) -> np.ndarray:
        # A layer of regular tetrahedra is 0.82 of an edge high.
        return sum(0.41 * (spacing_at(k, polar) + spacing_at(k + 1, polar)) for k in range(layer)) + 0 * polar

    sets = []
    for layer in range(100):

        def spacing(polar: np.ndarray, layer: int = layer) -> np.ndarray:
            return spacing_at(layer, polar)

        def layer_radius(polar: np.ndarray, layer: int = layer) -> np.ndarray:
            return radius - depth_at(layer, polar)

        r, h = layer_radius(rim)[0], spacing(rim)[0]
        if layer_radius(np.zeros(1))[0] < 0.6 * spacing(np.zeros(1))[0] or r < 0.6 * h:
            break
        limit = np.pi / 2 - 0.75 * h / r
        dome = _spiral(layer_radius, spacing, limit) if limit > 0.25 else np.zeros((0, 3))
        sets.append(np.concatenate([dome, _circle(r, h, 0.0, layer % 2)]))
    return sets


def _tetrahedralise(points: np.ndarray) -> np.ndarray:
    """Return Delaunay tetrahedra (m, 4) of points (n, 3) in convex position, positively oriented, without flat ones."""
    tetrahedra = Delaunay(points).simplices.astype(np.int64)
    volume = tetrahedron_volumes(points, tetrahedra)
    tetrahedra[volume < 0] = tetrahedra[volume < 0][:, [0, 1, 3, 2]]
    return tetrahedra[np.abs(volume) > 1e-6 * np.abs(volume).max()]


def _skin_triangles(points: np.ndarray, tetrahedra: np.ndarray, surface_count: int, bonded: np.ndarray) -> np.ndarray:
    """Return the outer faces (k, 3) of the tetrahedra whose corners are all skin vertices and not all bonded."""
    faces = np.concatenate([tetrahedra[:, list(c)] for c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, first, count = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    faces = faces[np.sort(first[count == 1])]
    faces = faces[(faces < surface_count).all(1) & ~bonded[faces].all(1)]
    a, b, c = (points[faces[:, i]] for i in range(3))
    inward = (np.cross(b - a, c - a) * (a + b + c)).sum(1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return faces


def sorted_elements(elements: np.ndarray) -> np.ndarray:
    """Sort elements (m, c) of vertex indices, c at least 3, and keep their orientation.

    The corners of each element ascend, except for the last two where the orientation requires it, and the elements ascend
    by their corners. MuJoCo collects the corners of each vertex's elements and sorts them by insertion, twice per step.
    With elements as the Delaunay triangulation leaves them this takes a fifth of a contact's time, sorted half of that [M].
    """
    order = np.argsort(elements, axis=1)
    ascending = np.take_along_axis(elements, order, axis=1)
    a, b = np.triu_indices(elements.shape[1], 1)
    odd = (order[:, a] > order[:, b]).sum(1) % 2 == 1
    oriented = ascending.copy()
    oriented[odd, -2:] = ascending[odd, :-3:-1]
    return oriented[np.lexsort(ascending.T[::-1])]


@lru_cache(maxsize=4)
def build_mesh(shape: TipGeometry, resolution: Resolution) -> Mesh:
    """Mesh the tip. Meshes are cached and read-only, because tips with other mechanics share them.

    Raises:
        ValueError: A spacing does not suit the shape.
    """
    for name in ("surface_m", "rim_m"):
        spacing = getattr(resolution, name)
        if not 0 < spacing <= shape.radius_m / 2:
            raise ValueError(f"{name} must be above 0 and at most half the dome's radius, got {spacing}")
    radius = shape.radius_m - CONTACT_RADIUS_M
    sets = _layers(radius, resolution)
    surface_count = len(sets[0])
    base = -shape.cylinder_m
    extra = [np.zeros((1, 3))]
    if shape.cylinder_m > 0:
        levels = max(1, round(shape.cylinder_m / resolution.rim_m))
        for k in range(1, levels + 1):
            z = base * k / levels
            inner = np.concatenate([s[s[:, 2] == 0] for s in sets[1:]])
            extra += [_circle(radius, resolution.rim_m, z, k % 2), inner + np.array([0, 0, z]), np.array([[0.0, 0.0, z]])]
    points = np.concatenate(sets + extra)
    on_rim = np.hypot(points[:, 0], points[:, 1]) > radius * (1 - 1e-9)
    bonded = (points[:, 2] <= base + 1e-12) | (on_rim & (points[:, 2] <= 1e-12))

    movable = ~bonded
    movable[:surface_count] = False
    for _ in range(resolution.smoothing):
        tetrahedra = _tetrahedralise(points)
        volume = tetrahedron_volumes(points, tetrahedra)
        weight, centre = np.zeros(len(points)), np.zeros_like(points)
        for corner in tetrahedra.T:
            np.add.at(weight, corner, volume)
            np.add.at(centre, corner, volume[:, None] * points[tetrahedra].mean(1))
        points[movable] = 0.5 * points[movable] + 0.5 * (centre / weight[:, None])[movable]
    tetrahedra = _tetrahedralise(points)
    triangles = _skin_triangles(points, tetrahedra, surface_count, bonded)
    if len(np.unique(triangles)) != surface_count or len(np.unique(tetrahedra)) != len(points):
        raise ValueError(
            f"surface_m {resolution.surface_m:g} and rim_m {resolution.rim_m:g} leave points outside the mesh: choose others"
        )
    centre = np.array([0.0, 0.0, -shape.radius_m])
    mesh = Mesh(points + centre, surface_count, sorted_elements(tetrahedra), sorted_elements(triangles), bonded, centre)
    for array in (mesh.vertices, mesh.tetrahedra, mesh.triangles, mesh.bonded, mesh.centre):
        array.setflags(write=False)
    return mesh
