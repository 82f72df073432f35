"""Corrected contacts against simulated ones, and the deformed meshes that corrections start from."""

import numpy as np
import pytest

from helpers.set_commands import contents
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_meta, read_rows
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.fast_tip import corrected_contacts
from tactip_twin.sim.fast_tip.corrected_contacts import MAX_STEPS, CorrectedContacts
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.mesh_decoder import MeshDecoder, _extension
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.presets import design_named

DESIGN, STANDARD = design_named("tactip-127"), fidelity_named("standard")

MAX_MM = {"surface": 0.04, "edge": 0.1}
"""Mean distance of pins over six contacts of another seed: about twice the mean of docs/fast_tip.md."""


@pytest.fixture(scope="module", params=["surface", "edge"])
def task(request):
    return request.param


@pytest.fixture(scope="module")
def tip(task):
    return read_fast_tip(shipped_fast_tip(task, "tactip-127"))


@pytest.fixture(scope="module")
def corrected(tip):
    return CorrectedContacts(tip, DESIGN, STANDARD, QualityLimits())


def test_corrected_contacts_are_closer_to_simulated_ones_than_predictions(task, tip, corrected):
    rng, simulator = np.random.default_rng(5), ContactSimulator(DESIGN, task, STANDARD)
    predictor, apart, forces = FastContacts(tip, DESIGN), [], []
    for _ in range(6):
        pose, shear = POSE_RANGES[task].sample(rng), SHEAR_RANGES.sample(rng)
        contact = corrected.simulate(pose, shear)
        if contact is None:
            continue
        true = simulator.simulate(pose, shear)
        assert 2 <= contact.steps <= MAX_STEPS < true.steps
        assert not contact.violations(QualityLimits())
        predicted = predictor.predict(pose[None], shear[None])[0][0]
        apart.append([np.linalg.norm(one.pin_tips - true.pin_tips, axis=1).mean() for one in (contact, predicted)])
        forces.append((contact.normal_force_n, predicted.normal_force_n, true.normal_force_n))
    assert len(apart) > 3
    after, before = 1e3 * np.mean(apart, 0)
    assert after < min(before, MAX_MM[task])
    after, before, true = np.transpose(forces)
    assert np.abs(after - true).sum() < min(np.abs(before - true).sum(), 0.02 * true.sum())


def test_contacts_that_cannot_be_trusted_are_left_to_the_simulation(corrected, task, monkeypatch):
    inside, outside = from_mm_deg([0, 0, -3, 2, 2, 0]), from_mm_deg([0, 0, -6, 2, 2, 0])
    shear = from_mm_deg([1, -1, 0, 0, 0, 0])
    contacts = corrected.trusted(inside, shear, SYMMETRIES[task])
    assert [one.steps for one in contacts] == [contacts[0].steps] * len(SYMMETRIES[task])
    assert corrected.trusted(outside, shear, SYMMETRIES[task]) is None
    monkeypatch.setattr(corrected_contacts, "MAX_MOVED_M", 1e-6)
    assert corrected.trusted(inside, shear, SYMMETRIES[task]) is None


def test_gel_inside_follows_a_uniform_strain_exactly():
    """A displacement that grows linearly with the height above the base is in balance."""
    mesh = build_mesh(DESIGN.shape, STANDARD.mesh)
    inner, to_inner = _extension(mesh, 0.43)
    moved = np.outer(mesh.vertices[:, 2] - mesh.vertices[:, 2].min(), [0.1, -0.2, 0.3])
    expected = moved[inner]
    found = (to_inner @ moved[: mesh.surface_count].ravel()).reshape(-1, 3)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_mesh_without_deformation_is_the_undeformed_one(tip):
    mesh = build_mesh(DESIGN.shape, STANDARD.mesh)
    decoder = MeshDecoder(mesh, 0.43, tip.modes)
    still, moved = decoder(np.stack([np.zeros(len(tip.modes.orders)), np.ones(len(tip.modes.orders))]).astype(complex))
    assert np.array_equal(still, mesh.vertices)
    assert np.array_equal(moved[mesh.bonded], mesh.vertices[mesh.bonded])
    assert np.abs(moved - mesh.vertices).max() > 1e-4


@pytest.mark.slow
def test_corrected_set_is_the_same_with_any_worker_count(tmp_path, capsys):
    make = ["dataset", "make", "--fidelity", "corrected", "--task", "edge", "--samples", "12", "--augment-symmetry"]
    for name, workers in (("a", "1"), ("b", "2")):
        out = ["--renderer", "raster", "--workers", workers, "--out", str(tmp_path / name)]
        assert tactip.main([*make, *out, "--pose.depth-mm", "-5.3", "-4"]) == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    meta = read_meta(tmp_path / "a")
    simulated = [int(row["steps"]) > MAX_STEPS for row in read_rows(tmp_path / "a", meta)]
    assert set(simulated) == {True, False}
    assert f"{sum(simulated)} of them were simulated" in capsys.readouterr().out
    assert meta["configuration"]["corrected"] is True


def test_corrections_need_a_learned_tip_of_the_task(tmp_path, capsys):
    arguments = ["dataset", "make", "--fidelity", "corrected", "--task", "edge", "--design", "tactip-127"]
    tip = str(shipped_fast_tip("surface", "tactip-127"))
    assert tactip.main([*arguments, "--fast-tip", tip, "--out", str(tmp_path / "set")]) == 1
    assert "is for surface, got --task edge" in " ".join(capsys.readouterr().err.split())
