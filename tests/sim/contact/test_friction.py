"""Effects of friction along a path, and their absence without friction."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.benchmarks.physics import friction
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.slip_weakening import sliding
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact

MU = 0.3


@pytest.fixture(scope="module")
def orders():
    return {mu: friction.orders(mu) for mu in (0.0, MU)}


@pytest.mark.parametrize("order", ["press, then shear", "both at once"])
def test_order_of_motions_matters_only_with_friction(orders, order):
    """Without friction the result depends on the pose alone; with friction, also on the path."""
    ice, rubber = orders[0.0][order], orders[MU][order]
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert rubber["pins_mm"][0] > 0.2


@pytest.mark.slow
def test_unloading_loses_work_only_with_friction():
    ice, rubber = friction.unloading(0.0, step_mm=0.5), friction.unloading(MU, step_mm=0.5)
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert abs(ice["lost"]) < 0.002
    assert ice["lost"] < rubber["lost"] < 0.05
    assert rubber["force_ratio"] < ice["force_ratio"]


def test_shear_cycle_has_residual_and_work_only_with_friction():
    """Friction leaves a residual shear and dissipates work in each cycle; without it both vanish."""
    ice, rubber = friction.shear_cycle(0.0, reach_mm=1.5), friction.shear_cycle(MU, reach_mm=1.5)
    assert ice["residual_mm"][1] < 0.01
    assert rubber["residual_mm"][0] > 0.2
    assert np.abs(ice["work_mj"]).max() < 1e-3 * min(rubber["work_mj"])
    assert ice["greatest"] == 0
    assert 0.85 * MU < rubber["greatest"] <= MU * (1 + 1e-6)
    x, force = (np.array(rubber["loop"][k]) for k in ("x_mm", "force_n"))
    # The loop encloses at most the work of the maximum force over the whole path.
    assert 0 < rubber["work_mj"][1] < np.abs(force).max() * np.abs(np.diff(x)).sum()


@pytest.mark.parametrize("mu", [MU, pytest.param(0.6, marks=pytest.mark.slow)])
def test_force_at_rest_along_slide_is_constant_and_obeys_coulomb(mu):
    """The force of contacts at rest does not depend on their position along the slide."""
    travel, normal, tangential = friction.slide_at_rest(mu, 3.0)
    steady = travel > friction.SLIDE_MM / 2
    assert normal[steady].std() < 0.005 * normal[steady].mean()
    assert (tangential <= mu * normal * (1 + 1e-6)).all()
    assert (tangential[steady] > 0.85 * mu * normal[steady]).all()


@pytest.mark.parametrize("mu", [0.3, 0.6])
def test_slide_does_not_chatter(mu):
    """The force's standard deviation is below 5 % of its mean with the steps of `standard`.

    The depth is 2 mm, where a vertex carries least and chatters most.
    """
    assert friction.chatter(*friction.slide(mu, 2.0))["deviation"] < 0.05


def test_slide_without_friction_is_smooth():
    ice = friction.chatter(*friction.slide(0.0, 2.0))
    assert ice["deviation"] < 0.02
    assert ice["greatest"] == 0


def test_force_while_sliding_obeys_coulomb():
    travel, normal, tangential = friction.slide(MU, 3.0)
    assert (tangential <= MU * normal * (1 + 1e-6)).all()
    steady = travel > friction.SLIDE_MM / 2
    assert tangential[steady].mean() == pytest.approx(MU * normal[steady].mean(), rel=0.02)


# Slip weakening.

SHEARS_MM = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0])
"""Shears, mm, at which the force is measured; at the last one all of the skin has slid by more than a millimetre."""


def weakened(design, ratio):
    """Return the design with friction 0.6 that falls to `ratio` times as much over a slide of 1 mm."""
    return replace(design, materials=replace(design.materials, friction=0.6, kinetic_fraction=ratio, slip_weakening_m=1e-3))


def force_ratios(design, stimulus, fidelity, depth_mm=2.0):
    """Return the ratio of tangential to normal force at each of SHEARS_MM, and the last Contact."""
    simulator = ContactSimulator(design, stimulus, fidelity)
    pose, shear = from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), from_mm_deg([SHEARS_MM[-1], 0, 0, 0, 0, 0])
    contacts = list(simulator.simulate_partial_shears(pose, shear, SHEARS_MM / SHEARS_MM[-1]))
    assert all(c.violations(QualityLimits()) == [] for c in contacts)
    return np.array([c.tangential_force_n / c.normal_force_n for c in contacts]), contacts[-1]


@pytest.mark.parametrize("ratio", [0.4, 0.7])
def test_slid_skin_has_kinetic_friction(design, standard, ratio):
    """It sticks above the limit of kinetic friction; once all of it has slid, only kinetic friction remains."""
    force, _ = force_ratios(weakened(design, ratio), "surface", standard)
    assert force.max() > 1.2 * 0.6 * ratio
    assert force.max() <= 0.6 * (1 + 1e-6)
    assert (force[-2:] <= 0.6 * ratio * (1 + 1e-6)).all()
    assert (force[-2:] > 0.85 * 0.6 * ratio).all()


def test_kinetic_ratio_of_one_is_coulomb(design, standard):
    """With and without the computation of sliding distances."""
    almost, plain = (force_ratios(weakened(design, ratio), "surface", standard) for ratio in (1 - 1e-12, 1.0))
    # A slide doubles rounding errors at each step, so the results agree only to the error of its steps.
    assert np.allclose(almost[0], plain[0], atol=5e-3)
    assert almost[0][-1] > 0.85 * 0.6
    assert np.linalg.norm(almost[1].pin_tips - plain[1].pin_tips, axis=1).mean() < 0.03e-3


def test_facets_weaken_like_vertices(design, standard):
    """Facets touch a small ball, too, and no part of the skin keeps its static friction."""
    weak, _ = force_ratios(weakened(design, 0.4), "sphere", standard)
    full, _ = force_ratios(weakened(design, 1.0), "sphere", standard)
    # A few fresh facets enter the contact along the path, and the ball's flank pushes, so less is lost than on a plane.
    assert (full - weak)[SHEARS_MM >= 1].mean() > 0.2
    simulator = ContactSimulator(weakened(design, 0.4), "sphere", standard)
    simulator.simulate(from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([4, 0, 0, 0, 0, 0]))
    contacts = simulator.scene.data.contact
    facets = (contacts.elem >= 0).any(1) & (contacts.dist < 0)
    assert facets.any()
    assert contacts.friction[facets, 0].min() < 0.9 * 0.6


def test_contacts_stored_as_sliding_are_at_friction_limit(design, standard):
    """At every step, and no others: this test decides by forces, SlipWeakening by the solver's states."""
    simulator = ContactSimulator(weakened(design, 0.6), "surface", standard)
    scene, records, step = simulator.scene, [], simulator.scene.step

    def watched():
        step()
        contacts, forces = scene.data.contact, scene.data.efc_force
        rows = contacts.efc_address[:, None] + np.arange(3)
        normal, tangential = forces[rows[:, 0]], np.linalg.norm(forces[rows[:, 1:]], axis=1)
        fraction = tangential / np.maximum(contacts.friction[:, 0] * normal, 1e-12)
        records.append((sliding(scene.data), fraction, normal > 1e-5))

    scene.step = watched
    simulator.simulate(from_mm_deg([0, 0, -3, 5, 0, 0]), from_mm_deg([3, 0, 0, 0, 0, 0]))
    slides, fraction, presses = (np.concatenate(each) for each in zip(*records, strict=True))
    assert (fraction[slides] > 1 - 1e-6).all()
    assert (fraction[~slides & presses] < 1 - 1e-6).all()
    assert 0.2 < slides.mean() < 0.95


