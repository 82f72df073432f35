"""What the tip is pressed on: a flat surface or a straight edge, moved on a free joint."""

import mujoco
import numpy as np

from tactip_model.body import TOUCHES_FACETS, TOUCHES_VERTICES, contact_attributes

HALF_SIZE_M = 60e-3
"""Half the length and width of the block, m: far more than the tip can reach."""

EDGE_RADIUS_M = 0.5e-3
"""Rounding of the edge, m, as of a printed or deburred one."""

_EDGE_FACETS = 12
"""Facets of the rounding: it is 1 µm off a true one."""

TASKS = ("surface", "edge")
"""The paper's two tasks, and so the two stimuli."""


def add_stimulus(spec, task, friction, contact):
    """Add a block whose body frame is the contact frame (sim/pose.py).

    spec: mujoco.MjSpec. task: one of TASKS. friction: float, -. contact: body.ContactModel.

    The block is 1000 kg: its motion is set at every step, and no contact force is to change it within one.
    """
    body = spec.worldbody.add_body(name="stimulus", mass=1000.0, inertia=[10.0] * 3, explicitinertial=True)
    body.add_freejoint(name="stimulus")
    touch = contact_attributes(friction, contact)
    if task == "edge":
        spec.add_mesh(name="edge", uservert=_edge_vertices().ravel())
        both = TOUCHES_VERTICES | TOUCHES_FACETS
        body.add_geom(name="edge", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="edge", contype=0, conaffinity=both, **touch)
    else:
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


def _edge_vertices():
    """Corners (n, 3), m, of the convex block with one rounded edge along y at x = 0, z = 0."""
    turn = np.linspace(0, np.pi / 2, _EDGE_FACETS + 1)
    r = EDGE_RADIUS_M
    profile = np.stack([r * (np.sin(turn) - 1), r * (np.cos(turn) - 1)], 1)
    far = [[0, -HALF_SIZE_M], [-2 * HALF_SIZE_M, -HALF_SIZE_M], [-2 * HALF_SIZE_M, 0]]
    profile = np.concatenate([profile, far])
    return np.concatenate([np.insert(profile, 1, y, axis=1) for y in (-HALF_SIZE_M, HALF_SIZE_M)])


def height_to_clear(task, centre, radius):
    """How far (m) a sphere must rise along the outward normal to leave the stimulus; negative if it is clear by more.

    task: one of TASKS. centre: (3,) m, in the contact frame. radius: float, m. Infinitely negative where the sphere
    passes beside the object. The edge's rounding is left out: the answer is on the safe side by less than it.
    """
    beside = max(centre[0], 0.0) if task == "edge" else 0.0
    if beside >= radius:
        return -np.inf
    return float(np.sqrt(radius**2 - beside**2) - centre[2])
