"""Predicted contacts of tips whose mechanics differ from contact to contact, by a learned tip that knows any materials."""

from dataclasses import replace

from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.fast_tip.materials import INPUTS, are_learned, material_inputs, nearest_learned
from tactip_twin.tactip_model.design import Design


class RandomizedContacts:
    """Predicts contacts of a design with randomized mechanics."""

    def __init__(self, tip: FastTip, design: Design) -> None:
        """Prepare the prediction.

        Args:
            tip: Learned tip.
            design: Design with the shape that the tip learned; its mechanics are those of no contact.

        Raises:
            TactipError: The design has another shape, or the tip knows one design's materials only.
        """
        tip.check_design(design, randomized=True)
        self._tip, self._decoder = tip, PinDecoder(design, tip.modes)

    def of(self, design: Design) -> FastContacts | None:
        """Return the predictor of contacts of the design with other mechanics; None outside of what the tip has learned.

        Coulomb friction becomes the largest ratio of kinetic to static friction that the tip has learned, 1 % below 1.
        """
        if self._tip.materials is None:
            return None
        inputs = nearest_learned(material_inputs(design.materials), self._tip.materials)
        if not are_learned(inputs, self._tip.materials).all():
            return None
        known = replace(design.materials, kinetic_fraction=float(inputs[INPUTS.index("kinetic_fraction")]))
        return FastContacts(self._tip, replace(design, materials=known), self._decoder.with_mechanics(design))
