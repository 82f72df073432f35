"""The learned tip in torch against the one in numpy, and its gradients against finite differences."""

import dataclasses

import numpy as np
import pytest
import torch

from tactip_twin.assets import FAST_TIPS
from tactip_twin.learning.differentiable_tip import DifferentiableTip
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, read_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

TIPS = ["surface-tactip-127", "edge-tactip-127", "surface-any-materials"]


def contacts(task: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return tuple(np.array([ranges.sample(rng) for _ in range(count)]) for ranges in (POSE_RANGES[task], SHEAR_RANGES))


@pytest.mark.parametrize("name", TIPS)
def test_pins_are_those_of_the_numpy_tip(name):
    tip, design = read_fast_tip(FAST_TIPS / f"{name}.npz"), design_named("tactip-127")
    poses, shears = contacts(tip.task, 20)
    expected = tip.predict(PinDecoder(design, tip.modes), poses, shears, material_inputs(design.materials)).pin_tips
    found = DifferentiableTip(tip, design)(*(torch.tensor(x, dtype=torch.float32) for x in (poses, shears)))
    assert np.abs(found.numpy() - expected).max() < 2e-6


@pytest.mark.parametrize("name", TIPS)
def test_gradients_agree_with_finite_differences(name):
    tip, design = read_fast_tip(FAST_TIPS / f"{name}.npz"), design_named("tactip-127")
    poses, shears = (torch.tensor(x, requires_grad=True) for x in contacts(tip.task, 2))
    materials = torch.tensor(material_inputs(design.materials), requires_grad=True)
    length = torch.tensor(0.2e-3, dtype=torch.double, requires_grad=True)
    module = DifferentiableTip(tip, design, torch.double)

    def in_mm(*arguments: torch.Tensor) -> torch.Tensor:
        return 1e3 * module(*arguments)[:, ::40]

    inputs = (poses, shears, materials, length) if module.knows_materials else (poses, shears)
    # Differences of 1e-6 m are off by as much as 2e-4 where friction bends the response.
    assert torch.autograd.gradcheck(in_mm, inputs, eps=1e-7, atol=1e-4, rtol=1e-5)


def test_longer_pins_are_those_of_another_design():
    tip, design = read_fast_tip(FAST_TIPS / "surface-any-materials.npz"), design_named("tactip-127")
    longer = dataclasses.replace(design, pins=dataclasses.replace(design.pins, length_m=design.pins.length_m + 0.3e-3))
    poses, shears = (torch.tensor(x) for x in contacts("surface", 3))
    moved = DifferentiableTip(tip, design, torch.double)(poses, shears, None, 0.3e-3)
    assert torch.allclose(moved, DifferentiableTip(tip, longer, torch.double)(poses, shears), atol=1e-12)


def test_other_designs_are_refused():
    tip = read_fast_tip(FAST_TIPS / "surface-tactip-127.npz")
    with pytest.raises(TactipError, match=r"belongs to materials\.skin_young_pa"):
        DifferentiableTip(tip, design_named("tactip-331"))
