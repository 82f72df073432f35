"""A learned tip as the start of another's training predicts, at first, what it predicted before."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactip_twin.learning.fast_tip_start import perceptron_of, started_from
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import FAST_TIPS, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.labels import Task
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

DESIGN = design_named("tactip-127")


def contacts(task: Task, count: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    poses = np.array([POSE_RANGES[task].sample(rng) for _ in range(count)])
    return poses, np.array([SHEAR_RANGES.sample(rng) for _ in range(count)])


def check_equal(one, other):
    for a, b in zip(one, other, strict=True):
        assert np.allclose(a.pin_tips, b.pin_tips, atol=1e-8)
        assert np.allclose(a.force_n, b.force_n, rtol=1e-4, atol=1e-6)


def test_tip_of_one_design_gets_materials_that_have_no_effect():
    tip, (poses, shears) = read_fast_tip(shipped_fast_tip("edge", "tactip-127")), contacts("edge")
    designs = [MECHANICS_RANDOMIZATIONS["wide"].sample(DESIGN, np.random.default_rng(k)) for k in range(20)]
    start = started_from(tip, "edge", DESIGN, np.array([material_inputs(design.materials) for design in designs]))
    before, _ = FastContacts(tip, DESIGN).predict(poses, shears)
    check_equal(before, FastContacts(start, DESIGN).predict(poses, shears)[0])
    slippery = replace(DESIGN, materials=replace(DESIGN.materials, friction=0.5))
    check_equal(before, FastContacts(start, slippery).predict(poses, shears)[0])


def test_tip_of_any_materials_keeps_those_of_a_design():
    tip, (poses, shears) = read_fast_tip(FAST_TIPS / "surface-any-materials.npz"), contacts("surface")
    start = started_from(tip, "surface", DESIGN, None)
    assert start.materials is None and start.mechanics["materials"]["friction"] == DESIGN.materials.friction
    before, _ = FastContacts(tip, DESIGN).predict(poses, shears)
    check_equal(before, FastContacts(start, DESIGN).predict(poses, shears)[0])


def test_network_for_training_is_that_of_the_file():
    network = read_fast_tip(shipped_fast_tip("edge", "tactip-127")).networks[0]
    x = np.random.default_rng(0).normal(size=(20, network.weights[0].shape[1])).astype(np.float32)
    assert np.allclose(perceptron_of(network)(torch.tensor(x)).detach().numpy(), network(x), atol=1e-4)


def test_tip_of_another_task_or_shape_is_refused():
    tip = read_fast_tip(shipped_fast_tip("edge", "tactip-127"))
    with pytest.raises(TactipError, match="to start from is for edge, got contacts of surface"):
        started_from(tip, "surface", DESIGN, None)
    longer = replace(DESIGN, shape=replace(DESIGN.shape, cylinder_m=5e-3))
    with pytest.raises(TactipError, match=r"belongs to shape\.cylinder_m 0\.0, but the design has 0\.005"):
        started_from(tip, "edge", longer, None)
