"""Gel of a real tip: less incompressible than that of the simulated designs, and within what the learned tip knows."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS, MechanicsRandomization
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import INPUTS, are_learned, material_inputs
from tactip_twin.sim2real.transfer.gel import with_other_gels, with_usual_gel

REAL = MECHANICS_RANDOMIZATIONS["real"]


def gels_of(randomization, design, count=300):
    rng = np.random.default_rng(0)
    return [randomization.sample(design, rng).materials.gel_poisson for _ in range(count)]


def test_gels_range_from_one_that_gives_way_to_that_of_the_simulated_designs(design):
    gels = gels_of(with_other_gels(REAL), with_usual_gel(design))
    assert min(gels) == pytest.approx(0.39, abs=0.005)
    assert max(gels) == pytest.approx(design.materials.gel_poisson, abs=0.002)
    assert sum(gel < 0.42 for gel in gels) > 20  # the lower of those that calibrations find is inside


def test_only_the_gel_changes(design):
    usual = with_usual_gel(design)
    assert replace(usual, materials=replace(usual.materials, gel_poisson=design.materials.gel_poisson)) == design
    assert replace(with_other_gels(REAL), gel_compressibility=1.0) == REAL


def test_without_randomization_there_is_one_gel():
    assert with_other_gels(MechanicsRandomization()).is_identity


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_learned_tip_knows_all_of_them(task, design):
    randomization, usual = with_other_gels(REAL), with_usual_gel(design)
    rng, known = np.random.default_rng(1), read_fast_tip(any_materials(task)).materials
    inputs = np.array([material_inputs(randomization.sample(usual, rng).materials) for _ in range(100)])
    assert are_learned(inputs, known)[:, INPUTS.index("log_compressibility")].all()
