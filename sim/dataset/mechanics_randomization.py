"""How far the mechanics of a tip are varied from contact to contact: declared distributions, by name.

Two tips of one drawing differ in rubber, gel, thickness and wear, and slip at another force on another thing. What no image
of the undeformed tip can tell is drawn anew for each contact.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class MechanicsRandomization:
    """Greatest factor of each, either way; uniform in its logarithm. 1 leaves it as the design has it."""

    friction: float = within(1, 4, default=1.0)
    """Of skin on the stimulus."""
    kinetic_share: float = within(1, 4, default=1.0)
    """Share of the friction that is left in sliding; never above 1."""
    skin_young: float = within(1, 4, default=1.0)
    """Modulus of the skin."""
    gel_young: float = within(1, 4, default=1.0)
    """Modulus of the gel."""
    skin_thickness: float = within(1, 1.5, default=1.0)
    """Thickness of the skin."""
    pin_length: float = within(1, 1.3, default=1.0)
    """Depth of the pins' tips below the outer surface."""

    def __post_init__(self):
        check(self)

    @property
    def still(self):
        """Whether nothing varies."""
        return all(getattr(self, f.name) == 1 for f in fields(self))

    def draw(self, design, generator):
        """A Design with the mechanics of one draw. generator: numpy Generator, of which each takes one number."""
        factors = {f.name: getattr(self, f.name) ** generator.uniform(-1, 1) for f in fields(self)}
        m, pins = design.materials, design.pins
        materials = replace(
            m,
            friction=m.friction * factors["friction"],
            kinetic_share=float(np.clip(m.kinetic_share * factors["kinetic_share"], 0.1, 1.0)),
            skin_young_pa=m.skin_young_pa * factors["skin_young"],
            gel_young_pa=m.gel_young_pa * factors["gel_young"],
            skin_thickness_m=m.skin_thickness_m * factors["skin_thickness"],
        )
        return replace(design, materials=materials, pins=replace(pins, length_m=pins.length_m * factors["pin_length"]))


MECHANICS_RANDOMIZATIONS = {
    "none": MechanicsRandomization(),
    "real": MechanicsRandomization(
        friction=1.6, kinetic_share=1.4, skin_young=1.5, gel_young=1.5, skin_thickness=1.15, pin_length=1.1
    ),
}
"""By name. `real`: friction from 0.45 to 1.1 about the 0.7 of the calibrated 127-pin tip; a load cell's 0.55 to 0.7 [R]
lie within; the rest is estimated [?], and more than the deviations of a calibration (docs/calibration)."""
