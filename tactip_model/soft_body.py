"""The soft body: flexes of a MuJoCo model made from a design and its mesh.

The gel is a 3D flex of stable neo-Hookean tetrahedra, the skin a 2D flex (stretching and bending) over the gel's surface
vertices. They share bodies, so the skin adds no degrees of freedom.

Only the skin makes contact, in two ways. Its vertices are small spheres that collide with surfaces flat on the scale of a
facet: one contact per vertex, with the correct normal at corners too. Its facets collide with shapes that fit between the
vertices, such as an edge. (A facet against a box gives each of its corners a contact: six on a vertex and, beside an edge
of the box, contacts where there is no box, which drag the tip along by a millimetre.)
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.design import Design, Materials
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, Mesh, Resolution

STABLE_NEO_HOOKEAN = 1
"""MjsFlex.elastic3d. The default law, St Venant-Kirchhoff, softens under compression: its force is a third too low at a
depth of 3 mm, and it collapses near 4 mm."""

STRETCHING_AND_BENDING = 3
"""MjsFlex.elastic2d."""


TOUCHES_VERTICES = 2
TOUCHES_FACETS = 4
"""Contact bits: `contype` of the skin's vertices and of its facets, `conaffinity` of geoms that collide with them. The skin
has no affinity of its own, so it never collides with itself."""


_REFERENCE = Materials()
"""The materials for which the contact model's parameters were chosen."""

_SKIN_FORCE_RATIO = 0.46
"""Ratio of the default skin's force to the default gel's at a depth of 3 mm, -."""


_MAX_CONTACT = (1e9, 1e7)
"""Largest stiffness, 1/s^2, and damping, 1/s, of contact; above them the solver is badly conditioned."""


RESTING_STEP_S = 7e-3
"""Time step for which `ContactModel.resting` is chosen, s; its stiffness is the largest that this step resolves."""

VOLUME_ROW = "tip/volume"
"""Name of the equality constraint that keeps the gel's volume (sim/contact/gel_volume.py)."""

VOLUME_TENDONS = ("tip/volume/0", "tip/volume/1")
"""Names of its tendons, each over half of the skin's free vertices, in their order. MuJoCo's time per tendon grows with the
square of its joints, so two halves take half the time of one [M]."""

MAX_STIFFENING = 4.0
"""Largest factor on contact damping for a shorter step, -; stiffness is raised by up to its square."""


@dataclass(frozen=True)
class ContactModel:
    """Numerical parameters of contact; none is a property of the tip."""

    moving: tuple[float, float] = within((1e4, 1e2), _MAX_CONTACT, default=(2e6, 4e3))
    """Direct `solref` while the stimulus moves: stiffness, 1/s^2, and damping, 1/s. MuJoCo's default scales
    with the vertices' tiny masses and lets objects through the skin. Ten times the stiffness costs a third more iterations
    for the same pins; a tenth of the damping lets a sticking skin creep."""
    resting: tuple[float, float] = within((1e4, 1e2), _MAX_CONTACT, default=(3e7, 1e5))
    """Direct `solref` while the tip settles: stiff enough for a penetration below 0.05 mm."""
    margin_m: float = within(0, 2e-3, default=0.4e-3)
    """Gap at which a vertex becomes a row of the solver, m; its force still begins at the surface (scene.Scene.step).
    Without it, the solver misses a vertex that friction has lifted off at the next step, and sliding chatters."""
    impedance: float = within(0.1, 0.9999, default=0.95)
    """`solimp`: constant impedance, -."""
    vertex_mass_kg: float = within(1e-7, 1e-2, default=3e-5)
    """Mass of a skin vertex, kg. Contact acts on it: half the mass doubles the penetration, twice the mass costs more
    iterations. Motions are quasi-static, so the mass does not affect where the tip settles."""

    def __post_init__(self) -> None:
        check(self)


