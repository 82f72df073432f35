"""What friction must do along a path, and what must not happen without it."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.benchmarks.physics import friction
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact

MU = 0.3


@pytest.fixture(scope="module")
def orders():
    return {mu: friction.orders(mu) for mu in (0.0, MU)}


@pytest.mark.parametrize("order", ["press, then shear", "both at once"])
def test_order_of_motions(orders, order):
    """Without friction only where the tip is counts; with it, how it came there."""
    ice, rubber = orders[0.0][order], orders[MU][order]
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert rubber["pins_mm"][0] > 0.2


def test_unloading():
    ice, rubber = friction.unloading(0.0), friction.unloading(MU)
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert abs(ice["lost"]) < 0.002
    assert ice["lost"] < rubber["lost"] < 0.05
    assert rubber["force_ratio"] < ice["force_ratio"]


def test_shear_cycle():
    """Friction keeps a part of the shear and takes work from each cycle; without it nothing is kept or taken."""
    ice, rubber = friction.shear_cycle(0.0), friction.shear_cycle(MU)
    assert ice["residual_mm"][1] < 0.01
    assert rubber["residual_mm"][0] > 0.2
    assert np.abs(ice["work_mj"]).max() < 1e-3 * min(rubber["work_mj"])
    assert ice["greatest"] == 0
    assert 0.85 * MU < rubber["greatest"] <= MU * (1 + 1e-6)
    x, force = (np.array(rubber["loop"][k]) for k in ("x_mm", "force_n"))
    # The loop cannot enclose more than friction at its limit would, all the way there and back.
    assert 0 < rubber["work_mj"][1] < np.abs(force).max() * np.abs(np.diff(x)).sum()


@pytest.mark.parametrize("mu", [MU, pytest.param(0.6, marks=pytest.mark.slow)])
def test_force_along_a_slide(mu):
    """Contacts at rest: their force does not depend on where along the slide they are, and obeys Coulomb."""
    travel, normal, tangential = friction.slide_at_rest(mu, 3.0)
    steady = travel > friction.SLIDE_MM / 2
    assert normal[steady].std() < 0.005 * normal[steady].mean()
    assert (tangential <= mu * normal * (1 + 1e-6)).all()
    assert (tangential[steady] > 0.85 * mu * normal[steady]).all()


@pytest.mark.parametrize("mu", [0.3, 0.6])
def test_slides_do_not_chatter(mu):
    """The force's standard deviation is below 5 % of its mean, at `standard`'s own steps.

    At 2 mm, where a vertex carries least and chatters most.
    """
    assert friction.chatter(*friction.slide(mu, 2.0))["deviation"] < 0.05


def test_slides_on_ice_are_smooth():
    ice = friction.chatter(*friction.slide(0.0, 2.0))
    assert ice["deviation"] < 0.02
    assert ice["greatest"] == 0


def test_force_while_sliding_obeys_coulomb():
    travel, normal, tangential = friction.slide(MU, 3.0)
    assert (tangential <= MU * normal * (1 + 1e-6)).all()
    steady = travel > friction.SLIDE_MM / 2
    assert tangential[steady].mean() == pytest.approx(MU * normal[steady].mean(), rel=0.02)


# Friction that falls where the skin has slid.

WAYS = np.array([0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0])
"""Shear, mm, at which the force is looked at; at the end all of the skin has slid by more than a millimetre."""


def slippery(design, share):
    """The design with that share of 0.6 left after a slide of 1 mm."""
    return replace(design, materials=replace(design.materials, friction=0.6, kinetic_share=share, kinetic_after_m=1e-3))


def held(design, stimulus, fidelity, depth_mm=2.0):
    """Tangential over normal force at each of WAYS, and the last Contact."""
    player = ContactSimulator(design, stimulus, fidelity)
    pose, shear = from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), from_mm_deg([WAYS[-1], 0, 0, 0, 0, 0])
    contacts = list(player.stages(pose, shear, WAYS / WAYS[-1]))
    assert all(c.faults(QualityLimits()) == [] for c in contacts)
    return np.array([c.tangential_force_n / c.normal_force_n for c in contacts]), contacts[-1]


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_skin_that_has_slid_holds_less(design, standard, share):
    """It sticks up to more than kinetic friction can hold; once all of it has slid, kinetic friction is what is left."""
    ratio, _ = held(slippery(design, share), "surface", standard)
    assert ratio.max() > 1.2 * 0.6 * share
    assert ratio.max() <= 0.6 * (1 + 1e-6)
    assert (ratio[-2:] <= 0.6 * share * (1 + 1e-6)).all()
    assert (ratio[-2:] > 0.85 * 0.6 * share).all()


def test_a_share_of_one_is_coulomb(design, standard):
    """Whether slides are remembered or not."""
    almost, plain = (held(slippery(design, share), "surface", standard) for share in (1 - 1e-12, 1.0))
    # A slide doubles rounding errors at each step: it is the same to what its steps are worth.
    assert np.allclose(almost[0], plain[0], atol=5e-3)
    assert almost[0][-1] > 0.85 * 0.6
    assert np.linalg.norm(almost[1].tips - plain[1].tips, axis=1).mean() < 0.03e-3


def test_facets_slide_like_vertices(design, standard):
    """A small ball is met by facets, too: there is no part of the skin that keeps its static friction."""
    ratio, _ = held(slippery(design, 0.4), "sphere", standard)
    whole, _ = held(slippery(design, 1.0), "sphere", standard)
    # What enters the contact along the way is fresh, a few facets at a time, and the ball's flank pushes: less is lost than
    # on the flat, and not everywhere.
    assert (whole - ratio)[WAYS >= 1].mean() > 0.2
    player = ContactSimulator(slippery(design, 0.4), "sphere", standard)
    player.play(from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([4, 0, 0, 0, 0, 0]))
    contacts = player.scene.data.contact
    facets = (contacts.elem >= 0).any(1) & (contacts.dist < 0)
    assert facets.any()
    assert contacts.friction[facets, 0].min() < 0.9 * 0.6


def test_what_is_noted_as_sliding_is_at_the_edge_of_its_cone(design, standard):
    """At every step, and nothing else is: who slides is told by forces here, and by the solver's states there."""
    player = ContactSimulator(slippery(design, 0.6), "surface", standard)
    scene, told, step = player.scene, [], player.scene.step

    def watched():
        step()
        contacts, forces = scene.data.contact, scene.data.efc_force
        rows = contacts.efc_address[:, None] + np.arange(3)
        normal, held = forces[rows[:, 0]], np.linalg.norm(forces[rows[:, 1:]], axis=1)
        share = held / np.maximum(contacts.friction[:, 0] * normal, 1e-12)
        told.append((scene._slip.slides(scene.data), share, normal > 1e-5))

    scene.step = watched
    player.play(from_mm_deg([0, 0, -3, 5, 0, 0]), from_mm_deg([3, 0, 0, 0, 0, 0]))
    slides, share, presses = (np.concatenate(each) for each in zip(*told, strict=True))
    assert (share[slides] > 1 - 1e-6).all()
    assert (share[~slides & presses] < 1 - 1e-6).all()
    assert 0.2 < slides.mean() < 0.95


