"""Records of contacts that the learned tip predicts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.dataset.symmetry import Symmetry
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.sim.fast_tip.materials import material_inputs
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


_MEASURED = (
    "normal_forces_n",
    "tangential_forces_n",
    "forces_n",
    "effective_shears",
    "slip_fractions",
    "contact_areas_m2",
)
"""What measures.forces_and_patch returns."""


def predicted_contact(
    pose: np.ndarray, shear: np.ndarray, pin_tips: np.ndarray, directions: np.ndarray, measured: Mapping[str, Any]
) -> Contact:
    """Return the record of a predicted contact. Measures of a simulation, such as the penetration, are NaN.

    Args:
        pose: (6,) label, m and rad.
        shear: (6,) m and rad.
        pin_tips: (p, 3) m.
        directions: (p, 3) unit.
        measured: Values for one contact by the names that measures.forces_and_patch returns.
    """
    return Contact(
        pose=pose,
        shear=shear,
        pin_tips=pin_tips,
        directions=directions,
        normal_force_n=float(measured["normal_forces_n"]),
        tangential_force_n=float(measured["tangential_forces_n"]),
        force_n=measured["forces_n"],
        effective_shear=measured["effective_shears"],
        slip_fraction=float(measured["slip_fractions"]),
        contact_area_m2=float(measured["contact_areas_m2"]),
        **_UNMEASURED,
        warnings=0,
        steps=0,
    )


class FastContacts:
    """Predicts contacts of a design."""

    def __init__(self, tip: FastTip, design: Design, decoder: PinDecoder | None = None) -> None:
        """Prepare the prediction.

        Args:
            tip: Learned tip.
            design: Design with the shape and the materials that the tip learned.
            decoder: Decoder of the design's pins; None: it is made.

        Raises:
            TactipError: The design has another shape or other materials.
        """
        tip.check_design(design)
        self._tip, self._decoder = tip, decoder or PinDecoder(design, tip.modes)
        self._materials = material_inputs(design.materials)

    def pins(self, poses: np.ndarray, shears: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pin tips (k, p, 3), m, and directions (k, p, 3) of contacts (k, 6), (k, 6) alone, trusted or not."""
        return self._decoder(self.coefficients(poses, shears))

    def coefficients(self, poses: np.ndarray, shears: np.ndarray) -> np.ndarray:
        """Return the coefficients (k, n) of the skin's modes of contacts (k, 6), (k, 6) alone, trusted or not."""
        return self._tip.coefficients(poses, shears, self._materials)[0]

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
        p = self._tip.predict(self._decoder, poses, shears, self._materials)
        measured = {name: getattr(p, name) for name in _MEASURED}
        contacts = [
            predicted_contact(
                poses[k],
                shears[k],
                p.pin_tips[k],
                p.directions[k],
                {name: value[k] for name, value in measured.items()},
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
