"""Gel and skin against closed forms; the same tetrahedra in other codes."""

import numpy as np
import pytest

from tactip_twin.benchmarks.physics import fem_cross_check, materials
from tactip_twin.benchmarks.physics.fem_tetrahedra import Solid, piola
from tactip_twin.benchmarks.physics.materials import LAWS, PATCHES, POISSONS, Specimen
from tactip_twin.sim.contact.fidelity import FIDELITIES
from tactip_twin.tactip_model.design import Materials

SKIN = Materials()


@pytest.mark.parametrize("law", LAWS)
def test_single_element_has_the_stress_of_its_law(law):
    """At random gradients, including one that turns the element inside out."""
    vertices = 1e-2 * np.array([[0, 0, 0], [1.1, 0.1, 0], [0.2, 0.9, 0.1], [0.1, 0.2, 1.0]])
    edges = (vertices[1:] - vertices[0]).T
    specimen = Specimen(vertices, np.array([[0, 1, 2, 3]]), materials.gel(0.45, law), np.ones((4, 3), bool))
    rng = np.random.default_rng(0)
    for size in (0.01, 0.1, 0.4, 0.8):
        gradient = np.eye(3) + size * rng.normal(size=(3, 3))
        force = specimen.forces(vertices @ gradient.T)
        stress = -force[1:].T @ edges.T * 6 / np.linalg.det(edges)
        expected = piola(law, 2e4, 0.45, gradient)
        assert np.abs(stress - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("patch", PATCHES)
def test_patch(law, patch):
    assert materials.patch_error(law, PATCHES[patch]) < 1e-7


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("poisson", POISSONS)
def test_bar_in_tension_and_compression(law, poisson):
    ratios, sides = materials.bar_ratios(law, poisson)
    assert min(ratios) < 0.7 and max(ratios) > 1.3
    assert list(ratios.values()) == pytest.approx([1.0] * len(ratios), rel=1e-5)
    assert sides < 1e-5


@pytest.mark.parametrize("law", LAWS)
def test_bar_closed_form_has_no_stress_on_its_sides(law):
    for stretch in materials.STRETCHES[law]:
        stress, side = materials.bar_stress(law, 2e4, 0.45, stretch)
        tensor = piola(law, 2e4, 0.45, np.diag([stretch, side, side]))
        assert tensor == pytest.approx(np.diag([stress, 0, 0]), abs=1e-6)


@pytest.mark.parametrize("law", ["stable neo-Hooke", "St Venant-Kirchhoff", "split neo-Hooke"])
def test_small_strains_are_hookes(law):
    """Modulus and Poisson's ratio of each law, by a strain of a millionth."""
    strain = 1e-6
    stress = piola(law, 2e4, 0.45, np.diag([1 + strain, 1 - 0.45 * strain, 1 - 0.45 * strain]))
    assert stress == pytest.approx(np.diag([2e4 * strain, 0, 0]), abs=2e4 * strain * 1e-4)


def test_strip_of_skin():
    ratios = materials.strip_ratios(SKIN)
    assert list(ratios.values()) == pytest.approx([1.0] * len(ratios), rel=1e-5)


def test_skin_bent_to_a_cylinder_has_the_rigidity_of_a_plate():
    """The triangles' hinges ignore Poisson's ratio, so half the moment bends the skin to a dome (docs/materials.md)."""
    ratios = materials.curving_ratios(SKIN, 1e-3, "equilateral")
    assert ratios["cylinder"] == pytest.approx(1, abs=0.03)
    assert ratios["sphere"] == pytest.approx((4 / 3) / (2 * (1 + SKIN.skin_poisson)), rel=0.05)


@pytest.mark.parametrize("lattice", ["spiral", "equilateral"])
def test_clamped_plate(lattice):
    assert materials.clamped_plate_ratio(SKIN, 1e-3, lattice) == pytest.approx(1, abs=0.12)


def test_cantilever_of_skin():
    assert materials.cantilever_ratio(SKIN, 1.5e-3) == pytest.approx(1, abs=0.1)


def test_dome_of_skin_under_a_point_load():
    """Within 8 % of Reissner's shell, and nearly at rest as built."""
    ratio, unloaded = materials.dome_ratio(SKIN, FIDELITIES["standard"].mesh)
    assert ratio == pytest.approx(1, abs=0.08)
    assert unloaded < 0.01e-3


def test_independent_tetrahedra_against_the_closed_form():
    size = np.array([8e-3, 4e-3, 4e-3])
    vertices, tetrahedra = materials.block((4, 2, 2), size)
    right = vertices[:, 0] > size[0] - 1e-9
    held = vertices < 1e-9
    held[right, 0] = True
    solid = Solid(vertices, tetrahedra, "stable neo-Hooke", 2e4, 0.47)
    moved = solid.solve(held, np.where(right[:, None], [0.6 * size[0], 0, 0], 0))
    stress, _ = materials.bar_stress("stable neo-Hooke", 2e4, 0.47, 1.6)
    assert solid.forces(moved)[right, 0].sum() == pytest.approx(stress * size[1] * size[2], rel=1e-8)


@pytest.mark.parametrize("depth_mm", [1.0, 3.0])
def test_pressed_gel_in_an_independent_code(depth_mm):
    """A contact as for data sets: the free surface agrees within 8 µm, the force within 0.5 %."""
    row = fem_cross_check.compare_simulator(depth_mm)
    assert row["of_mm"] > 0.9 * depth_mm
    assert row["greatest_mm"] < 0.008
    assert row["force_ratio"] == pytest.approx(1, abs=0.005)


@pytest.mark.skipif(fem_cross_check.calculix() is None, reason="CalculiX is not installed (Debian: calculix-ccx)")
@pytest.mark.parametrize(("depth_mm", "law"), [(2.0, "St Venant-Kirchhoff"), (3.0, "split neo-Hooke")])
def test_pressed_gel_in_calculix(depth_mm, law, tmp_path):
    for row in fem_cross_check.compare_codes(depth_mm, law, tmp_path):
        assert row["of_mm"] > 0.9 * depth_mm
        assert row["greatest_mm"] < 1e-4
        assert row["force_ratio"] == pytest.approx(1, abs=1e-4)
