"""Benchmarks that change a scene still simulate contacts with it: `tactip bench scene-cost` and `mesh-contact`."""

import numpy as np
import pytest

from tactip_twin.benchmarks.physics.mesh_contact import NativeMesh, contacts, meshes, subdivide
from tactip_twin.benchmarks.physics.scene_cost import PARTS
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.soft_body import TOUCHES_FACETS, TOUCHES_VERTICES


@pytest.fixture(scope="module")
def whole():
    """Return a pressed and sheared contact."""
    return _contact(PARTS["nothing (repeated contact)"]("surface"))


def _contact(simulator):
    return simulator.simulate(from_mm_deg([0, 0, -3, 5, 0, 0]), from_mm_deg([1, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize("part", [part for part in PARTS if not part.startswith("nothing")])
def test_contact_without_a_part_is_near_the_whole_one(whole, part):
    contact = _contact(PARTS[part]("surface"))
    assert 1e3 * np.linalg.norm(contact.pin_tips - whole.pin_tips, axis=1).mean() < 1.0
    assert contact.imbalance < 0.05


def test_contact_with_a_flex_is_that_with_its_shape():
    pose, shear = contacts("surface")[0]
    mesh = subdivide("surface", meshes()["surface"], 20.0)
    flex = NativeMesh(stimulus_named("surface"), mesh, "flex", TOUCHES_VERTICES | TOUCHES_FACETS)
    found, true = (
        ContactSimulator(load_design("tactip-127"), stimulus, fidelity_named("draft")).simulate(pose, shear)
        for stimulus in (flex, "surface")
    )
    assert 1e3 * np.linalg.norm(found.pin_tips - true.pin_tips, axis=1).max() < 0.3
    assert found.contact_area_m2 == pytest.approx(true.contact_area_m2, rel=0.3)
