"""Stimuli: rigid objects to press the tip on, each in its own contact frame (sim/pose.py).

`surface` and `edge` are the paper's. The others test the model with round, pointed, sharp, cornered and hollow shapes. Each
has its highest point at z = 0 and a signed distance to its true shape, against which MuJoCo's contacts are checked. A new
named stimulus needs a class, a line in STIMULI and one in StimulusName.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, TOUCHES_VERTICES, ContactModel, contact_attributes

HALF_SIZE_M = 60e-3
"""Half the length and width of a block, plate or blade, and the length of a rod, m: far beyond the tip's reach."""

EDGE_RADIUS_M = 0.5e-3
"""Rounding of the edge, of the corner and of the hole's rim, m, as of a printed or deburred one."""

SPHERE_RADIUS_M = 5e-3
"""Radius of the sphere, m: a quarter of the dome's."""

POINT_RADIUS_M = 1e-3
"""Radius of the peg with a round end, m: as wide as one facet of the skin."""

NEEDLE_RADIUS_M = 0.25e-3
"""Radius of the needle and of its round end, m: it fits between any two vertices of the skin."""

KNIFE_RADIUS_M = 0.25e-3
"""Rounding of the knife's edge, m: it still fits between vertices."""

KNIFE_ANGLE_RAD = np.radians(10.0)
"""Angle between a side of the knife and its middle plane, rad."""

HOLE_RADIUS_M = 5e-3
"""Minimum radius of the hole, m: a quarter of the dome's, so the tip rests on the rim and bulges in."""

_EDGE_FACETS = 12
"""Facets per quarter turn of a rounding: 1 µm off a true one."""

_CORNER_FACETS = 8
"""Facets per quarter turn of the corner's round end: 5 µm off a true one."""

_HOLE_SECTORS = 48
"""Convex pieces around the hole: 11 µm off a true one."""

_MAX_ROD_DEPTH = 20.0
"""Maximum depth of a rod in its radii. Beyond it, the skin around it is so steep that its facets determine the force."""

_BOTH = TOUCHES_VERTICES | TOUCHES_FACETS

ContactAttributes = dict[str, int | list[float]]
"""Contact attributes of a geom in MuJoCo, by name (soft_body.contact_attributes)."""


class Stimulus(ABC):
    """A rigid object to press the tip on.

    A subclass defines `add_geoms` and `distance`. The other members have defaults for an object without features
    smaller than a facet of the skin.
    """

    @property
    def min_radius_m(self) -> float:
        """Minimum radius of a part that fits between the skin's vertices, m; infinite without one."""
        return np.inf

    @property
    def width_m(self) -> float:
        """Width of a part that could pierce the skin, m; infinite without one."""
        return np.inf

    @property
    def max_depth_m(self) -> float:
        """Maximum depth of stable contacts (docs/stability.md), m; infinite if the tip's own limit is smaller."""
        return np.inf

    @property
    def can_snag(self) -> bool:
        """Whether sliding skin can snag on it by chance, on a vertex or facet that depends on the step size."""
        return False

    @property
    def has_edge(self) -> bool:
        """Whether it presses an edge into the skin, which a coarse mesh does not resolve where the skin moves far."""
        return False

    @property
    def is_convex(self) -> bool:
        """Whether it is convex, which makes its overlap with the skin quicker to find."""
        return False

    @property
    def top_m(self) -> float:
        """Height of the highest point in the contact frame, m."""
        return 0.0

    @abstractmethod
    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """Add the geoms that the tip collides with.

        Args:
            spec: Model to add to.
            body: Body of the stimulus; its frame is the contact frame.
            touch: Contact attributes of the geoms.
        """

    @abstractmethod
    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (...) m of points (..., 3) m in the contact frame to the true shape; negative inside.

        Parts far beyond the tip's reach (HALF_SIZE_M) count as infinitely long.
        """

    def height_to_clear(self, centre: np.ndarray, radius: float) -> float:
        """Return the height (m) by which a sphere must rise along z to clear the stimulus.

        It is never too low, but may be too high. The sphere is lowered repeatedly, each time by its current clearance.

        Args:
            centre: (3,) m, centre of the sphere in the contact frame.
            radius: Radius of the sphere, m.

        Returns:
            The height; negative if the sphere is clear by more, and minus infinity if it passes beside the stimulus.
        """
        centre = np.asarray(centre, float)
        lift = self.top_m + radius - centre[2]
        for _ in range(1000):
            gap = float(self.distance(centre + np.array([0, 0, lift]))) - radius
            if gap < 1e-9:
                break
            lift -= gap
            if centre[2] + lift < -HALF_SIZE_M:
                return -np.inf
        return lift


@dataclass(frozen=True)
class Flat(Stimulus):
    """A flat surface. Only vertices collide with it: see tactip_model/soft_body.py."""

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        a = HALF_SIZE_M
        body.add_geom(
            name="flat",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[a, a, a / 2],
            pos=[0, 0, -a / 2],
            contype=0,
            conaffinity=TOUCHES_VERTICES,
            **touch,
        )

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinite plane."""
        return points[..., 2]

    def height_to_clear(self, centre: np.ndarray, radius: float) -> float:
        """See Stimulus."""
        return float(radius - centre[2])


