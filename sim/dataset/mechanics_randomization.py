"""Randomization of the tip's mechanics from contact to contact: declared distributions, by name.

Two tips of one drawing differ in rubber, gel, thickness and wear, and friction differs from object to object. No image of
the undeformed tip shows these, so they are sampled for each contact.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.design import Design


@dataclass(frozen=True)
class MechanicsRandomization:
    """Maximum factor for each property, up or down; uniform in its logarithm. 1 leaves it as the design has it."""

    friction: float = within(1, 4, default=1.0)
    """Of skin on the stimulus."""
    kinetic_fraction: float = within(1, 4, default=1.0)
    """Ratio of kinetic to static friction; the result is at most 1."""
    skin_young: float = within(1, 4, default=1.0)
    """Modulus of the skin."""
    gel_young: float = within(1, 4, default=1.0)
    """Modulus of the gel."""
    skin_thickness: float = within(1, 1.5, default=1.0)
    """Thickness of the skin."""
    pin_length: float = within(1, 1.3, default=1.0)
    """Depth of the pin tips below the outer surface."""
    slip_weakening: float = within(1, 4, default=1.0)
    """Slip-weakening distance."""
    gel_compressibility: float = within(1, 20, default=1.0)
    """1 - 2 gel_poisson; the resulting Poisson's ratio is from 0 to 0.499."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def is_identity(self) -> bool:
        """Whether nothing varies."""
        return all(getattr(self, f.name) == 1 for f in fields(self))

    def sample(self, design: Design, rng: np.random.Generator) -> Design:
        """Return a design with sampled mechanics. Each property takes one number of `rng`; the compressibility only where it
        varies, so sets made before it could vary keep their bytes."""
        factors = {_LAST: 1.0} | {name: getattr(self, name) ** rng.uniform(-1, 1) for name in self._sampled}
        values = {name: float(value) for name, value in _varied(design, factors).items()}
        pins = replace(design.pins, length_m=values.pop("length_m"))
        return replace(design, materials=replace(design.materials, **values), pins=pins)

    def sample_many(self, design: Design, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return what varies in `count` designs sampled as by `sample`: fields (count,) of Materials, and length_m of
        Pins."""
        draws = rng.uniform(-1, 1, (count, len(self._sampled)))
        factors = {name: getattr(self, name) ** draws[:, k] for k, name in enumerate(self._sampled)}
        return _varied(design, {_LAST: np.ones(count)} | factors)

    @property
    def _sampled(self) -> list[str]:
        """Names of the properties that take a number of the generator."""
        return [f.name for f in fields(self) if f.name != _LAST or self.gel_compressibility != 1]


_LAST = "gel_compressibility"
"""Name of the last property."""


def _varied(design: Design, factors: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of Materials, and length_m of Pins, that vary, for numbers or arrays as factors."""
    m = design.materials
    return {
        "friction": m.friction * factors["friction"],
        "kinetic_fraction": np.clip(m.kinetic_fraction * factors["kinetic_fraction"], 0.1, 1.0),
        "skin_young_pa": m.skin_young_pa * factors["skin_young"],
        "gel_young_pa": m.gel_young_pa * factors["gel_young"],
        "skin_thickness_m": m.skin_thickness_m * factors["skin_thickness"],
        "slip_weakening_m": m.slip_weakening_m * factors["slip_weakening"],
        "gel_poisson": np.clip(0.5 - (0.5 - m.gel_poisson) * factors[_LAST], 0.0, 0.499),
        "length_m": design.pins.length_m * factors["pin_length"],
    }


MechanicsName = Literal["none", "estimated", "real", "wide"]
"""Name of a randomization of the mechanics."""

MECHANICS_RANDOMIZATIONS: dict[str, MechanicsRandomization] = {
    "none": MechanicsRandomization(),
    "estimated": MechanicsRandomization(
        friction=1.2, kinetic_fraction=1.57, skin_young=1.2, skin_thickness=1.08, pin_length=1.1
    ),
    "real": MechanicsRandomization(
        friction=1.6, kinetic_fraction=1.57, skin_young=1.5, gel_young=1.5, skin_thickness=1.15, pin_length=1.1
    ),
    "wide": MechanicsRandomization(
        friction=1.8, kinetic_fraction=1.8, skin_young=3.0, skin_thickness=1.3, slip_weakening=2.5
    ),
}
"""By name. `real`: friction from 0.45 to 1.1 around the 0.7 of the calibrated 127-pin tip, which includes the 0.55 to 0.7
of a load cell [R]; kinetic fraction from 0.4 to 0.99 around the 0.63 of designs fitted to a neutral image, because
calibrated tips have 0.55 [M]; the rest is estimated [?], and exceeds the deviations of a calibration (docs/calibration).
`estimated`: around materials that were estimated from the pins of unlabelled frames, which are about as far off on
simulated sensors [M]; the kinetic fraction, which pins hardly show, as in `real`. `wide`: what a calibration may meet around
the 127-pin tip, for a learned tip that knows materials. Deformations depend on the moduli by their ratio alone, so only one
varies. The gel's compressibility varies where a caller says so (sim2real/transfer/gel.py)."""
