"""Any solid as a stimulus, with its true shape: no convex hull, no facets of its own to catch on.

MuJoCo makes contacts of convex pieces, or of triangles one by one: of a rigid flex with the skin's facets, so many, and of
so many normals, that a slide over an edge ends further off and takes longer the finer the mesh is (docs/objects.md). Here
the solid's surface comes to the skin instead. At every step each vertex of the skin gets the sphere that touches the surface
where it is nearest, with the surface's normal: the contact is that of the true surface, to first order in what the vertex
moves in a step. Where the solid is higher in the middle of a facet than at its corners, as an edge is, the facet gets a
probe: a sphere inside the solid that touches the surface there, as large as fits. The cost does not depend on how many
triangles the solid has.
"""

import mujoco
import numpy as np

from tactip_twin.sim.contact.signed_distance import Nearest
from tactip_twin.sim.contact.stimuli import EDGE_RADIUS_M, Stimulus
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, contact_attributes

_BALL_M = 10e-3
"""Radius of the spheres that vertices meet, m: they touch the surface from inside at one point, and its curvature is not
seen from one step to the next."""

_PROBE_RADII_M = np.array([3.0, 1.5, 0.8, 0.45, 0.2, 0.1]) * 1e-3
"""Radii that a probe may have, m. The largest that fits into the solid is taken; the last fits, or is so small that what
stands out of a square edge, 0.04 mm, is less than contacts leave."""

_FITS = 0.02
"""Share of its radius by which a probe may stand out, -."""

_PROBES = 64
"""Probes at hand: more than there are facets in a patch on an edge."""

_ODD_M = 0.02e-3
"""Difference of the distance in a facet's middle from what its corners foresee, m: above, it is looked at all over ..."""

_CREASED = 0.35
"""... and difference of the normals at two corners, -: 20 degrees, more than a radius of 8 mm gives."""

_GRID = 4
"""Intervals of a facet's side in the search for its deepest place."""

_WORTH_M = 0.02e-3
"""A probe is set where the solid is so much nearer to a facet than to its corners, m."""

_AWAY = (0.0, 0.0, -1.0)
"""Where balls and probes are before they are needed, m."""


class SolidStimulus(Stimulus):
    """A solid as a stimulus; the contact frame is the solid's own."""

    def __init__(self, solid, sharpest_m=EDGE_RADIUS_M):
        """solid: Solid. sharpest_m: float, the least radius of its edges, m: how closely an overlap is looked for."""
        self.solid = solid
        """May be another one from contact to contact: nothing of it is in the compiled model."""
        self._sharpest_m = sharpest_m

    @property
    def sharpest_m(self):
        """See Stimulus."""
        return self._sharpest_m

    def add_geoms(self, spec, body, touch):
        """See Stimulus: what is met follows the skin, and is added by Follower."""

    def distance(self, points):
        """See Stimulus; of the triangles themselves."""
        return self.solid.distance(points)

    def height_to_clear(self, centre, radius):
        """See Stimulus; the highest point is the solid's own."""
        return super().height_to_clear(centre, radius, float(self.solid.vertices[:, 2].max()))


