"""The soft body: a design and its mesh become flexes of a MuJoCo model.

The gel is a 3D flex of stable neo-Hookean tetrahedra, the skin a 2D flex (stretching and bending) over the gel's surface
vertices: they share bodies, so that the skin costs no degree of freedom.

Only the skin touches things, in two ways. Its vertices are small spheres, and what is flat on the scale of a facet meets
these: one contact a vertex, with the right normal at corners too. Its facets meet what can pass between the vertices,
such as an edge. (A facet against a box gives each of its corners a contact: six on a vertex, and beside an edge of the
box, contacts where there is no box, that drag the tip along by a millimetre.)
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.design import Materials
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M

STABLE_NEO_HOOKEAN = 1
"""MjsFlex.elastic3d. The default law, St Venant-Kirchhoff, softens under compression: a third of the force is missing
at 3 mm of depth, and it collapses near 4 mm."""

STRETCHING_AND_BENDING = 3
"""MjsFlex.elastic2d."""


TOUCHES_VERTICES = 2
TOUCHES_FACETS = 4
"""Contact bits: `contype` of the skin's vertices and of its facets, `conaffinity` of what is to meet them. The skin has no
affinity of its own, so that it never meets itself."""


_REFERENCE = Materials()
"""The materials for which the contact model's numbers are chosen."""

_SKIN_SHARE = 0.46
"""Force of the default skin over that of the default gel, pressed 3 mm deep, -."""


STIFFEST = (1e9, 1e7)
"""Stiffest contact, 1/s^2 and 1/s: beyond it the solver's conditioning is its own."""


STEP_OF_RESTING_S = 7e-3
"""Time step for which `ContactModel.resting` is chosen, s: it is as stiff as that step resolves."""

_LOCKING = (0.35, 0.45)
"""Poisson's ratios from which, and from which fully, `mesh.Resolution.locked_stiffness` acts, -."""

STIFFENED = 4.0
"""Most by which a shorter step's contact is stiffer (its square) and more damped, -."""


@dataclass(frozen=True)
class ContactModel:
    """How contact is enforced. Numerical: none of it is a property of the tip."""

    moving: tuple[float, float] = within((1e4, 1e2), STIFFEST, default=(2e6, 4e3))
    """Direct `solref` while the stimulus moves: stiffness, 1/s^2, and damping, 1/s. The default contact scales with the
    vertices' tiny masses and lets objects through the skin. Ten times stiffer costs a third more iterations for the same
    pins; ten times less damping lets a skin that sticks creep."""
    resting: tuple[float, float] = within((1e4, 1e2), STIFFEST, default=(3e7, 1e5))
    """The same while the tip comes to rest: stiff enough to leave less than 0.05 mm of penetration."""
    margin_m: float = within(0, 2e-3, default=0.4e-3)
    """Gap at which a vertex becomes a row of the solver, m; its force still begins at the surface (scene.Scene.step).
    Without it, a vertex that friction lifts off is missed at the next step, and a slide chatters."""
    impedance: float = within(0.1, 0.9999, default=0.95)
    """`solimp`: constant impedance, -."""
    vertex_mass_kg: float = within(1e-7, 1e-2, default=3e-5)
    """Mass of a skin vertex, kg. Contact pushes against it: half of it leaves twice the penetration, twice of it costs
    more iterations. Motions are quasi-static, so that mass does not change where the tip comes to rest."""

    def __post_init__(self):
        check(self)


def add_soft_tip(spec, parent, design, mesh, resolution, contact):
    """Add the soft tip to a model.

    spec: mujoco.MjSpec. parent: MjsBody whose frame is the sensor frame; bonded vertices move with it. design: Design.
    mesh: mesh.Mesh. resolution: mesh.Resolution, that the mesh was built with. contact: ContactModel.
    The integrator must be `discrete` (see sim/contact/scene.py).
    """
    materials = design.materials
    mass = np.zeros(len(mesh.vertices))
    for corner in mesh.tetrahedra.T:
        np.add.at(mass, corner, mesh.volumes * materials.density_kg_m3 / 4)
    mass *= materials.gel_young_pa / _REFERENCE.gel_young_pa
    mass[: mesh.surface_count] = contact.vertex_mass_kg * relative_stiffness(materials)

    touch = contact_attributes(materials.friction, contact)
    bodies = []
    for i, (position, bonded) in enumerate(zip(mesh.vertices, mesh.bonded, strict=True)):
        if bonded:
            bodies.append(parent.name)
            continue
        body = parent.add_body(name=f"tip/{i}", pos=position, mass=mass[i], inertia=[1e-9] * 3, explicitinertial=True)
        for axis in np.eye(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        if i < mesh.surface_count:
            body.add_geom(
                name=f"tip/{i}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[CONTACT_RADIUS_M, 0, 0],
                margin=contact.margin_m,
                contype=TOUCHES_VERTICES,
                conaffinity=0,
                **touch,
            )
        bodies.append(body.name)
    local = np.where(mesh.bonded[:, None], mesh.vertices, 0.0)

    surface = mesh.surface_count
    spec.add_flex(
        name="tip/skin",
        dim=2,
        radius=CONTACT_RADIUS_M,
        vertbody=bodies[:surface],
        vert=local[:surface].ravel(),
        elem=mesh.triangles.ravel(),
        **skin_attributes(materials),
        contype=TOUCHES_FACETS,
        conaffinity=0,
        **touch,
    )
    spec.add_flex(
        name="tip/gel",
        dim=3,
        radius=0,
        vertbody=bodies,
        vert=local.ravel(),
        elem=mesh.tetrahedra.ravel(),
        **gel_attributes(materials, resolution),
        contype=0,
        conaffinity=0,
    )


def relative_stiffness(materials):
    """Force (-) of a tip of materials (design.Materials) over that of the default ones, about, at the same depth."""
    gel = materials.gel_young_pa / _REFERENCE.gel_young_pa
    skin = materials.skin_young_pa * materials.skin_thickness_m
    skin /= _REFERENCE.skin_young_pa * _REFERENCE.skin_thickness_m
    return (gel + _SKIN_SHARE * skin) / (1 + _SKIN_SHARE)


def gel_attributes(materials, resolution):
    """Attributes (dict) of the gel's flex that make its material.

    materials: design.Materials. resolution: mesh.Resolution.
    """
    locked = np.clip((materials.gel_poisson - _LOCKING[0]) / (_LOCKING[1] - _LOCKING[0]), 0.0, 1.0)
    return {
        "young": materials.gel_young_pa * float(1 - (1 - resolution.locked_stiffness) * locked),
        "poisson": min(materials.gel_poisson, resolution.poisson_limit),
        "elastic3d": STABLE_NEO_HOOKEAN,
        "damping": materials.damping_s,
        "selfcollide": mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
    }


def skin_attributes(materials):
    """Material of the skin's flex, a dict of attributes. materials: design.Materials."""
    return {
        "young": materials.skin_young_pa,
        "poisson": materials.skin_poisson,
        "thickness": materials.skin_thickness_m,
        "elastic2d": STRETCHING_AND_BENDING,
        "damping": materials.damping_s,
        "selfcollide": mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
    }


def contact_attributes(friction, contact):
    """Attributes (dict) of a flex or geom that touches, as while moving: friction (-) and a ContactModel."""
    return {
        # Without friction the contact must have one dimension: three with zero friction turned the dome inside out.
        "condim": 3 if friction > 0 else 1,
        "friction": [friction, 0, 0],
        "solref": [-x for x in contact.moving],
        "solimp": [contact.impedance, contact.impedance, 1e-4, 0.5, 2],
    }
