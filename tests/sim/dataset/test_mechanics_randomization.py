"""Tips whose mechanics differ from contact to contact."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.dataset.generate import sample_contact
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS, MechanicsRandomization
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.record_contact import record_contact
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

REAL = MECHANICS_RANDOMIZATIONS["real"]


def value(design, name):
    part = design.pins if name == "pin_length" else design.materials
    return getattr(part, {"pin_length": "length_m", "skin_young": "skin_young_pa", "gel_young": "gel_young_pa"}.get(
        name, {"skin_thickness": "skin_thickness_m"}.get(name, name)))  # fmt: skip


def test_draws_lie_within_the_factors_and_fill_them(design):
    draws = [REAL.sample(design, np.random.default_rng(seed)) for seed in range(400)]
    for f in fields(MechanicsRandomization):
        most = getattr(REAL, f.name)
        factors = np.array([value(d, f.name) for d in draws]) / value(design, f.name)
        assert factors.min() > 0.999 / most and factors.max() < 1.001 * most
        assert factors.min() < most**-0.95
        assert f.name == "kinetic_share" or factors.max() > most**0.95
        assert f.name == "kinetic_share" or np.median(np.log(factors)) == pytest.approx(0, abs=0.2 * np.log(most))
    assert max(d.materials.kinetic_share for d in draws) == 1.0


def test_a_still_one_changes_nothing_and_others_are_refused(design):
    assert MechanicsRandomization().is_identity and not REAL.is_identity
    same = MechanicsRandomization().sample(design, np.random.default_rng(0))
    assert same == design
    with pytest.raises(TactipError, match=r"friction must be .*, got 0.5"):
        MechanicsRandomization(friction=0.5)


def configuration(**changes):
    made = Configuration(
        "surface", "train", 4, 0, "raster", design_named("nominal-127"), fidelity_named("draft"), POSE_RANGES["surface"],
        SHEAR_RANGES,
    )  # fmt: skip
    return replace(made, **changes)


def test_poses_are_the_same_and_a_still_set_keeps_its_digest():
    still, moved = configuration(), configuration(mechanics=REAL)
    assert "mechanics" not in still.as_json()
    assert still.digest() != moved.digest()
    for number in range(4):
        a, b = sample_contact(still, number), sample_contact(moved, number)
        assert np.array_equal(a.pose, b.pose) and np.array_equal(a.shear, b.shear)
        assert a.design == still.design != b.design
        assert b.design == sample_contact(moved, number).design


def test_a_tip_of_softer_gel_gives_way(design):
    """The same press: the force goes with the moduli together, and pins move more where the skin is thin."""

    def force(**changes):
        other: Design = replace(design, materials=replace(design.materials, **changes))
        player = ContactSimulator(other, "surface", fidelity_named("draft"))
        return player.play(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6)).normal_force_n

    m = design.materials
    plain = force()
    both = force(gel_young_pa=1.5 * m.gel_young_pa, skin_young_pa=1.5 * m.skin_young_pa)
    assert both / plain == pytest.approx(1.5, rel=0.03)
    assert force(skin_young_pa=0.7 * m.skin_young_pa) < plain


def test_a_set_of_varied_tips_is_the_same_whoever_makes_it(tmp_path):
    command = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--mechanics", "real", "--symmetric"]
    for name, workers in (("a", "1"), ("b", "2")):
        assert tactip.main([*command, "--samples", "16", "--workers", workers, "--out", str(tmp_path / name)]) == 0
    one, other = (read_dataset(tmp_path / name) for name in "ab")
    assert one.meta["files"] == other.meta["files"]
    assert one.meta["configuration"]["mechanics"]["friction"] == REAL.friction
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    # Played once more, its mechanics are those of the contact.
    _, arrays = record_contact(tmp_path / "a", 8, tmp_path / "run")
    with np.load(tmp_path / "a" / "pins.npz") as pins:
        assert np.allclose(arrays["tips_m"][-1], pins["tips"][8], atol=1e-7)
