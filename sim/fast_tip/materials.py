"""What a learned tip knows of the materials: the design's own, or, as inputs of its networks, those of any tip.

In slow motions, a deformation depends on the two moduli by their ratio alone, and forces are proportional to the gel's.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from tactip_twin.tactip_model.design import Design, Materials
from tactip_twin.tactip_model.errors import TactipError

INPUTS = (
    "log_modulus_ratio",
    "friction",
    "kinetic_fraction",
    "log_slip_weakening",
    "log_thickness",
    "log_compressibility",
)
"""Materials as inputs of a network: natural logarithms of skin_young_pa over gel_young_pa, of slip_weakening_m, of
skin_thickness_m, and of 1 - 2 gel_poisson, which is the gel's compressibility times a third of its modulus; and as in
Materials."""

VARIABLE = (
    "skin_young_pa",
    "gel_young_pa",
    "friction",
    "kinetic_fraction",
    "slip_weakening_m",
    "skin_thickness_m",
    "gel_poisson",
)
"""Fields of Materials that INPUTS and the scale of forces describe."""

_ROUNDING = 1e-9
"""Distance that an input may lie outside its range, because of rounding."""


def material_inputs(materials: Materials) -> np.ndarray:
    """Return INPUTS (6,) of materials."""
    return inputs_of({name: getattr(materials, name) for name in VARIABLE})


def inputs_of(values: Mapping[str, Any]) -> np.ndarray:
    """Return INPUTS (..., 6) of materials whose VARIABLE fields are numbers or arrays (...)."""
    ratio = np.divide(values["skin_young_pa"], values["gel_young_pa"])
    compressibility = 1 - 2 * np.asarray(values["gel_poisson"])
    logarithms = [np.log(a) for a in (ratio, values["slip_weakening_m"], values["skin_thickness_m"], compressibility)]
    inputs = [logarithms[0], values["friction"], values["kinetic_fraction"], *logarithms[1:]]
    return np.stack(np.broadcast_arrays(*inputs), -1)


def mechanics_of(design: Design, any_materials: bool = False) -> dict[str, Any]:
    """Return the part of a design that a learned tip depends on, as JSON: shape and materials.

    Args:
        design: The design.
        any_materials: Whether the tip knows the materials as inputs; these are then left out.
    """
    materials = asdict(design.materials)
    if any_materials:
        materials = {name: value for name, value in materials.items() if name not in VARIABLE}
    return json.loads(json.dumps({"shape": asdict(design.shape), "materials": materials}))


def check_mechanics(learned: dict[str, Any], design: Design) -> None:
    """Raise TactipError if a design has another shape or other materials than those that a tip has learned."""
    asked = mechanics_of(design)
    for part, values in learned.items():
        for name, value in values.items():
            if asked[part].get(name) != value:
                raise TactipError(
                    f"the learned tip belongs to {part}.{name} {value}, but the design has {asked[part].get(name)}: "
                    "teach one for this design, or simulate it (--fidelity standard)"
                )


def are_learned(inputs: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Return for each of INPUTS (..., 6) whether it lies in the ranges (6, 2) that a tip has learned, (..., 6) bool."""
    return (inputs >= ranges[:, 0] - _ROUNDING) & (inputs <= ranges[:, 1] + _ROUNDING)


def nearest_learned(inputs: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Return INPUTS (..., 6) with at most the kinetic fraction that a tip has learned, 1 % below the 1 of Coulomb friction.

    Args:
        inputs: (..., 6).
        ranges: (6, 2) low and high of INPUTS that it has learned.
    """
    index = INPUTS.index("kinetic_fraction")
    return np.where(np.arange(len(INPUTS)) == index, np.minimum(inputs, ranges[index, 1]), inputs)


def check_inputs(inputs: np.ndarray, ranges: np.ndarray) -> None:
    """Raise TactipError if INPUTS (6,) lie outside of the ranges (6, 2) that a tip has learned."""
    learned = are_learned(inputs, ranges)
    for name, value, (low, high), known in zip(INPUTS, inputs, ranges, learned, strict=True):
        if not known:
            quantity = name.removeprefix("log_")
            numbers = np.array([low, high, value])
            allowed = np.exp(numbers) if quantity != name else numbers
            raise TactipError(
                f"the learned tip knows a {quantity} from {allowed[0]:.4g} to {allowed[1]:.4g}, but the design has "
                f"{allowed[2]:.4g}: teach one for this design, or simulate it (--fidelity standard)"
            )