def add_soft_tip(
    spec: mujoco.MjSpec,
    parent: mujoco.MjsBody,
    design: Design,
    mesh: Mesh,
    resolution: Resolution,
    contact: ContactModel,
) -> None:
    """Add the soft tip to a model, whose integrator must be `discrete` (see sim/contact/scene.py).

    Args:
        spec: The model.
        parent: Body whose frame is the sensor frame; bonded vertices move with it.
        design: Design of the tip.
        mesh: Mesh of the tip.
        resolution: Resolution the mesh was built with.
        contact: Numerical parameters of contact.
    """
    materials = design.materials
    mass = np.zeros(len(mesh.vertices))
    for corner in mesh.tetrahedra.T:
        np.add.at(mass, corner, mesh.volumes * materials.density_kg_m3 / 4)
    mass *= materials.gel_young_pa / _REFERENCE.gel_young_pa
    mass[: mesh.surface_count] = contact.vertex_mass_kg * relative_stiffness(materials)

    touch = contact_attributes(materials.friction, contact)
    bodies = []
    skin_joints = []
    for i, (position, bonded) in enumerate(zip(mesh.vertices, mesh.bonded, strict=True)):
        if bonded:
            bodies.append(parent.name)
            continue
        body = parent.add_body(name=f"tip/{i}", pos=position, mass=mass[i], inertia=[1e-9] * 3, explicitinertial=True)
        for name, axis in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"tip/{i}/{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        if i < mesh.surface_count:
            skin_joints += [f"tip/{i}/{name}" for name in "xyz"]
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
    if missing_bulk_modulus(materials, resolution) > 0:
        _add_volume_row(spec, skin_joints)


def _add_volume_row(spec: mujoco.MjSpec, skin_joints: list[str]) -> None:
    """Add the row that keeps the gel's volume: tendons over joints of the free skin, and their equality constraint."""
    half = len(skin_joints) // 2
    for name, joints in zip(VOLUME_TENDONS, (skin_joints[:half], skin_joints[half:]), strict=True):
        tendon = spec.add_tendon(name=name)
        for joint in joints:
            tendon.wrap_joint(joint, 1.0)
    # Direct stiffness and damping, which sim/contact/gel_volume.py sets before each step.
    spec.add_equality(
        name=VOLUME_ROW,
        type=mujoco.mjtEq.mjEQ_TENDON,
        objtype=mujoco.mjtObj.mjOBJ_TENDON,
        name1=VOLUME_TENDONS[0],
        name2=VOLUME_TENDONS[1],
        data=[0, -1, *[0] * 10],  # the sum of both lengths
        solref=[-1, -1],
        solimp=[0.5, 0.5, 1e-3, 0.5, 2],
    )


def relative_stiffness(materials: Materials) -> float:
    """Return the approximate ratio of a tip's force to that of a tip of the default materials at the same depth, -."""
    gel = materials.gel_young_pa / _REFERENCE.gel_young_pa
    skin = materials.skin_young_pa * materials.skin_thickness_m
    skin /= _REFERENCE.skin_young_pa * _REFERENCE.skin_thickness_m
    return (gel + _SKIN_FORCE_RATIO * skin) / (1 + _SKIN_FORCE_RATIO)


def gel_attributes(materials: Materials, resolution: Resolution) -> dict[str, Any]:
    """Return the attributes of the gel's flex that define its material.

    The elements have the gel's shear modulus, at a Poisson's ratio of at most the mesh's limit.
    """
    poisson = min(materials.gel_poisson, resolution.poisson_limit)
    return {
        "young": materials.gel_young_pa * (1 + poisson) / (1 + materials.gel_poisson),
        "poisson": poisson,
        "elastic3d": STABLE_NEO_HOOKEAN,
        "damping": materials.damping_s,
        "selfcollide": mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
    }


def missing_bulk_modulus(materials: Materials, resolution: Resolution) -> float:
    """Return the gel's bulk modulus less that of its elements, Pa; 0 where elements have the gel's Poisson's ratio."""
    element = gel_attributes(materials, resolution)
    if element["poisson"] == materials.gel_poisson:
        return 0.0

    def bulk(young: float, poisson: float) -> float:
        return young / (3 * (1 - 2 * poisson))

    return bulk(materials.gel_young_pa, materials.gel_poisson) - bulk(element["young"], element["poisson"])


def skin_attributes(materials: Materials) -> dict[str, Any]:
    """Return the attributes of the skin's flex that define its material."""
    return {
        "young": materials.skin_young_pa,
        "poisson": materials.skin_poisson,
        "thickness": materials.skin_thickness_m,
        "elastic2d": STRETCHING_AND_BENDING,
        "damping": materials.damping_s,
        "selfcollide": mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
    }


def contact_attributes(friction: float, contact: ContactModel) -> dict[str, Any]:
    """Return the attributes of a flex or geom in contact, as while the stimulus moves, for a friction coefficient."""
    return {
        # Without friction the contact must have one dimension: with three and zero friction the dome turned inside out.
        "condim": 3 if friction > 0 else 1,
        "friction": [friction, 0, 0],
        "solref": [-x for x in contact.moving],
        "solimp": [contact.impedance, contact.impedance, 1e-4, 0.5, 2],
    }
