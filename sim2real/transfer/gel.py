"""The gel of a real tip, which seems to be more compressible than that of the simulated designs, and not always as much.

Calibrations with labels find Poisson's ratios of 0.46 and 0.42 on the two published sets, where simulated designs have 0.49
[M] (docs/transfer.md). A gel that gives way in volume pushes the pins around the contact outwards less. Without labels, pins
hardly tell that from a shallower contact, so a network that has learned one ratio reads only a part of the depth.
"""

from dataclasses import replace

from tactip_twin.sim.dataset.mechanics_randomization import MechanicsRandomization
from tactip_twin.tactip_model.design import Design

_POISSON, _COMPRESSIBILITY = 0.467, 3.3
"""Poisson's ratio of the gel of a tip that nobody has calibrated, and largest factor, up or down, of 1 - 2 times it: ratios
from the 0.49 of simulated designs to 0.39, below both that calibrations found. Chosen with both published sets in view:
wider ranges read more of the depth on them, and too much on sensors with the designs' gel (docs/transfer.md)."""


def with_usual_gel(design: Design) -> Design:
    """Return a design with the usual gel of a real tip."""
    return replace(design, materials=replace(design.materials, gel_poisson=_POISSON))


def with_other_gels(randomization: MechanicsRandomization) -> MechanicsRandomization:
    """Return a randomization whose gels vary as those of real tips do, around the usual gel; one that varies nothing remains
    so."""
    if randomization.is_identity:
        return randomization
    return replace(randomization, gel_compressibility=_COMPRESSIBILITY)
