"""Contacts by the learned tip, with simulated ones where its prediction cannot be trusted."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.sim.contact.limits import check_motion
from tactip_twin.sim.contact.record import Contact
from tactip_twin.sim.contact.simulator import TRIES, RetriedContact, RetryingSimulator
from tactip_twin.sim.dataset.symmetry import Symmetry
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder
from tactip_twin.tactip_model.design import Design


class FastSimulator:
    """Predicts contacts. Those outside of the learned ranges, and those on which the networks disagree, are simulated."""

    def __init__(self, tip: FastTip, design: Design, fallback: Callable[[], RetryingSimulator]) -> None:
        """Prepare the prediction.

        Args:
            tip: Learned tip.
            design: Design with the shape and the materials that the tip learned.
            fallback: Function that builds the simulator of contacts that are not trusted; called when it is first needed.

        Raises:
            TactipError: The tip belongs to a design of another shape or other materials.
        """
        tip.check_design(design)
        self._tip, self._decoder = tip, PinDecoder(design, tip.modes)
        self._build, self._fallback = fallback, None

    @property
    def fallback(self) -> RetryingSimulator:
        """Simulator of contacts that are not trusted."""
        if self._fallback is None:
            self._fallback: RetryingSimulator | None = self._build()
        return self._fallback

    @property
    def tries(self) -> int:
        """Maximum number of simulations of a contact that is not trusted."""
        return self._fallback.tries if self._fallback else TRIES

    def predict(self, poses: ArrayLike, shears: ArrayLike) -> tuple[list[Contact], np.ndarray]:
        """Predict contacts.

        Args:
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.

        Returns:
            The contacts, and whether each is trusted, (k,) bool. Measures of a simulation, such as the penetration, are NaN,
            and the number of steps is 0.

        Raises:
            TactipError: A pose or shear is out of reach (check_motion).
        """
        poses, shears = np.asarray(poses, float), np.asarray(shears, float)
        for pose, shear in zip(poses, shears, strict=True):
            check_motion(pose, shear)
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

    def simulate(self, pose: ArrayLike, shear: ArrayLike) -> RetriedContact:
        """Predict or simulate one contact, pose and shear (6,), m and rad; as RetryingSimulator.simulate."""
        (contact,), (trusted,) = self.predict([pose], [shear])
        return RetriedContact(contact, []) if trusted else self.fallback.simulate(pose, shear)

    def symmetric(self, contact: Contact, symmetries: Sequence[Symmetry]) -> list[Contact]:
        """Return a trusted contact under each symmetry."""
        poses, shears = ([s.label(label) for s in symmetries] for label in (contact.pose, contact.shear))
        return self.predict(poses, shears)[0]


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
