"""Randomization of the tip's mechanics from contact to contact."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import sample_contact
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS, MechanicsRandomization
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.record_contact import record_contact
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

REAL = MECHANICS_RANDOMIZATIONS["real"]


def value(design, name):
    if name == "gel_compressibility":
        return 1 - 2 * design.materials.gel_poisson
    part = design.pins if name == "pin_length" else design.materials
    return getattr(part, {"pin_length": "length_m", "skin_young": "skin_young_pa", "gel_young": "gel_young_pa"}.get(
        name, {"skin_thickness": "skin_thickness_m", "slip_weakening": "slip_weakening_m"}.get(name, name)))  # fmt: skip


@pytest.mark.parametrize("name", ["real", "wide"])
def test_sample_factors_fill_their_ranges(design, name):
    randomization = MECHANICS_RANDOMIZATIONS[name]
    samples = [randomization.sample(design, np.random.default_rng(seed)) for seed in range(400)]
    for f in fields(MechanicsRandomization):
        maximum = getattr(randomization, f.name)
        factors = np.array([value(d, f.name) for d in samples]) / value(design, f.name)
        if maximum == 1:
            assert (factors == 1).all()
            continue
        assert factors.min() > 0.999 / maximum and factors.max() < 1.001 * maximum
        assert factors.min() < maximum**-0.95
        assert f.name == "kinetic_fraction" or factors.max() > maximum**0.95
        assert f.name == "kinetic_fraction" or np.median(np.log(factors)) == pytest.approx(0, abs=0.2 * np.log(maximum))
    assert max(d.materials.kinetic_fraction for d in samples) == 1.0


def test_mechanics_randomization_default_is_identity_and_factors_below_1_are_refused(design):
    assert MechanicsRandomization().is_identity and not REAL.is_identity
    same = MechanicsRandomization().sample(design, np.random.default_rng(0))
    assert same == design
    with pytest.raises(TactipError, match=r"friction must be .*, got 0.5"):
        MechanicsRandomization(friction=0.5)


def test_sets_made_before_the_compressibility_could_vary_keep_their_bytes(design):
    """Their configurations have no such field, and the generator gives what it gave."""
    rng = np.random.default_rng(3)
    sampled = REAL.sample(design, rng)
    numbers = np.random.default_rng(3).uniform(-1, 1, 8)
    assert sampled.materials.friction == design.materials.friction * REAL.friction ** numbers[0]
    assert rng.uniform(-1, 1) == numbers[7]
    assert "gel_compressibility" not in configuration(mechanics_randomization=REAL).as_json()["mechanics_randomization"]
    squeezed = replace(REAL, gel_compressibility=3.0)
    made = configuration(mechanics_randomization=squeezed)
    assert made.as_json()["mechanics_randomization"]["gel_compressibility"] == 3.0
    assert squeezed.sample(design, np.random.default_rng(3)).materials.gel_poisson == pytest.approx(
        0.5 - 0.01 * 3.0 ** numbers[7]
    )


@pytest.mark.parametrize("compressibility", [1.0, 3.0])
def test_many_designs_are_those_that_are_sampled_one_by_one(design, compressibility):
    randomization, rng = replace(REAL, gel_compressibility=compressibility), np.random.default_rng(4)
    many = randomization.sample_many(design, 6, np.random.default_rng(4))
    for k, one in enumerate(randomization.sample(design, rng) for _ in range(6)):
        assert many["gel_poisson"][k] == pytest.approx(one.materials.gel_poisson)
        assert many["friction"][k] == pytest.approx(one.materials.friction)


def configuration(**changes):
    made = Configuration(
        task="surface",
        split="train",
        samples=4,
        renderer="raster",
        design=design_named("nominal-127"),
        fidelity=fidelity_named("draft"),
        pose=POSE_RANGES["surface"],
        shear=SHEAR_RANGES,
    )
    return replace(made, **changes)


def test_sample_contact_poses_do_not_depend_on_mechanics():
    plain, randomized = configuration(), configuration(mechanics_randomization=REAL)
    assert plain.digest() != randomized.digest()
    for number in range(4):
        a, b = sample_contact(plain, number), sample_contact(randomized, number)
        assert np.array_equal(a.pose, b.pose) and np.array_equal(a.shear, b.shear)
        assert a.design == plain.design != b.design
        assert b.design == sample_contact(randomized, number).design


def test_simulator_force_follows_the_moduli(design):
    """At the same depth, the force is proportional to both moduli together, and smaller with a softer skin."""

    def force(**changes):
        other: Design = replace(design, materials=replace(design.materials, **changes))
        simulator = ContactSimulator(other, "surface", fidelity_named("draft"))
        return simulator.simulate(from_mm_deg([0, 0, -3, 0, 0, 0]), np.zeros(6)).normal_force_n

    m = design.materials
    plain = force()
    both = force(gel_young_pa=1.5 * m.gel_young_pa, skin_young_pa=1.5 * m.skin_young_pa)
    assert both / plain == pytest.approx(1.5, rel=0.03)
    assert force(skin_young_pa=0.7 * m.skin_young_pa) < plain


def test_make_randomized_mechanics_do_not_depend_on_workers(tmp_path):
    command = [
        "dataset",
        "make",
        "--fidelity",
        "draft",
        "--renderer",
        "raster",
        "--randomize-mechanics",
        "real",
        "--augment-symmetry",
    ]
    for name, workers in (("a", "1"), ("b", "2")):
        assert tactip.main([*command, "--samples", "16", "--workers", workers, "--out", str(tmp_path / name)]) == 0
    one, other = (read_dataset(tmp_path / name) for name in "ab")
    assert one.meta["files"] == other.meta["files"]
    assert one.meta["configuration"]["mechanics_randomization"]["friction"] == REAL.friction
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    # Simulated again, the contact has the same mechanics.
    _, arrays = record_contact(tmp_path / "a", 8, tmp_path / "run")
    with np.load(tmp_path / "a" / "pins.npz") as pins:
        assert np.allclose(arrays["pin_tips_m"][-1], pins["pin_tips"][8], atol=1e-7)
