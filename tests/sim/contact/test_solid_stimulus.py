"""Contact with a solid of any shape: the same as with the stimulus whose shape it has, and without it leaving a trace."""

import numpy as np
import pytest
import trimesh

from tactip_twin.assets.meshes.rims import block
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import SPHERE_RADIUS_M
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.presets import load_design

POSE, SHEAR = from_mm_deg([1.0, 0, -3, 5, -6, 20]), from_mm_deg([2.0, -1, 0, 2, 0, 3])


def solid(mesh, size=None):
    """A Solid of a trimesh.Trimesh in mm, cut up to triangles of at most `size` mm."""
    if size:
        mesh = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, size, max_iter=20))
        mesh.merge_vertices()
    return SignedDistanceMesh(mesh.vertices / 1e3, mesh.faces)


def ball():
    radius = 1e3 * SPHERE_RADIUS_M
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return mesh.apply_translation([0, 0, -radius])


def edge():
    return trimesh.convex.convex_hull(block(30.0, 30.0)).apply_translation([-30, 0, 0])


def flat():
    return trimesh.creation.box((120.0, 120, 60)).apply_translation([0, 0, -30])


@pytest.fixture(scope="module")
def play():
    design, fidelity = load_design("tactip-127"), fidelity_named("draft")
    return lambda stimulus: ContactSimulator(design, stimulus, fidelity).play(POSE, SHEAR)


def apart_mm(one, other):
    return 1e3 * np.sqrt(((one.tips - other.tips) ** 2).sum(1).mean())


def test_a_flat_solid_is_the_flat_surface(play):
    """Each vertex meets the plane where it is nearest: the same contact, to what the solver leaves."""
    true, made = play("surface"), play(SolidStimulus(solid(flat())))
    assert apart_mm(true, made) < 1e-3
    assert made.normal_force_n == pytest.approx(true.normal_force_n, rel=1e-3)


@pytest.mark.parametrize(("name", "mesh", "most_mm"), [("edge", edge, 0.1), ("sphere", ball, 0.15)])
def test_a_rounded_solid_is_what_it_is_a_mesh_of(play, name, mesh, most_mm):
    """An edge and a ball of 5 mm pass between the skin's vertices: without the probes the pins are 0.2 mm off, and a facet
    is 0.4 mm inside."""
    true, made = play(name), play(SolidStimulus(solid(mesh()), sharpest_m=0.5e-3 if name == "edge" else SPHERE_RADIUS_M))
    assert apart_mm(true, made) < most_mm
    assert made.normal_force_n == pytest.approx(true.normal_force_n, rel=0.03)
    assert made.overlap_m < QualityLimits().overlap_m
    assert made.penetration_m < max(QualityLimits().penetration_m, true.penetration_m)


def test_how_finely_a_solid_is_cut_does_not_matter(play):
    coarse, fine = play(SolidStimulus(solid(edge()))), play(SolidStimulus(solid(edge(), 2.0)))
    assert apart_mm(coarse, fine) < 0.02


def test_a_contact_with_a_solid_leaves_nothing_behind():
    player = ContactSimulator(load_design("tactip-127"), SolidStimulus(solid(edge())), fidelity_named("draft"))
    first = player.play(POSE, SHEAR)
    player.play(from_mm_deg([-2.0, 0, -4, 0, 0, 0]), np.zeros(6))
    assert np.array_equal(player.play(POSE, SHEAR).tips, first.tips)
