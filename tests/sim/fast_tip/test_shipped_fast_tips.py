"""Shipped learned tips against contacts that are simulated here."""

import dataclasses

import numpy as np
import pytest

from tactip_twin.assets import FAST_TIPS
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.labels import TASKS
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

MAX_MM = {"surface": 0.08, "edge": 0.15}
"""Mean distance of pins over contacts of another seed: about three times the mean of docs/fast_tip.md."""

ROUNDS = {"surface": 1, "edge": 3}
"""Number of times that five contacts are drawn. On edges, the mean over five depends on whether the worst is trusted."""


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", ["tactip-127", "tactip-331"])
def test_shipped_tip_predicts_contacts_of_another_seed(task, name):
    """The sensor of 331 pins has no learned tip of its own: it is that of any materials."""
    design, path = design_named(name), shipped_fast_tip(task, name)
    assert path.stat().st_size < 5_000_000
    tip = read_fast_tip(path)
    rng = np.random.default_rng(3)
    poses, shears = np.zeros((0, 6)), np.zeros((0, 6))
    for _ in range(ROUNDS[task]):
        poses = np.concatenate([poses, [POSE_RANGES[task].sample(rng) for _ in range(5)]])
        shears = np.concatenate([shears, [SHEAR_RANGES.sample(rng) for _ in range(5)]])
    contacts, trusted = FastContacts(tip, design).predict(poses, shears)
    simulator = ContactSimulator(design, task, fidelity_named("standard"))
    distance, forces = [], []
    for contact, pose, shear in zip(contacts, poses, shears, strict=True):
        true = simulator.simulate(pose, shear)
        distance.append(1e3 * np.linalg.norm(contact.pin_tips - true.pin_tips, axis=1).mean())
        forces.append((contact.force_n, true.force_n))
    assert trusted.mean() > 0.5
    assert np.mean(np.array(distance)[trusted]) < MAX_MM[task]
    found, true = np.array(forces)[trusted].swapaxes(0, 1)
    assert np.linalg.norm(found - true, axis=1).sum() < 0.1 * np.linalg.norm(true, axis=1).sum()


def test_tip_of_any_materials_refuses_what_it_does_not_know():
    tip, design = read_fast_tip(any_materials("surface")), design_named("tactip-127")
    slippery = dataclasses.replace(design, materials=dataclasses.replace(design.materials, friction=0.1))
    with pytest.raises(TactipError, match=r"knows a friction from 0\.38\d+ to 1\.2\d+, but the design has 0\.1"):
        tip.check_design(slippery)
    smaller = dataclasses.replace(design, shape=dataclasses.replace(design.shape, cylinder_m=5e-3))
    with pytest.raises(TactipError, match=r"belongs to shape\.cylinder_m 0\.0, but the design has 0\.005"):
        tip.check_design(smaller)


def test_force_of_the_tip_of_any_materials_scales_with_both_moduli():
    tip, design = read_fast_tip(any_materials("surface")), design_named("tactip-127")
    m = design.materials
    twice = dataclasses.replace(m, skin_young_pa=2 * m.skin_young_pa, gel_young_pa=2 * m.gel_young_pa)
    pose, shear = np.array([[0, 0, -3e-3, 0.1, 0, 0]]), np.array([[2e-3, 0, 0, 0, 0, 0]])
    soft, stiff = (
        FastContacts(tip, d).predict(pose, shear)[0][0] for d in (design, dataclasses.replace(design, materials=twice))
    )
    assert np.allclose(stiff.force_n, 2 * soft.force_n, rtol=1e-6)
    assert np.allclose(stiff.pin_tips, soft.pin_tips, atol=1e-9)


@pytest.mark.parametrize("task", TASKS)
def test_other_designs_and_randomized_ones_get_the_tip_of_any_materials(task):
    assert shipped_fast_tip(task, "mine") == shipped_fast_tip(task, "tactip-127", randomized=True) == any_materials(task)
    assert read_fast_tip(any_materials(task)).materials is not None
    assert shipped_fast_tip(task, "tactip-127").stem == f"{task}-tactip-127"
    assert {path.suffix for path in FAST_TIPS.iterdir()} == {".npz"}
