"""The row of the solver that keeps the gel's volume: its gradient, its stiffness, and what it does to a pressed tip."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.design import Materials
from tactip_twin.tactip_model.mesh import Resolution, tetrahedron_volumes
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.soft_body import gel_attributes, missing_bulk_modulus

POSE, SHEAR = from_mm_deg([0, 0, -3, 8, -5, 0]), from_mm_deg([2, 1, 0, 0, 0, 3])


def simulator(poisson=0.49, friction=0.6, **motion):
    design = design_named("nominal-127")
    fidelity = fidelity_named("draft")
    fidelity = replace(fidelity, motion=replace(fidelity.motion, **motion))
    return ContactSimulator(
        replace(design, materials=replace(design.materials, gel_poisson=poisson, friction=friction)), "surface", fidelity
    )


@pytest.fixture(scope="module")
def pressed():
    tip = simulator(settle_steps=60, settle_limit=60)
    tip.simulate(POSE, SHEAR)
    return tip


def volume(scene, vertices):
    return float(tetrahedron_volumes(vertices, scene.mesh.tetrahedra).sum())


def test_row_change_is_that_of_the_tetrahedra(pressed):
    scene = pressed.scene
    row = scene._volume
    row.linearize(scene.model, scene.vertices())
    change = volume(scene, scene.vertices()) - volume(scene, scene.mesh.vertices)
    assert row._change_m * row._area_m2 == pytest.approx(change, rel=1e-6)


def test_row_gradient_is_that_of_the_volume(pressed):
    scene, rng = pressed.scene, np.random.default_rng(0)
    row, vertices = scene._volume, scene.vertices()
    step = np.where(scene.mesh.bonded[:, None], 0.0, rng.normal(size=vertices.shape)) * 1e-7
    row.linearize(scene.model, vertices)
    free_skin = ~scene.mesh.bonded[: scene.mesh.surface_count]
    expected = row._gradient @ step[: scene.mesh.surface_count][free_skin].ravel() * row._area_m2
    difference = volume(scene, vertices + step) - volume(scene, vertices - step)
    assert difference == pytest.approx(2 * expected, rel=1e-4)


def test_pressure_at_rest_is_missing_bulk_modulus_times_relative_loss(pressed):
    scene = pressed.scene
    row, materials = scene._volume, scene.design.materials
    change = volume(scene, scene.vertices()) - volume(scene, scene.mesh.vertices)
    pressure = -missing_bulk_modulus(materials, scene.fidelity.mesh) * change / scene.mesh.volumes.sum()
    row.linearize(scene.model, scene.vertices())
    on_skin = row.forces(scene.data)
    # The row's force on a vertex is the pressure times the vertex's part of the area.
    expected = pressure * row._area_m2 * row._gradient.reshape(-1, 3)
    assert pressure > 500
    assert np.allclose(on_skin[: len(expected)], expected, rtol=0.01, atol=1e-6)
    assert not on_skin[len(expected) :].any()


def test_tip_at_rest_does_not_depend_on_time_step():
    """The row is stiffer by four at half the step, and the tip comes to rest at the same place."""
    tips = []
    for step_s in (7e-3, 3.5e-3):
        tip = simulator(friction=0.0, step_s=step_s, shear_step_m=0.5e-3, settle_steps=80, settle_limit=80)
        contact = tip.simulate(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6))
        tips.append((contact.pin_tips, contact.normal_force_n))
    assert np.abs(tips[0][0] - tips[1][0]).max() < 0.01e-3
    assert tips[0][1] == pytest.approx(tips[1][1], rel=2e-3)


def test_lost_volume_falls_with_bulk_modulus():
    """From a Poisson's ratio of 0.49 to 0.499, the bulk modulus rises tenfold."""
    lost = []
    for poisson in (0.49, 0.499):
        scene = simulator(poisson)
        scene.simulate(from_mm_deg([0, 0, -4, 0, 0, 0]), np.zeros(6))
        scene = scene.scene
        lost.append(1 - volume(scene, scene.vertices()) / volume(scene, scene.mesh.vertices))
    assert lost[0] == pytest.approx(0.0085, rel=0.15)
    assert lost[0] / lost[1] == pytest.approx(10, rel=0.3)


def test_gel_that_its_elements_bear_has_no_row():
    tip = simulator(0.3)
    assert tip.scene._volume is None and tip.scene.model.neq == 0
    assert tip.simulate(POSE, np.zeros(6)).normal_force_n > 0.5


@pytest.mark.parametrize("poisson", [0.2, 0.4, 0.45, 0.49, 0.499])
def test_elements_and_row_have_the_moduli_of_the_gel(poisson):
    materials, resolution = Materials(gel_poisson=poisson), Resolution()
    element = gel_attributes(materials, resolution)
    shear = element["young"] / (2 * (1 + element["poisson"]))
    bulk = element["young"] / (3 * (1 - 2 * element["poisson"]))
    assert shear == pytest.approx(materials.gel_young_pa / (2 * (1 + poisson)), rel=1e-12)
    whole = bulk + missing_bulk_modulus(materials, resolution)
    assert whole == pytest.approx(materials.gel_young_pa / (3 * (1 - 2 * poisson)), rel=1e-12)
