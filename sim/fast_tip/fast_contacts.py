"""Records of contacts that the learned tip predicts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.dataset.symmetry import Symmetry
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.tactip_model.design import Design

_UNMEASURED = dict.fromkeys(
    (
        "penetration_m",
        "volume_ratio",
        "speed_m_s",
        "overlap_m",
        "imbalance",
        "energy_drift_m_s",
        "area_ratio",
        "fold_rad",
        "unconverged_fraction",
    ),
    float("nan"),
)
"""Measures of a simulated contact that a predicted one lacks."""


class FastContacts:
    """Predicts contacts of a design."""

    def __init__(self, tip: FastTip, design: Design) -> None:
        """Prepare the prediction.

        Args:
            tip: Learned tip.
            design: Design with the shape and the materials that the tip learned.

        Raises:
            TactipError: The design has another shape or other materials.
        """
        tip.check_design(design)
        self._tip, self._decoder = tip, PinDecoder(design, tip.modes)

    def pins(self, poses: np.ndarray, shears: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pin tips (k, p, 3), m, and directions (k, p, 3) of contacts (k, 6), (k, 6) alone, trusted or not."""
        coefficients, _ = self._tip.coefficients(poses, shears)
        return self._decoder(coefficients)

    def predict(self, poses: ArrayLike, shears: ArrayLike) -> tuple[list[Contact], np.ndarray]:
        """Predict contacts.

        Args:
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.

        Returns:
            The contacts, and whether each can be trusted, (k,) bool. Measures of a simulation, such as the penetration, are
            NaN, and the number of steps is 0.
        """
        poses, shears = np.asarray(poses, float), np.asarray(shears, float)
        p = self._tip.predict(self._decoder, poses, shears)
        contacts = [
            Contact(
                pose=poses[k],
                shear=shears[k],
                pin_tips=p.pin_tips[k],
                directions=p.directions[k],
                normal_force_n=float(p.normal_forces_n[k]),
                tangential_force_n=float(p.tangential_forces_n[k]),
                force_n=p.forces_n[k],
                effective_shear=p.effective_shears[k],
                slip_fraction=float(p.slip_fractions[k]),
                contact_area_m2=float(p.contact_areas_m2[k]),
                **_UNMEASURED,
                warnings=0,
                steps=0,
            )
            for k in range(len(poses))
        ]
        return contacts, p.trusted

    def trusted(self, pose: np.ndarray, shear: np.ndarray, symmetries: Sequence[Symmetry]) -> list[Contact] | None:
        """Return a contact under each symmetry, the identity first; None if its prediction cannot be trusted.

        Args:
            pose: (6,) m and rad.
            shear: (6,) m and rad.
            symmetries: Symmetries of the task.
        """
        poses, shears = (np.array([s.label(label) for s in symmetries]) for label in (pose, shear))
        contacts, trusted = self.predict(poses, shears)
        return contacts if trusted[0] else None