@dataclass(frozen=True)
class StraightEdge(Stimulus):
    """A block that fills x < 0, with one straight, rounded edge along y."""

    radius_m: float = EDGE_RADIUS_M
    """Rounding of the edge, m."""

    @property
    def min_radius_m(self) -> float:
        """See Stimulus."""
        return self.radius_m

    @property
    def has_edge(self) -> bool:
        """See Stimulus."""
        return True

    @property
    def is_convex(self) -> bool:
        """See Stimulus."""
        return True

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        turn = np.linspace(0, np.pi / 2, _EDGE_FACETS + 1)
        r = self.radius_m
        profile = np.stack([r * (np.sin(turn) - 1), r * (np.cos(turn) - 1)], 1)
        far = [[0, -HALF_SIZE_M], [-2 * HALF_SIZE_M, -HALF_SIZE_M], [-2 * HALF_SIZE_M, 0]]
        _add_mesh(spec, body, "edge", _along_y(np.concatenate([profile, far])), _BOTH, touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinite block."""
        x, z = points[..., 0] + self.radius_m, points[..., 2] + self.radius_m
        return np.hypot(np.maximum(x, 0), np.maximum(z, 0)) + np.minimum(np.maximum(x, z), 0) - self.radius_m

    def height_to_clear(self, centre: np.ndarray, radius: float) -> float:
        """See Stimulus. It neglects the rounding, which makes the height too high by less than that."""
        beside = max(centre[0], 0.0)
        if beside >= radius:
            return -np.inf
        return float(np.sqrt(radius**2 - beside**2) - centre[2])


class Thin(Stimulus):
    """A stimulus that could pierce the skin."""

    radius_m: float
    """Radius of the part that touches the skin, m."""

    @property
    def min_radius_m(self) -> float:
        """See Stimulus."""
        return self.radius_m

    @property
    def width_m(self) -> float:
        """See Stimulus."""
        return 2 * self.radius_m

    @property
    def can_snag(self) -> bool:
        """See Stimulus. A corner rounded by 0.5 mm can, a peg of 1 mm cannot (docs/stability.md)."""
        return self.radius_m <= EDGE_RADIUS_M


@dataclass(frozen=True)
class Ball(Thin):
    """A sphere."""

    radius_m: float
    """Radius, m."""

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        kind, r = mujoco.mjtGeom.mjGEOM_SPHERE, self.radius_m
        body.add_geom(name="ball", type=kind, size=[r, 0, 0], pos=[0, 0, -r], contype=0, conaffinity=_BOTH, **touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus."""
        return np.linalg.norm(points + np.array([0, 0, self.radius_m]), axis=-1) - self.radius_m


@dataclass(frozen=True)
class Rod(Thin):
    """A rod along z with a round end: a peg or a needle."""

    radius_m: float
    """Radius of the rod and of its end, m."""

    @property
    def max_depth_m(self) -> float:
        """See Stimulus."""
        return _MAX_ROD_DEPTH * self.radius_m

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        r, half = self.radius_m, HALF_SIZE_M / 2
        kind, place = mujoco.mjtGeom.mjGEOM_CAPSULE, [0, 0, -r - half]
        body.add_geom(name="rod", type=kind, size=[r, half, 0], pos=place, contype=0, conaffinity=_BOTH, **touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinitely long rod."""
        above = np.maximum(points[..., 2] + self.radius_m, 0)
        return np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + above**2) - self.radius_m


@dataclass(frozen=True)
class Knife(Thin):
    """A blade in the plane of y and z, its rounded edge along y."""

    radius_m: float = KNIFE_RADIUS_M
    """Rounding of the edge, m."""
    angle_rad: float = float(KNIFE_ANGLE_RAD)
    """Angle between a side and the middle plane, rad."""

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        r, a, down = self.radius_m, self.angle_rad, HALF_SIZE_M
        turn = np.linspace(a - np.pi / 2, np.pi / 2 - a, 2 * _EDGE_FACETS + 1)
        profile = np.stack([r * np.sin(turn), r * (np.cos(turn) - 1)], 1)
        wide = profile[-1, 0] + (profile[-1, 1] + down) * np.tan(a)
        _add_mesh(spec, body, "knife", _along_y(np.concatenate([profile, [[wide, -down], [-wide, -down]]])), _BOTH, touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinite blade: a sharp wedge, thickened by `radius_m`."""
        x, z = np.abs(points[..., 0]), points[..., 2] + self.radius_m
        s, c = np.sin(self.angle_rad), np.cos(self.angle_rad)
        side, along = x * c + z * s, x * s - z * c
        return np.where(along > 0, side, np.hypot(x, z)) - self.radius_m


@dataclass(frozen=True)
class Corner(Thin):
    """A rounded cube that stands on one corner, so the opposite one points up."""

    radius_m: float = EDGE_RADIUS_M
    """Rounding of corner and edges, m."""

    _UPRIGHT = Rotation.align_vectors([[0, 0, 1]], [[1, 1, 1]])[0].as_matrix()
    """Rotation of the cube's diagonal to the normal."""

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        r = self.radius_m
        turn = np.linspace(0, np.pi / 2, _CORNER_FACETS + 1)
        polar, azimuth = np.meshgrid(turn, turn)
        octant = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
        octant = np.unique(octant.reshape(-1, 3).round(12), axis=0)
        signs = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)])
        # The rounding of the upper corner is centred at the origin; the opposite corner is half a block away.
        centres = np.where(signs > 0, 0.0, -HALF_SIZE_M)
        cube = np.concatenate([m + r * s * octant for m, s in zip(centres, signs, strict=True)])
        _add_mesh(spec, body, "corner", cube @ self._UPRIGHT.T - [0, 0, r], _BOTH, touch)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinite corner."""
        own = (points + np.array([0, 0, self.radius_m])) @ self._UPRIGHT
        return np.linalg.norm(np.maximum(own, 0), axis=-1) + np.minimum(own.max(-1), 0) - self.radius_m


@dataclass(frozen=True)
class Hole(Stimulus):
    """A plate with a round hole about the origin and a rounded rim.

    Vertices collide with convex sectors of the plate, which are flat or hollow to the skin. Facets collide with the rim
    alone, a chain of capsules without seams to snag on.
    """

    radius_m: float = HOLE_RADIUS_M
    """Radius of the hole, m."""
    rim_m: float = EDGE_RADIUS_M
    """Rounding of the rim, m."""

    @property
    def min_radius_m(self) -> float:
        """See Stimulus."""
        return self.rim_m

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, touch: ContactAttributes) -> None:
        """See Stimulus."""
        half = np.pi / _HOLE_SECTORS
        outside = 1 / np.sqrt(np.cos(half))  # corners are as far outside the circle as the middles of sides are inside
        turn = np.linspace(-np.pi / 2, 0, _EDGE_FACETS // 2 + 1)
        rounding = np.stack([np.sin(turn) + 1, np.cos(turn) - 1], 1) * self.rim_m + [self.radius_m, 0]
        down = HALF_SIZE_M / 2
        profile = np.concatenate([rounding, [[self.radius_m, -down], [HALF_SIZE_M, -down], [HALF_SIZE_M, 0]]])
        ring = (self.radius_m + self.rim_m) * outside
        for k in range(_HOLE_SECTORS):
            middle = 2 * half * k
            ends = [np.array([np.cos(a), np.sin(a)]) for a in (middle - half, middle + half)]
            sector = np.concatenate([np.column_stack([np.outer(profile[:, 0] * outside, e), profile[:, 1]]) for e in ends])
            _add_mesh(spec, body, f"sector/{k}", sector, TOUCHES_VERTICES, touch)
            body.add_geom(
                name=f"rim/{k}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[self.rim_m, 0, 0],
                fromto=[*(ring * ends[0]), -self.rim_m, *(ring * ends[1]), -self.rim_m],
                contype=0,
                conaffinity=TOUCHES_FACETS,
                **touch,
            )

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See Stimulus; of an infinite plate."""
        inward = self.radius_m + self.rim_m - np.hypot(points[..., 0], points[..., 1])
        z = points[..., 2] + self.rim_m
        outside = np.hypot(np.maximum(inward, 0), np.maximum(z, 0))
        return outside + np.minimum(np.maximum(inward, z), 0) - self.rim_m


