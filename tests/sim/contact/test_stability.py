"""Good records or rejections with a reason, on stiff and extreme contacts, and every check can fail."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactip_twin.benchmarks.physics import stability
from tactip_twin.sim.contact import stimuli
from tactip_twin.sim.contact.fidelity import fidelity_named, finer
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.retries import UNCONFIRMED, RetryingSimulator
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.stimuli import STIMULI
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.tactip_model.design import Design, Materials
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M


def press(simulator, depth_mm, slide_mm=0.0, **options):
    return simulator.simulate(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), from_mm_deg([slide_mm, 0, 0, 0, 0, 0]), **options)


@pytest.fixture(scope="module")
def good(on_surface):
    contact = on_surface([0, 0, -3, 0, 0, 0], [1, 0, 0, 0, 0, 0])
    assert contact.violations(QualityLimits()) == []
    return contact


# Records: each check can fail, and measures the named quantity.


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"normal_force_n": float("nan")}, "not finite"),
        ({"overlap_m": float("inf")}, "not finite"),
        ({"volume_ratio": -0.2}, "shrank"),
        ({"penetration_m": 0.06e-3}, "inside the skin"),
        ({"overlap_m": 0.2e-3}, "overlap"),
        ({"speed_m_s": 0.03}, "still moves"),
        ({"imbalance": 0.6}, "not balanced"),
        ({"energy_drift_m_s": 0.01}, "drifts"),
        ({"area_ratio": 0.05}, "facet"),
        ({"fold_rad": 3.0}, "folded"),
        ({"unconverged_fraction": 0.5}, "iterations"),
    ],
)
def test_faults_of_bad_record_name_the_check(good, change, word):
    (fault,) = replace(good, **change).violations(QualityLimits())
    assert word in fault


@pytest.mark.parametrize("name", ["surface", "edge", "needle"])
def test_overlap_of_undeformed_tip_is_exact(design, standard, name):
    """At 2 mm depth it is 2 mm, less the depth of the mesh's facets inside the sphere."""
    scene = Scene(design, name, standard)
    overlap = scene.overlap(sensor_in_contact(from_mm_deg([0, 0, -2, 0, 0, 0])))
    depth = {"surface": 2e-3, "edge": 2e-3, "needle": stimuli.NEEDLE_RADIUS_M + CONTACT_RADIUS_M}[name]
    assert depth - 0.2e-3 < overlap < depth + 1e-6
    assert scene.overlap(sensor_in_contact(from_mm_deg([0, 0, 1, 0, 0, 0]))) == 0.0


def test_skin_shape_measures_folds_and_shrunk_facets(on_surface):
    scene = on_surface.simulator.scene
    rest = scene.mesh.vertices
    area, fold = scene.skin_shape(rest)
    assert area == pytest.approx(1.0)
    assert fold < np.radians(30)
    apex = int(rest[: scene.mesh.surface_count, 2].argmax())
    around = np.unique(scene.mesh.triangles[(scene.mesh.triangles == apex).any(1)])
    facet = scene.mesh.triangles[(scene.mesh.triangles == apex).any(1)][0]
    opposite = rest[facet[facet != apex]].mean(0)
    folded = rest.copy()
    folded[apex] = 2 * opposite - rest[apex]  # over the edge, onto the next facet
    assert scene.skin_shape(folded)[1] > QualityLimits().fold_rad
    squashed = rest.copy()
    squashed[around] = squashed[apex] + 0.1 * (squashed[around] - squashed[apex])
    assert scene.skin_shape(squashed)[0] < 0.05


def test_record_of_moving_tip_has_energy_drift(design, standard, monkeypatch):
    """In a press recorded in motion, elastic energy is still being stored."""
    jerky = replace(standard, motion=replace(standard.motion, ease_in=0.0, ease_out=0.0))
    simulator = ContactSimulator(design, "surface", jerky)
    assert not press(simulator, 3).violations(QualityLimits())
    monkeypatch.setattr(ContactSimulator, "_settle", lambda self, pose: None)
    assert any("drifts" in fault for fault in press(simulator, 3).violations(QualityLimits()))


def test_record_shows_solver_at_iteration_limit(design, standard):
    simulator = ContactSimulator(design, "surface", standard)
    simulator.scene.model.opt.iterations = 10
    contact = press(simulator, 3, 2)
    assert contact.unconverged_fraction > 0.5
    assert any("iterations" in fault for fault in contact.violations(QualityLimits()))


# Materials and steps.


@pytest.mark.parametrize("scale", [0.05, 50.0])
def test_force_scales_with_all_moduli(design, standard, good, scale):
    """With all moduli scaled, the shape is the same and the force scales, because contact stiffness does, too."""
    m = design.materials
    other = replace(m, skin_young_pa=scale * m.skin_young_pa, gel_young_pa=scale * m.gel_young_pa)
    contact = press(ContactSimulator(replace(design, materials=other), "surface", standard), 3, 1)
    assert contact.violations(QualityLimits()) == []
    assert contact.normal_force_n == pytest.approx(scale * good.normal_force_n, rel=0.01)
    assert np.linalg.norm(contact.pin_tips - good.pin_tips, axis=1).max() < 0.05e-3


@pytest.mark.parametrize(
    "materials",
    [
        {"skin_young_pa": 1e3, "gel_young_pa": 1e3},
        {"skin_young_pa": 1e8, "gel_young_pa": 1e6},
        {"skin_young_pa": 1e3, "gel_young_pa": 1e6},
        {"gel_poisson": 0.499, "skin_poisson": 0.0},
        {"density_kg_m3": 10500.0, "damping_s": 2e-3},
    ],
)
def test_extreme_materials_converge(materials):
    result = stability.judge(stability.Cell("", "", "", slide_mm=2, materials=materials), fidelity_named("standard"))
    assert result["verdict"] in ("converged", "after refinement"), result["reasons"]


