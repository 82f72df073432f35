"""The patch of skin in contact: sticking skin has the shear that was commanded, sliding skin less."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.symmetry import SYMMETRIES, SymmetricReader
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact, to_mm_deg
from tactip_twin.tactip_model.presets import design_named

DESIGN = design_named("nominal-127")


def tip(task="surface", friction=0.6, fidelity="standard"):
    materials = replace(DESIGN.materials, friction=friction)
    return ContactSimulator(replace(DESIGN, materials=materials), task, fidelity_named(fidelity))


@pytest.fixture(scope="module")
def sticky():
    return tip(friction=0.9)


@pytest.fixture(scope="module")
def ordinary():
    return tip()


def press(simulator, pose, shear=(0, 0, 0, 0, 0, 0)):
    return simulator.simulate(from_mm_deg(pose), from_mm_deg(shear))


def test_centred_press_has_no_effective_shear(ordinary):
    contact = press(ordinary, [0, 0, -3, 0, 0, 0])
    assert np.abs(to_mm_deg(contact.effective_shear)).max() < 0.1
    assert not contact.effective_shear[[2, 3, 4]].any()


@pytest.mark.parametrize("shear", [(1, 0, 0, 0, 0, 0), (0, -1, 0, 0, 0, 0), (0.5, 0.5, 0, 0, 0, 0)])
@pytest.mark.parametrize("tilt", [(0, 0), (10, -8)])
def test_skin_that_sticks_has_the_commanded_shear(sticky, shear, tilt):
    pose = [0, 0, -4, *tilt, 0]
    unsheared, sheared = press(sticky, pose).effective_shear, press(sticky, pose, shear).effective_shear
    assert to_mm_deg(sheared - unsheared)[:2] == pytest.approx(shear[:2], abs=0.12)


def test_skin_that_sticks_has_the_commanded_twist(sticky):
    """The rim of the patch slides first."""
    contact = press(sticky, [0, 0, -4, 0, 0, 0], [0, 0, 0, 0, 0, 3])
    assert 2.4 < to_mm_deg(contact.effective_shear)[5] < 3.1


def test_skin_that_slides_keeps_a_shear_that_slip_does_not_increase(ordinary):
    small, large, larger = (press(ordinary, [0, 0, -2, 0, 0, 0], [x, 0, 0, 0, 0, 0]) for x in (0.3, 4, 5))
    assert small.slip_fraction < 0.5
    assert large.slip_fraction > 0.9 and larger.slip_fraction > 0.9
    assert large.effective_shear[0] < 0.6 * 4e-3
    assert larger.effective_shear[0] == pytest.approx(large.effective_shear[0], rel=0.05)


def test_skin_without_friction_slides_everywhere():
    contact = press(tip(friction=0.0, fidelity="draft"), [0, 0, -3, 0, 0, 0], [3, 0, 0, 0, 0, 0])
    assert contact.slip_fraction == 1.0
    assert abs(contact.effective_shear[0]) < 0.2e-3


def test_tip_without_contact_has_no_patch(ordinary):
    contact = press(ordinary, [0, 0, 1, 0, 0, 0])
    assert contact.contact_area_m2 == contact.slip_fraction == 0.0
    assert not contact.effective_shear.any() and not contact.force_n.any()


@pytest.mark.parametrize("depth_mm", [2.0, 4.0])
def test_area_is_that_of_the_flattened_skin(ordinary, depth_mm):
    """The circle of skin that lies on the surface, whose radius the vertices show."""
    contact = press(ordinary, [0, 0, -depth_mm, 0, 0, 0])
    scene = ordinary.scene
    skin = scene.vertices()[: scene.mesh.surface_count]
    height = skin[:, 2].max() - skin[:, 2]
    radius = np.hypot(*skin[:, :2].T)
    inner, outer = radius[height < 0.1e-3].max(), radius[height > 0.3e-3].min()
    assert 0.8 * np.pi * inner**2 < contact.contact_area_m2 < 1.3 * np.pi * outer**2


def test_force_is_the_same_in_both_frames(ordinary):
    contact = press(ordinary, [0, 0, -3, 8, -5, 0], [2, 1, 0, 0, 0, 0])
    in_contact = sensor_in_contact(contact.pose)[:3, :3] @ contact.force_n
    assert in_contact[2] == pytest.approx(contact.normal_force_n)
    assert np.hypot(*in_contact[:2]) == pytest.approx(contact.tangential_force_n)
    assert contact.force_n[2] < 0  # the object pushes the apex towards the housing


def test_edge_that_the_facets_touch_has_a_patch():
    contact = press(tip("edge"), [2, 0, -3, 0, 0, 0], [1, 0, 0, 0, 0, 0])
    assert 5e-6 < contact.contact_area_m2 < 4e-4
    assert 0.3e-3 < contact.effective_shear[0] < 1.2e-3


def test_symmetric_copies_have_their_own_force_and_effective_shear(ordinary):
    """A copy agrees with a contact that is simulated at the copy's pose, to the mesh's own asymmetry."""
    contact = press(ordinary, [0, 0, -4, 8, 3, 0], [1.5, -0.5, 0, 0, 0, 3])
    skin = ordinary.scene.vertices()[: ordinary.scene.mesh.surface_count]
    for copy in SymmetricReader(DESIGN, ordinary.scene.mesh, SYMMETRIES["surface"]).read(contact, skin):
        made = ordinary.simulate(copy.pose, copy.shear)
        assert copy.force_n == pytest.approx(made.force_n, abs=0.08)
        assert to_mm_deg(copy.effective_shear) == pytest.approx(to_mm_deg(made.effective_shear), abs=0.25)