StimulusName = Literal["surface", "edge", "sphere", "point", "needle", "knife", "corner", "hole"]
"""Name of a stimulus of STIMULI."""

STIMULI: dict[StimulusName, Stimulus] = {
    "surface": Flat(),
    "edge": StraightEdge(),
    "sphere": Ball(SPHERE_RADIUS_M),
    "point": Rod(POINT_RADIUS_M),
    "needle": Rod(NEEDLE_RADIUS_M),
    "knife": Knife(),
    "corner": Corner(),
    "hole": Hole(),
}
"""Stimuli by name."""


def stimulus_named(name: str) -> Stimulus:
    """Return the stimulus with a name; raise TactipError, which lists the names, on an unknown one."""
    return lookup("stimulus", name, STIMULI)


def add_stimulus(spec: mujoco.MjSpec, stimulus: Stimulus, friction: float, contact: ContactModel) -> None:
    """Add a stimulus on a free joint to a model, as the body `stimulus`; its frame is the contact frame (sim/pose.py).

    Its mass is 1000 kg because its motion is set at every step and contact forces must not change it within one.

    Args:
        spec: Model to add to.
        stimulus: The stimulus.
        friction: Friction coefficient of the skin, -.
        contact: Contact model.
    """
    body = spec.worldbody.add_body(name="stimulus", mass=1000.0, inertia=[10.0] * 3, explicitinertial=True)
    body.add_freejoint(name="stimulus")
    stimulus.add_geoms(spec, body, contact_attributes(friction, contact))


def _add_mesh(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, vertices: np.ndarray, touches: int, touch: ContactAttributes
) -> None:
    """Add the convex hull of vertices (n, 3) m to a body. `touches` are the contact bits of the geoms it collides with."""
    spec.add_mesh(name=name, uservert=vertices.ravel())
    kind = mujoco.mjtGeom.mjGEOM_MESH
    body.add_geom(name=name, type=kind, meshname=name, contype=0, conaffinity=touches, **touch)


def _along_y(profile: np.ndarray) -> np.ndarray:
    """Return the corners (2 n, 3) m of a block along y with a profile (n, 2) m in x and z."""
    return np.concatenate([np.insert(profile, 1, y, axis=1) for y in (-HALF_SIZE_M, HALF_SIZE_M)])