@pytest.mark.parametrize("name", ["needle", "edge", "hole", "sphere"])
def test_start_inside_non_flat_stimulus_raises_error(design, standard, name):
    with pytest.raises(TactipError, match=r"approach must be True .*, got False"):
        press(ContactSimulator(design, name, standard), 1, approach=False)


def test_start_inside_plane_equals_approach(design, standard):
    simulator = RetryingSimulator(design, "surface", standard, QualityLimits())
    contact, violations = press(simulator, 1, approach=False)
    assert len(violations) < simulator.tries
    approached, _ = press(simulator, 1)
    assert contact.normal_force_n == pytest.approx(approached.normal_force_n, rel=0.05)


@pytest.mark.slow
def test_snagging_stimulus_needs_agreement_of_two_steps(design, standard):
    """Neither a single good record nor two that differ suffice."""
    simulator = RetryingSimulator(design, "knife", standard, QualityLimits())
    contact, violations = press(simulator, 1, 3)
    assert violations[-1] == [UNCONFIRMED]
    assert len(violations) < simulator.tries
    again = ContactSimulator(design, "knife", finer(simulator._simulator(len(violations)).scene.fidelity))
    apart = np.linalg.norm(press(again, 1, 3).pin_tips - contact.pin_tips, axis=1)
    assert np.sqrt(np.mean(apart**2)) < QualityLimits().disagreement_m
    _, violations = press(RetryingSimulator(design, "knife", standard, QualityLimits(disagreement_m=1e-9)), 1, 3)
    assert len(violations) == simulator.tries
    assert "halving the step moves the pins by" in violations[-1][0]


def test_good_records_around_bad_one_do_not_confirm(design, monkeypatch, good):
    """Their steps differ by a factor of four, and the bad record between them cannot serve as the coarser one."""
    bad = replace(good, penetration_m=1e-3)
    simulator = RetryingSimulator(design, "knife", fidelity_named("draft"), QualityLimits())
    script = iter([good, bad, good, good])
    monkeypatch.setattr(ContactSimulator, "simulate", lambda *_: next(script))
    contact, violations = simulator.simulate(good.pose, good.shear)
    assert contact is good
    assert [f == [UNCONFIRMED] for f in violations] == [True, False, True]
    assert simulator._slider is simulator._simulators[2] and simulator.last is simulator._simulators[3]


def test_skin_that_slides_on_does_not_confirm(design, monkeypatch, good):
    """A point at a friction of 1: two records agree, and the tip is 0.7 mm away with half the step."""
    simulator = RetryingSimulator(design, "corner", fidelity_named("draft"), QualityLimits())
    settling = iter([21, 21, 3, 6])

    def simulate(self, *_):
        self.settled_steps = next(settling) * 2 ** simulator._simulators.index(self)
        return good

    monkeypatch.setattr(ContactSimulator, "simulate", simulate)
    _, violations = simulator.simulate(good.pose, good.shear)
    assert violations[0] == ["the skin slid on for 147 ms after the object had stopped (allowed: 84 ms)"]
    assert violations[2:] == [[UNCONFIRMED]]


@pytest.mark.parametrize(
    ("name", "friction", "tries"),
    [("surface", 1.0, 3), ("surface", 1.1, 4), ("sphere", 0.9, 3), ("sphere", 1.0, 4), ("corner", 0.3, 4)],
)
def test_high_friction_and_sharp_stimuli_need_one_more_try(design, name, friction, tries):
    rough = replace(design, materials=replace(design.materials, friction=friction))
    assert RetryingSimulator(rough, name, fidelity_named("draft"), QualityLimits()).tries == tries


@settings(max_examples=4, suppress_health_check=[HealthCheck.too_slow])
@given(
    skin=st.floats(1, 8),
    gel=st.floats(3, 6),
    poisson=st.tuples(st.floats(0, 0.499), st.floats(0, 0.499)),
    friction=st.floats(0, 2.1),
    density=st.floats(105, 10500),
    name=st.sampled_from(list(STIMULI)),
    depth=st.floats(0.2, 8),
    slide=st.floats(0, 3),
)
def test_any_configuration_is_rejected_or_good(skin, gel, poisson, friction, density, name, depth, slide):
    try:
        materials = Materials(
            skin_young_pa=10**skin,
            gel_young_pa=10**gel,
            skin_poisson=poisson[0],
            gel_poisson=poisson[1],
            friction=friction,
            density_kg_m3=density,
        )
        simulator = RetryingSimulator(Design("any", materials=materials), name, fidelity_named("draft"), QualityLimits())
        contact, violations = press(simulator, depth, slide)
    except TactipError as error:  # a needle must not be pressed deeper than 5 mm
        assert "must be" in str(error)
        return
    if len(violations) == simulator.tries:
        assert all(violations)
        return
    assert np.isfinite(contact.pin_tips).all() and np.isfinite(contact.directions).all()
    assert contact.volume_ratio > 0
    assert contact.penetration_m <= QualityLimits().penetration_m
    assert contact.normal_force_n > -1e-6


@pytest.mark.parametrize("away", [1e200, float("nan"), 10.0])
def test_overlap_of_diverged_state_is_infinite(design, standard, away):
    """It is not sampled, because its facets are too large for any number of samples."""
    scene = Scene(design, "edge", standard)
    scene.reset()
    scene.data.qpos[7 + 30] = away
    assert scene.overlap(sensor_in_contact(np.zeros(6))) == np.inf
