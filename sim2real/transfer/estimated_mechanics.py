"""Pitch and materials of a real tip, estimated from frames whose labels are not used, for its design."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tactip_twin.sim.dataset.mechanics_randomization import MechanicsRandomization
from tactip_twin.sim.fast_tip.materials import INPUTS, material_inputs
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.estimated_contacts import ContactModel, contact_model, pins_of_some
from tactip_twin.tactip_model.design import Design

BEFORE, AFTER = "before_px", "after_px"
"""Names of the distances of the pins."""

_MARGIN = 1e-3
"""Distance of the materials from the ends of what the learned tip knows, as a fraction or in logarithms, -."""


class EstimatedMechanics(NamedTuple):
    """What frames show of a tip."""

    with_pitch: Design
    """The design with the estimated pitch."""
    with_materials: Design
    """That with the estimated materials, too."""
    materials: dict[str, float]
    """These by name (sim/fast_tip/materials.py), with the median distance of detected and simulated pins, px of 256, before
    and with them; both with the estimated pitch."""


def estimated_mechanics(
    design: Design, blobs: Sequence[np.ndarray], task: Task, around: MechanicsRandomization, seed: int = 0
) -> EstimatedMechanics:
    """Return the pitch and materials that explain the pins of some frames best, whatever their poses.

    The kinetic fraction, the slip weakening and the gel's compressibility remain the design's, because pins hardly show
    them: on 17 simulated sensors, the true ones of the first two were 1.0 to 2.3 and 0.4 to 1.4 times the most likely [M].

    Args:
        design: The design, fitted to the sensor's neutral image.
        blobs: (n) centres (k, 2) of the blobs of frames of presses, px of 256.
        task: Their stimulus.
        around: Randomization that the design will have: all of it lies within what the learned tip knows.
        seed: Seed of the choice of frames.

    Raises:
        TactipError: If too few frames show their pins.
    """
    rng = np.random.default_rng(seed)
    fit = contact_model(design, pins_of_some(blobs, design, rng), task, rng)
    likely = dict(zip(INPUTS, (float(value) for value in _within(fit, around)), strict=True))
    materials = replace(
        design.materials,
        skin_young_pa=float(np.exp(likely["log_modulus_ratio"])) * design.materials.gel_young_pa,
        friction=likely["friction"],
        skin_thickness_m=float(np.exp(likely["log_thickness"])),
    )
    found = dict(zip(INPUTS, material_inputs(materials).tolist(), strict=True))
    found |= {BEFORE: fit.before_px, AFTER: fit.after_px}
    return EstimatedMechanics(fit.design, replace(fit.design, materials=materials), found)


def _within(fit: ContactModel, around: MechanicsRandomization) -> np.ndarray:
    """Return the materials (6,) of a fit, moved so that a randomization around them is within what the tip knows."""
    factors = {
        "log_modulus_ratio": around.skin_young * around.gel_young,
        "friction": around.friction,
        "kinetic_fraction": around.kinetic_fraction,
        "log_slip_weakening": around.slip_weakening,
        "log_thickness": around.skin_thickness,
        "log_compressibility": around.gel_compressibility,
    }
    reach = np.log([factors[name] for name in INPUTS]) + _MARGIN
    low, high = (_logarithms(end) for end in fit.model.material_ranges.T)
    # A tip that knows one value only has no room for a randomization.
    reach = np.where(high > low, reach, 0.0)
    inside = np.clip(_logarithms(fit.materials), low + reach, high - reach)
    return np.array([x if name.startswith("log_") else np.exp(x) for name, x in zip(INPUTS, inside, strict=True)])


def _logarithms(materials: np.ndarray) -> np.ndarray:
    """Return the natural logarithms (6,) of what materials (6,), some of them logarithms already, stand for."""
    return np.array([x if name.startswith("log_") else np.log(x) for name, x in zip(INPUTS, materials, strict=True)])
