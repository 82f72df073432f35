"""The record of one contact, and its quality checks."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class QualityLimits:
    """Limits of the checks of a record."""

    penetration_m: float = 0.05e-3
    """Maximum penetration, m."""
    volume_ratio: float = 0.1
    """Minimum ratio of an element's volume to its undeformed one, -. Below 0 the element is inside out."""
    speed_m_s: float = 20e-3
    """Maximum residual speed of a vertex, m/s."""
    overlap_m: float = 0.1e-3
    """Maximum overlap of skin and object by their shapes, m."""
    imbalance: float = 0.5
    """Maximum ratio of the unbalanced force to the contact force, -."""
    energy_drift_m_s: float = 3e-3
    """Maximum rate of change of the elastic energy, divided by the contact force, m/s."""
    area_ratio: float = 0.1
    """Minimum ratio of a facet's area to its undeformed one, -."""
    fold_rad: float = np.radians(160)
    """Maximum angle between the normals of neighbouring facets, rad. At 180 degrees the skin is folded on itself."""
    unconverged_fraction: float = 0.1
    """Maximum fraction of the steps in which the solver ran out of iterations, -."""
    disagreement_m: float = 0.05e-3
    """Maximum distance (rms) between the pins at two step sizes, where skin may snag by chance, m."""

    def while_sliding(self) -> "QualityLimits":
        """Return the limits for a tip that has just slid and is not fully at rest: no limit on the balance of forces and the
        energy, and three times the penetration [M]."""
        return replace(self, imbalance=np.inf, energy_drift_m_s=np.inf, penetration_m=3 * self.penetration_m)


@dataclass(frozen=True)
class Contact:
    """The record of one contact at rest, in the sensor frame. (p pins)"""

    pose: np.ndarray
    """(6,) label, m and rad (sim/pose.py)."""
    shear: np.ndarray
    """(6,) motion in contact before the pose, m and rad."""
    pin_tips: np.ndarray
    """(p, 3) pin tips, m."""
    directions: np.ndarray
    """(p, 3) unit vectors from the pins' roots to their tips."""
    normal_force_n: float
    """Force of the object on the tip along the outward normal, N."""
    tangential_force_n: float
    """Magnitude of the rest of that force, N."""
    force_n: np.ndarray
    """(3,) force of the object on the tip, N, in the sensor frame."""
    effective_shear: np.ndarray
    """(6,) m and rad, in the axes of a label: motion of the rim relative to the patch of skin in contact
    (contact_patch.ContactPatch.shear), which slip does not increase as it does `shear`."""
    slip_fraction: float
    """Fraction of the normal force whose contacts slid at the end of the last motion, -; 1 without friction."""
    contact_area_m2: float
    """Area of the skin in contact, m^2."""
    penetration_m: float
    """Maximum penetration, m."""
    volume_ratio: float
    """Minimum ratio of an element's volume to its undeformed one, -."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    overlap_m: float
    """Maximum depth of the skin's facets inside the object's true shape, m. It also reveals contacts that MuJoCo missed."""
    imbalance: float
    """Norm of the unbalanced force on the vertices over that of the contact force on them, -; zero at rest."""
    energy_drift_m_s: float
    """Rate of change of the tip's elastic energy divided by the contact force, m/s: the speed of a stimulus that would do
    as much work."""
    area_ratio: float
    """Minimum ratio of a facet's area to its undeformed one, -."""
    fold_rad: float
    """Maximum angle between the normals of neighbouring facets, rad."""
    unconverged_fraction: float
    """Fraction of the steps in which the solver ran out of iterations, -."""
    warnings: int
    """Number of MuJoCo's warnings."""
    steps: int
    """Number of time steps."""

    def violations(self, limits: QualityLimits) -> list[str]:
        """Return the failed checks as sentences; none if the record can be trusted."""
        measures = [getattr(self, f.name) for f in fields(self)]
        if not all(np.isfinite(m).all() for m in measures):
            return ["the state is not finite"]
        mm, degrees = 1e3, np.degrees(1.0)
        checks = [
            (
                self.volume_ratio >= limits.volume_ratio,
                f"an element shrank to {self.volume_ratio:.3f} of its volume (allowed: {limits.volume_ratio})",
            ),
            (
                self.penetration_m <= limits.penetration_m,
                f"the object is {mm * self.penetration_m:.4f} mm inside the skin (allowed: {mm * limits.penetration_m} mm)",
            ),
            (
                self.speed_m_s <= limits.speed_m_s,
                f"the skin still moves at {mm * self.speed_m_s:.1f} mm/s (allowed: {mm * limits.speed_m_s} mm/s)",
            ),
            (
                self.overlap_m <= limits.overlap_m,
                f"skin and object overlap by {mm * self.overlap_m:.4f} mm (allowed: {mm * limits.overlap_m} mm)",
            ),
            (
                self.imbalance <= limits.imbalance,
                f"{100 * self.imbalance:.1f} % of the contact force is not balanced (allowed: {100 * limits.imbalance} %)",
            ),
            (
                self.energy_drift_m_s <= limits.energy_drift_m_s,
                f"the elastic energy over the contact force drifts by {mm * self.energy_drift_m_s:.1f} mm/s "
                f"(allowed: {mm * limits.energy_drift_m_s} mm/s)",
            ),
            (
                self.area_ratio >= limits.area_ratio,
                f"a facet of the skin shrank to {self.area_ratio:.3f} of its area (allowed: {limits.area_ratio})",
            ),
            (
                self.fold_rad <= limits.fold_rad,
                f"the skin is folded by {degrees * self.fold_rad:.0f} degrees (allowed: {degrees * limits.fold_rad:.0f})",
            ),
            (
                self.unconverged_fraction <= limits.unconverged_fraction,
                f"the solver ran out of iterations in {100 * self.unconverged_fraction:.0f} % of the steps "
                f"(allowed: {100 * limits.unconverged_fraction:.0f} %)",
            ),
        ]
        return [sentence for passed, sentence in checks if not passed]
