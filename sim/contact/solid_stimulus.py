"""Any solid as a stimulus, with its true shape instead of a convex hull or facets on which the skin could snag.

MuJoCo collides convex pieces, or triangles one by one. A rigid flex makes many contacts with the skin's facets, with many
normals, so a slide over an edge becomes less accurate and slower as the mesh gets finer (docs/mesh_contact.md). Here,
contact proxies, spheres on the solid's surface, follow the skin instead. At every step each vertex of the skin gets a sphere
that touches the surface at its nearest point, with the surface normal: the contact is that of the true surface, to first
order in the motion of the vertex per step. Where the solid is higher in the middle of a facet than at its corners, as on an
edge, the facet gets a probe: the largest sphere inside the solid that touches the surface there. The cost does not depend on
the number of triangles.
"""

import mujoco
import numpy as np

from tactip_twin.sim.contact.signed_distance import Nearest, SignedDistanceMesh
from tactip_twin.sim.contact.stimuli import EDGE_RADIUS_M, ContactAttributes, Stimulus
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, Mesh
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, ContactModel, contact_attributes

_BALL_M = 10e-3
"""Radius of the spheres that vertices collide with, m. They touch the surface from inside at one point, and their curvature
does not matter within one step."""

_PROBE_RADII_M = np.array([3.0, 1.5, 0.8, 0.45, 0.2, 0.1]) * 1e-3
"""Radii of probes, m. A probe gets the largest that fits into the solid. The last always fits, or protrudes from a square
edge by 0.04 mm, less than the penetration of contacts."""

_PROTRUSION = 0.02
"""Maximum protrusion of a probe from the solid, as a fraction of its radius, -."""

_PROBES = 64
"""Number of probes: more than the facets of a contact patch on an edge."""

_MAX_PREDICTION_ERROR_M = 0.02e-3
"""Error of the distance predicted for a facet's middle from its corners, m, above which the whole facet is searched ..."""

_CREASE = 0.35
"""... and difference of the normals at two corners, -, above which it is: 20 degrees, more than on a radius of 8 mm."""

_GRID = 4
"""Intervals per side of a facet in the search for its deepest point."""

_MAX_HELD = 0.5
"""Maximum weight of the corners that are clamped to the housing at a point that a probe touches, - [?]. Next to them a
facet cannot give way, and a contact there takes thousands of newtons [M]: there the housing is what touches."""

_MIN_PROBE_GAIN_M = 0.02e-3
"""Minimum difference between the distances to a facet and to its corners that gives the facet a probe, m."""

_PARKED = (0.0, 0.0, -1.0)
"""Position of balls and probes that are not in use, m."""


class SolidStimulus(Stimulus):
    """A solid as a stimulus; the contact frame is the solid's own."""

    def __init__(self, solid: SignedDistanceMesh, min_radius_m: float = EDGE_RADIUS_M) -> None:
        """Args:
        solid: The solid.
        min_radius_m: Minimum radius of its edges, m; it sets how densely overlaps are sampled.
        """
        self.solid = solid
        """The solid. It may be replaced between contacts, because the compiled model does not contain it."""
        self._min_radius_m = min_radius_m

    @property
    def min_radius_m(self) -> float:
        """See Stimulus."""
        return self._min_radius_m

    @property
    def top_m(self) -> float:
        """See Stimulus."""
        return float(self.solid.vertices[:, 2].max())

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus. Adds nothing, because SurfaceContactProxies adds the geoms, which follow the skin."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of the triangles themselves."""
        return self.solid.distance(points)


