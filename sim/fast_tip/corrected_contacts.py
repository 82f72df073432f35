"""Contacts that the learned tip predicts and the simulation corrects.

MuJoCo's skin holds its state in its positions alone, so a contact can start from a predicted deformation and only settle,
instead of being pressed and slid in some twenty steps. Two to four steps bring the forces into balance and the skin out of
the object; what the prediction has wrong along the surface, friction keeps. (Friction that falls with sliding begins anew at
its static value, which only holds the skin more firmly.) The record passes the same checks as that of any other contact.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.symmetry import SymmetricReader, Symmetry
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.fast_tip.mesh_decoder import MeshDecoder
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.mesh import Mesh

MIN_STEPS, MAX_STEPS = 2, 5
"""Minimum and maximum number of steps of a correction. Every simulated contact or stride has more."""

_DAMPING_RATIO = 0.5
"""Damping of the contact relative to that of a simulated contact, -: a tip that hardly moves is out of the object in two
steps instead of three on edges, with the same errors [M]."""

MAX_MOVED_M = 0.15e-3
"""Maximum mean distance by which a correction moves the pins, m: 1.7 times that of the worst of 400 validation contacts [M].
A prediction that is farther off is not believed along the surface either."""


class CorrectedContacts:
    """Predicts contacts of a design, and corrects them."""

    def __init__(self, tip: FastTip, design: Design, fidelity: Fidelity, limits: QualityLimits) -> None:
        """Build the scene.

        Args:
            tip: Learned tip.
            design: Design with the shape and the materials that the tip learned.
            fidelity: Mesh and solver of the correction.
            limits: Limits of the checks.

        Raises:
            TactipError: The design has another shape or other materials.
        """
        self._tip, self._design, self._limits = tip, design, limits
        self._reader: SymmetricReader | None = None
        tip.check_design(design)
        self._pins, self._materials = PinDecoder(design, tip.modes), material_inputs(design.materials)
        stiffness, damping = fidelity.contact.resting
        contact = replace(fidelity.contact, resting=(stiffness, _DAMPING_RATIO * damping))
        self._simulator = ContactSimulator(design, tip.task, replace(fidelity, contact=contact))
        self._decoder = MeshDecoder(self.mesh, fidelity.mesh.poisson_limit, tip.modes)

    @property
    def mesh(self) -> Mesh:
        """Undeformed mesh of the tip."""
        return self._simulator.scene.mesh

    def trusted(self, pose: np.ndarray, shear: np.ndarray, symmetries: Sequence[Symmetry]) -> list[Contact] | None:
        """Return a corrected contact under each symmetry, the identity first; None if it cannot be trusted.

        Args:
            pose: (6,) m and rad.
            shear: (6,) m and rad.
            symmetries: Symmetries of the task.
        """
        contact = self.simulate(pose, shear)
        if contact is None or len(symmetries) == 1:
            return contact and [contact]
        if self._reader is None:
            self._reader = SymmetricReader(self._design, self.mesh, symmetries)
        return self._reader.read(contact, self._simulator.scene.vertices()[: self.mesh.surface_count])

    def simulate(self, pose: np.ndarray, shear: np.ndarray) -> Contact | None:
        """Return a corrected contact, whose slip fraction is as predicted; None if it cannot be trusted.

        Args:
            pose: (6,) m and rad.
            shear: (6,) m and rad.
        """
        predicted = self._tip.predict(self._pins, pose[None], shear[None], self._materials)
        if not predicted.trusted[0]:
            return None
        vertices = self._decoder(predicted.coefficients)[0]
        start, _ = self._simulator.reader.read(vertices[: self.mesh.surface_count])
        self._simulator.start_from(vertices, pose, shear)
        contact = self._simulator.settle(pose, self._limits, MIN_STEPS, MAX_STEPS)
        if contact is None or np.linalg.norm(contact.pin_tips - start, axis=1).mean() > MAX_MOVED_M:
            return None
        return replace(contact, slip_fraction=float(predicted.slip_fractions[0]))