def test_sliding_distances_are_reset_when_tip_leaves(design, standard):
    """Skin that touches again sticks like fresh skin, as for single parts."""
    simulator = ContactSimulator(weakened(design, 0.5), "surface", standard)
    scene = simulator.scene
    simulator.simulate(from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([5, 0, 0, 0, 0, 0]))
    assert scene._slip._distance.max() > 1e-3
    simulator._place(inverse(sensor_in_contact(from_mm_deg([0, 0, 10, 0, 0, 0]))))
    scene.step()
    assert scene.data.nefc == scene.data.ne  # no contact, only the row that keeps the volume
    assert scene._slip._distance.max() == 0.0
    assert not scene._slip._sliding.any()


def test_sliding_distances_are_reset_between_contacts(design, standard):
    simulator = ContactSimulator(weakened(design, 0.5), "surface", standard)
    pose, shear = from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([1, 0, 0, 0, 0, 0])
    first = simulator.simulate(pose, shear)
    simulator.simulate(pose, 5 * shear)
    assert np.array_equal(simulator.simulate(pose, shear).pin_tips, first.pin_tips)


def test_weakened_slide_does_not_depend_on_step_size(design, standard):
    """Weakening depends on distances, so half the step gives the same."""
    half = replace(standard, motion=replace(standard.motion, shear_step_m=standard.motion.shear_step_m / 2))
    coarse, fine = (force_ratios(weakened(design, 0.5), "surface", f)[1] for f in (standard, half))
    assert np.linalg.norm(coarse.pin_tips - fine.pin_tips, axis=1).mean() < 0.05e-3