class SurfaceContactProxies:
    """Contact proxies: spheres on a solid's surface that follow the skin of one tip and collide with it."""

    def __init__(
        self, spec: mujoco.MjSpec, stimulus: SolidStimulus, mesh: Mesh, friction: float, contact: ContactModel
    ) -> None:
        """Add the spheres to a model that has the tip and the body `stimulus`.

        Args:
            spec: Model to add to.
            stimulus: The solid.
            mesh: Mesh of the tip.
            friction: Friction coefficient of the skin, -.
            contact: Contact model.
        """
        self._stimulus, self._mesh = stimulus, mesh
        self._vertices = np.flatnonzero(~mesh.bonded[: mesh.surface_count])
        corners = mesh.vertices[mesh.triangles]
        self._reach = 0.6 * np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        self._inside = _inside(_GRID)
        self._held = mesh.bonded[mesh.triangles] @ self._inside.T > _MAX_HELD
        self._near = CONTACT_RADIUS_M + contact.margin_m
        self._max_distance = float(self._reach.max()) + self._near
        self.reset()
        touch, sphere = contact_attributes(friction, contact), mujoco.mjtGeom.mjGEOM_SPHERE
        body = spec.body("stimulus")
        for i in self._vertices:
            body.add_geom(name=f"ball/{i}", type=sphere, size=[_BALL_M, 0, 0], pos=_PARKED, contype=0, conaffinity=0)
            spec.add_pair(
                geomname1=f"tip/{i}",
                geomname2=f"ball/{i}",
                margin=contact.margin_m,
                **{**touch, "friction": [friction, friction, 0, 0, 0]},
            )
        for k in range(_PROBES):
            radius = _PROBE_RADII_M[-1]
            body.add_geom(
                name=f"probe/{k}",
                type=sphere,
                size=[radius, 0, 0],
                pos=_PARKED,
                contype=0,
                conaffinity=TOUCHES_FACETS,
                **touch,
            )

    def bind(self, model: mujoco.MjModel) -> None:
        """Find the geoms in the compiled model."""
        self._balls = np.array([model.geom(f"ball/{i}").id for i in self._vertices])
        self._probes = np.array([model.geom(f"probe/{k}").id for k in range(_PROBES)])
        # The geoms move on their body, so MuJoCo must not reuse the body's frame or precomputed bounding boxes.
        model.geom_sameframe[np.concatenate([self._balls, self._probes])] = 0
        body = model.body("stimulus").id
        tree = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
        model.bvh_aabb[tree] = [0, 0, 0, 2, 2, 2]

    def reset(self) -> None:
        """Discard the known distances, so the next step computes all of them."""
        self._last_position = np.full((self._mesh.surface_count, 3), np.inf)
        self._distance = np.zeros(self._mesh.surface_count)

    def update(self, model: mujoco.MjModel, skin: np.ndarray) -> None:
        """Move the spheres to the skin.

        Args:
            model: Compiled model of the scene.
            skin: (s, 3) m, vertices of the skin in the solid's frame.
        """
        at, due = self._nearest(skin)
        touch = np.flatnonzero(due[self._vertices])
        i = self._vertices[touch]
        model.geom_pos[self._balls] = _PARKED
        model.geom_pos[self._balls[touch]] = at.place[i] - _BALL_M * at.normal[i]
        model.geom_conaffinity[self._probes] = 0
        places, normals = self._ridges(skin, at)
        if len(places):
            probes, radii = self._probes[: len(places)], self._radii(places, normals)
            model.geom_conaffinity[probes] = TOUCHES_FACETS
            model.geom_pos[probes] = places - radii[:, None] * normals
            model.geom_size[probes, 0] = model.geom_rbound[probes] = radii
            model.geom_aabb[probes, 3:] = radii[:, None]

    def _nearest(self, skin: np.ndarray) -> tuple[Nearest, np.ndarray]:
        """Return the nearest surface points of the skin's vertices (s, 3), and which (s,) bool were computed.

        The distance of a vertex falls at most by the distance that it has moved since it was last computed. Vertices that
        cannot touch are skipped; their distance is then this lower bound.
        """
        away = np.linalg.norm(skin - self._last_position, axis=1)
        lower_bound = self._distance - away
        due = ~(lower_bound > self._max_distance)
        found = self._stimulus.solid.nearest(skin[due])
        self._last_position[due], self._distance[due] = skin[due], found.distance
        distance, place, normal = np.where(due, 0.0, lower_bound), np.zeros_like(skin), np.zeros_like(skin)
        distance[due], place[due], normal[due] = found.distance, found.place, found.normal
        return Nearest(distance, place, normal), due

    def _ridges(self, skin: np.ndarray, at: Nearest) -> tuple[np.ndarray, np.ndarray]:
        """Return places (m, 3) and normals (m, 3) of the surface where it is nearer to a facet than to its corners.

        The distance over a facet is predicted from its corners. Where the prediction holds in the middle, the surface is
        smooth, and only the deepest predicted point is computed. Where it does not, or the normals at the corners differ
        much, there may be an edge, and the whole facet is searched, but for points that are too far from the surface
        whatever its shape.

        Args:
            skin: (s, 3) m, vertices of the skin in the solid's frame.
            at: Nearest surface points of these vertices.
        """
        triangles = self._mesh.triangles
        lowest = at.distance[triangles].min(1)
        facets = np.flatnonzero(lowest < self._reach + self._near)
        middle = self._stimulus.solid.distance(skin[triangles[facets]].mean(1))
        predicted, normals = self._predicted(skin, at, triangles[facets]), at.normal[triangles[facets]]
        spread = np.linalg.norm(normals - np.roll(normals, 1, axis=1), axis=2).max(1)
        odd = (np.abs(predicted[:, -1] - middle) > _MAX_PREDICTION_ERROR_M) | (spread > _CREASE)
        predicted, low = np.where(self._held[facets], np.inf, predicted[:, :-1]), lowest[facets]
        deepest, least = predicted.argmin(1), predicted.min(1)
        smooth = np.flatnonzero(
            ~odd & (least < low - _MIN_PROBE_GAIN_M / 2) & (least < self._near + _MAX_PREDICTION_ERROR_M)
        )
        odd = np.flatnonzero(odd)
        corners = skin[triangles[facets]]
        searched = np.einsum("gc,fck->fgk", self._inside, corners[odd])
        # Beyond this distance a point is worth no probe.
        enough = np.minimum(self._near, low - _MIN_PROBE_GAIN_M)
        known = np.column_stack([at.distance[triangles[facets[odd]]], middle[odd]])
        bound = _lower_bounds(searched, np.concatenate([corners[odd], corners[odd].mean(1, keepdims=True)], 1), known)
        where = np.nonzero((bound < enough[odd, None]) & ~self._held[facets[odd]])
        points = [np.einsum("fc,fck->fk", self._inside[deepest[smooth]], corners[smooth]), searched[where]]
        if not len(smooth) + len(where[0]):
            return np.zeros((0, 3)), np.zeros((0, 3))
        close = self._stimulus.solid.nearest(np.concatenate(points))
        # The deepest point of each facet that is searched.
        row = np.full(bound.shape, -1)
        row[where] = len(smooth) + np.arange(len(where[0]))
        every = np.where(row < 0, np.inf, close.distance[row])
        rows = row[np.arange(len(odd)), every.argmin(1)]
        found = rows >= 0
        rows = np.concatenate([np.arange(len(smooth)), rows[found]])
        depth = close.distance[rows]
        worth = np.flatnonzero(depth < enough[np.concatenate([smooth, odd[found]])])
        chosen = rows[worth[np.argsort(depth[worth], kind="stable")[:_PROBES]]]
        return close.place[chosen], close.normal[chosen]

    def _predicted(self, skin: np.ndarray, at: Nearest, triangles: np.ndarray) -> np.ndarray:
        """Return distances (f, g + 1) m over facets (f, 3), at the points `_inside` and in the middle, predicted from the
        distances at their corners and the gradients there, the normals.

        To second order: sum(l_i d_i) - sum(l_i l_j (n_j - n_i) (x_j - x_i)) / 2, the second sum over the sides, with
        barycentric coordinates l, corners x and gradients n there. It is exact where the distance is a quadratic form.
        """
        weights = np.concatenate([self._inside, np.full((1, 3), 1 / 3)])
        x, n = skin[triangles], at.normal[triangles]
        sides = np.einsum("fik,fik->fi", np.roll(n, -1, 1) - n, np.roll(x, -1, 1) - x)
        return at.distance[triangles] @ weights.T - sides @ (weights * np.roll(weights, -1, 1)).T / 2

    def _radii(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return radii (m,) m of the largest probes that touch the surface at places (m, 3) from inside."""
        out, left = np.full(len(places), _PROBE_RADII_M[-1]), np.arange(len(places))
        # On a smooth surface the first radius fits, so the others are tried only where it does not.
        for radius in _PROBE_RADII_M[:-1]:
            fits = -self._stimulus.solid.distance(places[left] - radius * normals[left]) >= (1 - _PROTRUSION) * radius
            out[left[fits]] = radius
            left = left[~fits]
            if not len(left):
                break
        return out


def _lower_bounds(points: np.ndarray, places: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Return lower bounds (f, g) m of distances at points (f, g, 3): a distance differs by no more than the way to a place.

    Args:
        points: m.
        places: (f, c, 3) m, places with known distances.
        distances: (f, c) m.
    """
    out = np.full(points.shape[:2], -np.inf)
    for place, distance in zip(places.swapaxes(0, 1), distances.T, strict=True):
        away = points - place[:, None]
        np.maximum(out, distance[:, None] - np.sqrt(np.einsum("fgk,fgk->fg", away, away)), out=out)
    return out


def _inside(n: int) -> np.ndarray:
    """Return barycentric coordinates (g, 3) of a triangle's grid points with n intervals per side, without its corners."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    keep = (i + j <= n) & (np.maximum(np.maximum(i, j), n - i - j) < n)
    return np.stack([i[keep], j[keep], n - i[keep] - j[keep]], 1) / n