def test_slides_are_forgotten_where_the_whole_tip_leaves(design, standard):
    """As they are part by part: skin that comes back sticks as fresh skin does."""
    player = ContactSimulator(slippery(design, 0.5), "surface", standard)
    scene = player.scene
    player.play(from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([5, 0, 0, 0, 0, 0]))
    assert scene._slip._distance.max() > 1e-3
    player._place(inverse(sensor_in_contact(from_mm_deg([0, 0, 10, 0, 0, 0]))))
    scene.step()
    assert scene.data.nefc == 0
    assert scene._slip._distance.max() == 0.0
    assert not scene._slip._slides.any()


def test_slides_are_forgotten_between_contacts(design, standard):
    player = ContactSimulator(slippery(design, 0.5), "surface", standard)
    pose, shear = from_mm_deg([0, 0, -2, 0, 0, 0]), from_mm_deg([1, 0, 0, 0, 0, 0])
    first = player.play(pose, shear)
    player.play(pose, 5 * shear)
    assert np.array_equal(player.play(pose, shear).tips, first.tips)


def test_what_a_slide_leaves_does_not_depend_on_its_steps(design, standard):
    """It depends on ways, so that half the steps give the same."""
    half = replace(standard, motion=replace(standard.motion, shear_step_m=standard.motion.shear_step_m / 2))
    coarse, fine = (held(slippery(design, 0.5), "surface", f)[1] for f in (standard, half))
    assert np.linalg.norm(coarse.tips - fine.tips, axis=1).mean() < 0.05e-3
