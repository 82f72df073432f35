"""Pitch, camera height and materials of a real tip, estimated from frames whose labels are not used, for its design."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tactip_twin.sim.dataset.mechanics_randomization import MechanicsRandomization
from tactip_twin.sim.fast_tip.materials import INPUTS, material_inputs
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.estimated_contacts import ContactModel, contact_model, pins_of_some
from tactip_twin.tactip_model.design import Design

_MARGIN = 1e-3
"""Distance of the materials from the ends of what the learned tip knows, as a fraction or in logarithms, -."""


class EstimatedMechanics(NamedTuple):
    """What frames show of a tip."""

    design: Design
    """The design with the estimated pitch; where the materials are believed, also with these and the camera height."""
    materials: dict[str, float] | None
    """The materials by name (sim/fast_tip/materials.py); None where they are not believed."""
    before_px: float
    """Median distance of detected and simulated pins with usual materials, px of 256."""
    after_px: float
    """That with the estimated ones; both with the estimated pitch and camera height."""


def estimated_mechanics(
    design: Design,
    blobs: Sequence[np.ndarray],
    task: Task,
    around: MechanicsRandomization,
    max_residual: float,
    seed: int = 0,
) -> EstimatedMechanics:
    """Return the pitch, camera height and materials that explain the pins of some frames best, whatever their poses.

    The kinetic fraction, the slip weakening and the gel's compressibility remain the design's, because pins hardly show
    them: on 17 simulated sensors, the true ones of the first two were 1.0 to 2.3 and 0.4 to 1.4 times the most likely [M].

    Args:
        design: The design, fitted to the sensor's neutral image.
        blobs: (n) centres (k, 2) of the blobs of frames of presses, px of 256.
        task: Their stimulus.
        around: Randomization that the design will have: all of it lies within what the learned tip knows.
        max_residual: Distance of the pins with the estimated materials, relative to that with usual ones, up to which
            materials and camera height are believed, -.
        seed: Seed of the choice of frames.

    Raises:
        TactipError: If too few frames show their pins.
    """
    rng = np.random.default_rng(seed)
    pins = pins_of_some(blobs, design, rng)
    fit = contact_model(design, pins, task, np.random.default_rng((seed, 1)), with_height=True)
    before, after = fit.before_px, fit.after_px
    if after > max_residual * before:
        return EstimatedMechanics(contact_model(design, pins, task, rng).design, None, before, after)
    likely = dict(zip(INPUTS, (float(value) for value in _within(fit, around)), strict=True))
    materials = replace(
        design.materials,
        skin_young_pa=float(np.exp(likely["log_modulus_ratio"])) * design.materials.gel_young_pa,
        friction=likely["friction"],
        skin_thickness_m=float(np.exp(likely["log_thickness"])),
    )
    found: dict[str, float] = dict(zip(INPUTS, material_inputs(materials).tolist(), strict=True))
    return EstimatedMechanics(replace(fit.design, materials=materials), found, before, after)


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
