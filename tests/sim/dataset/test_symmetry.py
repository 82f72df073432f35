"""A rotated or mirrored contact equals the simulation of the rotated or mirrored motion."""

import numpy as np
import pytest

from helpers.set_commands import configuration, table
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_meta, read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.dataset.symmetry import SYMMETRIES, SymmetricReader, ranges_are_symmetric
from tactip_twin.sim.pose import before_shear, from_mm_deg
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named

POSE = from_mm_deg([1, 0, -3, 8, -5, 20])
SHEAR = from_mm_deg([2, -1, 0, 2, 1, -3])


def contacts_of(simulator, task, pose=POSE, shear=SHEAR):
    contact = simulator.simulate(pose, shear)
    skin = simulator.scene.vertices()[: simulator.scene.mesh.surface_count]
    return SymmetricReader(simulator.scene.design, simulator.scene.mesh, SYMMETRIES[task]).read(contact, skin)


@pytest.mark.parametrize("task", SYMMETRIES)
def test_symmetries_form_a_group(task):
    matrices = [s.matrix for s in SYMMETRIES[task]]
    assert len({tuple((np.round(m) + 0.0).ravel()) for m in matrices}) == len(matrices)
    assert len(matrices) == {"surface": 8, "edge": 2}[task]
    assert np.array_equal(matrices[0], np.eye(3))
    for a in matrices:
        assert np.allclose(a @ a.T, np.eye(3))
        for b in matrices:
            assert any(np.allclose(a @ b, c) for c in matrices)


@pytest.mark.parametrize("task", SYMMETRIES)
def test_labels_go_as_motions_do(task):
    """Rotating or mirroring commutes with motions, before and after the shear."""
    for s in SYMMETRIES[task]:
        assert np.allclose(s.label(before_shear(POSE, SHEAR)), before_shear(s.label(POSE), s.label(SHEAR)))


@pytest.mark.parametrize("task", SYMMETRIES)
def test_symmetries_preserve_the_paper_ranges(task):
    assert ranges_are_symmetric(SYMMETRIES[task], POSE_RANGES[task])
    assert ranges_are_symmetric(SYMMETRIES[task], SHEAR_RANGES)
    assert not ranges_are_symmetric(SYMMETRIES[task], Ranges(depth_mm=(-5, -1), roll_deg=(-5, 15)))


def test_mirrored_contact_equals_simulation_of_mirrored_pose(design, standard):
    """On the edge, up to the difference between two meshes, because the mesh is not its own mirror image."""
    simulator = ContactSimulator(design, "edge", standard)
    same, mirrored = contacts_of(simulator, "edge")
    assert np.allclose(same.pin_tips, simulator.simulate(POSE, SHEAR).pin_tips, atol=1e-12)
    simulated = simulator.simulate(mirrored.pose, mirrored.shear)
    apart = np.linalg.norm(simulated.pin_tips - mirrored.pin_tips, axis=1)
    moved = np.linalg.norm(mirrored.pin_tips - same.pin_tips, axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.12e-3
    assert np.sqrt(np.mean(moved**2)) > 5 * np.sqrt(np.mean(apart**2))


@pytest.mark.parametrize("index", [1, 4, 6])
def test_rotated_contact_equals_simulation_of_rotated_pose(on_surface, index):
    pose, shear = from_mm_deg([0, 0, -3, 8, -5, 0]), from_mm_deg([1, -0.5, 0, 2, 1, -3])
    contacts = contacts_of(on_surface.simulator, "surface", pose, shear)
    simulated = on_surface.simulator.simulate(contacts[index].pose, contacts[index].shear)
    apart = np.linalg.norm(simulated.pin_tips - contacts[index].pin_tips, axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.12e-3


def test_directions_are_units_and_pins_as_built_stay_where_they_are(standard):
    """A fitted tip has no symmetry: at the lightest touch its pins are almost where they were built."""
    design = design_named("tactip-127")
    simulator = ContactSimulator(design, "surface", standard)
    neutral, _ = neutral_pins(design)
    for contact in contacts_of(simulator, "surface", from_mm_deg([0, 0, -0.02, 0, 0, 0]), np.zeros(6)):
        assert np.abs(contact.pin_tips - neutral).max() < 0.1e-3
        assert np.allclose(np.linalg.norm(contact.directions, axis=1), 1)


def test_symmetric_set_reads_contacts_of_two_meshes(design, tmp_path):
    """The far contact is simulated at `standard`, whose mesh has other vertices than that of `draft`."""
    draft = fidelity_named("draft")
    near, far = (Ranges(depth_mm=(depth, depth), pitch_deg=(-15, -15)) for depth in (-2, -5))
    for pose, tries, used in ((near, 1, draft), (far, 2, fidelity_named("standard"))):
        shear = Ranges(x_mm=(5, 5)) if tries > 1 else Ranges()
        c = configuration(design, task="edge", samples=2, augment_symmetry=True, fidelity=draft, pose=pose, shear=shear)
        folder = tmp_path / used.name
        make([Job(c, folder)], 1, lambda line: None)
        assert [row["tries"] for row in table(folder)] == [str(tries)] * 2
        simulator = ContactSimulator(design, "edge", used)
        expected = contacts_of(simulator, "edge", *(from_mm_deg(ranges.bounds()[:, 0]) for ranges in (pose, shear)))
        tips, _ = read_pins(folder, read_meta(folder))
        assert np.allclose(tips, [contact.pin_tips for contact in expected], atol=1e-8)
