"""Predicted contacts of tips whose mechanics differ from contact to contact."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_dataset, read_meta, read_rows
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip, shipped_fast_tip, write_fast_tip
from tactip_twin.sim.fast_tip.randomized_contacts import RandomizedContacts
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

POSE, SHEAR = from_mm_deg([[0, 0, -3, 8, -5, 0]]), from_mm_deg([[4, 1, 0, 0, 0, 0]])


@pytest.fixture(scope="module")
def tip():
    return read_fast_tip(any_materials("surface"))


def with_materials(design, **changes):
    return replace(design, materials=replace(design.materials, **changes))


def test_prediction_is_that_of_a_predictor_of_the_sampled_tip(tip):
    design = design_named("tactip-127")
    contacts = RandomizedContacts(tip, design)
    for seed in range(3):
        other = MECHANICS_RANDOMIZATIONS["real"].sample(design, np.random.default_rng(seed))
        found, expected = contacts.of(other), FastContacts(tip, other)
        assert found is not None
        for a, b in zip(found.pins(POSE, SHEAR), expected.pins(POSE, SHEAR), strict=True):
            assert np.array_equal(a, b)
        assert np.array_equal(found.predict(POSE, SHEAR)[0][0].force_n, expected.predict(POSE, SHEAR)[0][0].force_n)


def test_prediction_follows_simulated_contacts_of_the_sampled_tip(tip):
    """Another tip moves its pins by several times the prediction's error."""
    design = design_named("nominal-127")
    contacts, moved, errors = RandomizedContacts(tip, design), [], []
    for changes in ({"friction": 0.45, "skin_young_pa": 9e5}, {"friction": 0.95, "skin_young_pa": 4e5}):
        other = with_materials(design, kinetic_fraction=0.6, **changes)
        other = replace(other, pins=replace(other.pins, length_m=1.1 * other.pins.length_m))
        found = contacts.of(other)
        assert found is not None
        tips = found.pins(POSE, SHEAR)[0][0]
        true = ContactSimulator(other, "surface", fidelity_named("standard")).simulate(POSE[0], SHEAR[0]).pin_tips
        moved.append(true)
        errors.append(1e3 * np.linalg.norm(tips - true, axis=1).mean())
    assert max(errors) < 0.1
    assert 1e3 * np.linalg.norm(moved[0] - moved[1], axis=1).mean() > 3 * max(errors)


def test_tips_outside_of_what_was_learned_are_simulated(tip):
    design = design_named("nominal-127")
    contacts = RandomizedContacts(tip, design)
    assert contacts.of(with_materials(design, friction=0.1)) is None
    coulomb = contacts.of(design)  # the nominal tip has Coulomb friction
    assert coulomb is not None and coulomb.predict(POSE, SHEAR)[1].all()
    with pytest.raises(TactipError, match=r"belongs to shape\.cylinder_m"):
        RandomizedContacts(tip, replace(design, shape=replace(design.shape, cylinder_m=5e-3)))


def test_fast_set_with_randomized_mechanics_does_not_depend_on_workers(tmp_path):
    command = ["dataset", "make", "--fidelity", "fast", "--renderer", "raster", "--randomize-mechanics", "real"]
    command += ["--design", "nominal-127", "--augment-symmetry", "--samples", "64"]
    for name, workers in (("a", "1"), ("b", "2")):
        assert tactip.main([*command, "--workers", workers, "--out", str(tmp_path / name)]) == 0
    a, b = (read_dataset(tmp_path / name) for name in "ab")
    assert a.meta["files"] == b.meta["files"]
    assert a.meta["configuration"]["fast_tip"] == read_fast_tip(any_materials("surface")).digest
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    steps = [int(row["steps"]) for row in read_rows(tmp_path / "a", read_meta(tmp_path / "a"))]
    assert np.mean(np.array(steps) == 0) > 0.7


def test_tip_of_one_design_with_randomized_mechanics_gives_one_sentence(tmp_path, capsys):
    command = ["dataset", "make", "--fidelity", "fast", "--randomize-mechanics", "real", "--out", str(tmp_path / "set")]
    tip = str(shipped_fast_tip("edge", "tactip-127"))
    assert tactip.main([*command, "--task", "edge", "--fast-tip", tip, "--samples", "2"]) == 1
    assert "knows the materials of one tip only, on the task 'edge'" in " ".join(capsys.readouterr().err.split())
    tip = str(shipped_fast_tip("surface", "tactip-127"))
    assert tactip.main([*command, "--fast-tip", tip, "--samples", "2"]) == 1
    assert "needs a learned tip of any materials, or simulated contacts" in " ".join(capsys.readouterr().err.split())
    assert tactip.main([*command[:2], "--fidelity", "corrected", *command[4:], "--samples", "2"]) == 1
    assert "knows the mechanics of one tip only" in " ".join(capsys.readouterr().err.split())


def test_tip_of_fewer_materials_is_refused(tip, tmp_path):
    """An earlier version knew five."""
    write_fast_tip(replace(tip, materials=tip.materials[:5]), tmp_path / "tip.npz")
    with pytest.raises(TactipError, match="must know 6 materials, got 5"):
        read_fast_tip(tmp_path / "tip.npz")