class SurfaceContactProxies:
    """The surface of a solid as it follows the skin of one tip."""

    def __init__(self, spec, shape, mesh, friction, contact):
        """Add what is met to a model that holds the tip and the body `stimulus`.

        spec: mujoco.MjSpec. shape: Shape. mesh: tactip_model.mesh.Mesh, of the tip. friction: float, -. contact:
        ContactModel.
        """
        self._shape, self._mesh = shape, mesh
        self._vertices = np.flatnonzero(~mesh.bonded[: mesh.surface_count])
        corners = mesh.vertices[mesh.triangles]
        self._reach = 0.6 * np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
        self._inside = _inside(_GRID)
        self._near = CONTACT_RADIUS_M + contact.margin_m
        self._farthest = float(self._reach.max()) + self._near
        self.forget()
        touch, sphere = contact_attributes(friction, contact), mujoco.mjtGeom.mjGEOM_SPHERE
        body = spec.body("stimulus")
        for i in self._vertices:
            body.add_geom(name=f"ball/{i}", type=sphere, size=[_BALL_M, 0, 0], pos=_AWAY, contype=0, conaffinity=0)
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
                pos=_AWAY,
                contype=0,
                conaffinity=TOUCHES_FACETS,
                **touch,
            )

    def bind(self, model):
        """Find the geoms in the compiled model. model: mujoco.MjModel."""
        self._balls = np.array([model.geom(f"ball/{i}").id for i in self._vertices])
        self._probes = np.array([model.geom(f"probe/{k}").id for k in range(_PROBES)])
        # Geoms that move on their body: no frame is the body's own, and no box of its tree can be told beforehand.
        model.geom_sameframe[np.concatenate([self._balls, self._probes])] = 0
        body = model.body("stimulus").id
        tree = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
        model.bvh_aabb[tree] = [0, 0, 0, 2, 2, 2]

    def forget(self):
        """Look at every vertex anew at the next step."""
        self._seen_from = np.full((self._mesh.surface_count, 3), np.inf)
        self._distance = np.zeros(self._mesh.surface_count)

    def follow(self, model, skin):
        """Bring the surface to the skin. model: mujoco.MjModel. skin: (s, 3) m, its vertices in the solid's frame."""
        at, due = self._look(skin)
        touch = np.flatnonzero(due[self._vertices])
        i = self._vertices[touch]
        model.geom_pos[self._balls] = _AWAY
        model.geom_pos[self._balls[touch]] = at.place[i] - _BALL_M * at.normal[i]
        model.geom_conaffinity[self._probes] = 0
        places, normals = self._ridges(skin, at)
        if len(places):
            probes, radii = self._probes[: len(places)], self._radii(places, normals)
            model.geom_conaffinity[probes] = TOUCHES_FACETS
            model.geom_pos[probes] = places - radii[:, None] * normals
            model.geom_size[probes, 0] = model.geom_rbound[probes] = radii
            model.geom_aabb[probes, 3:] = radii[:, None]

    def _look(self, skin):
        """Nearest of the skin's vertices (s, 3), and which (s,) bool were looked at.

        A vertex is not nearer than when it was last looked at, less the way that it went since: those that cannot touch are
        left alone, and their distance is what it is at least.
        """
        away = np.linalg.norm(skin - self._seen_from, axis=1)
        least = self._distance - away
        due = ~(least > self._farthest)
        found = self._shape.solid.nearest(skin[due])
        self._seen_from[due], self._distance[due] = skin[due], found.distance
        distance, place, normal = np.where(due, 0.0, least), np.zeros_like(skin), np.zeros_like(skin)
        distance[due], place[due], normal[due] = found.distance, found.place, found.normal
        return Nearest(distance, place, normal), due

    def _ridges(self, skin, at):
        """Places (m, 3) and normals (m, 3) of the surface where it is nearer to a facet than to its corners.

        at: Nearest of the skin's vertices. What the distance is over a facet is foreseen from its corners; where it is as
        foreseen in the middle, the surface is smooth there, and only the place foreseen as the deepest is looked at. Where
        it is not, or the normals at the corners are far apart, there may be an edge, and the facet is looked at all over.
        """
        triangles = self._mesh.triangles
        lowest = at.distance[triangles].min(1)
        facets = np.flatnonzero(lowest < self._reach + self._near)
        middle = self._shape.solid.distance(skin[triangles[facets]].mean(1))
        foreseen, normals = self._foreseen(skin, at, triangles[facets]), at.normal[triangles[facets]]
        spread = np.linalg.norm(normals - np.roll(normals, 1, axis=1), axis=2).max(1)
        odd = (np.abs(foreseen[:, -1] - middle) > _ODD_M) | (spread > _CREASED)
        foreseen, low = foreseen[:, :-1], lowest[facets]
        deepest, least = foreseen.argmin(1), foreseen.min(1)
        smooth = np.flatnonzero(~odd & (least < low - _WORTH_M / 2) & (least < self._near + _ODD_M))
        odd = np.flatnonzero(odd)
        if not len(smooth) + len(odd):
            return np.zeros((0, 3)), np.zeros((0, 3))
        corners = skin[triangles[facets]]
        points = [
            np.einsum("fc,fck->fk", self._inside[deepest[smooth]], corners[smooth]),
            np.einsum("gc,fck->fgk", self._inside, corners[odd]).reshape(-1, 3),
        ]
        close = self._shape.solid.nearest(np.concatenate(points))
        # Of each facet that is looked at all over, its deepest place.
        every = close.distance[len(smooth) :].reshape(len(odd), len(self._inside))
        rows = len(smooth) + len(self._inside) * np.arange(len(odd)) + every.argmin(1)
        rows = np.concatenate([np.arange(len(smooth)), rows])
        depth, low = close.distance[rows], low[np.concatenate([smooth, odd])]
        worth = np.flatnonzero((depth < self._near) & (depth < low - _WORTH_M))
        chosen = rows[worth[np.argsort(depth[worth], kind="stable")[:_PROBES]]]
        return close.place[chosen], close.normal[chosen]

    def _foreseen(self, skin, at, triangles):
        """Distances (f, g + 1) m over facets (f, 3), at the places `_inside` and in the middle, from those at their corners
        and their gradients there, the normals.

        To second order: sum(l_i d_i) - sum(l_i l_j (n_j - n_i) (x_j - x_i)) / 2, the second over the sides, with shares l of
        the corners x and gradients n there. It is exact where the distance is a quadratic form.
        """
        shares = np.concatenate([self._inside, np.full((1, 3), 1 / 3)])
        x, n = skin[triangles], at.normal[triangles]
        sides = np.einsum("fik,fik->fi", np.roll(n, -1, 1) - n, np.roll(x, -1, 1) - x)
        return at.distance[triangles] @ shares.T - sides @ (shares * np.roll(shares, -1, 1)).T / 2

    def _radii(self, places, normals):
        """Radii (m,) of the largest probes that touch the surface at places (m, 3) from inside."""
        out, left = np.full(len(places), _PROBE_RADII_M[-1]), np.arange(len(places))
        # Where it is smooth the first one fits: the others are only asked about where they are needed.
        for radius in _PROBE_RADII_M[:-1]:
            fits = -self._shape.solid.distance(places[left] - radius * normals[left]) >= (1 - _FITS) * radius
            out[left[fits]] = radius
            left = left[~fits]
            if not len(left):
                break
        return out


def _inside(n):
    """Barycentric coordinates (g, 3) of the points of a triangle's grid with n intervals a side, less its corners."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    keep = (i + j <= n) & (np.maximum(np.maximum(i, j), n - i - j) < n)
    return np.stack([i[keep], j[keep], n - i[keep] - j[keep]], 1) / n
