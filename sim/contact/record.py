"""The record of one contact, and the limits that a trustworthy record keeps."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class QualityLimits:
    """What a trustworthy record must keep."""

    penetration_m: float = 0.05e-3
    """Greatest penetration, m."""
    volume_ratio: float = 0.1
    """Smallest ratio of an element's volume to its undeformed one, -. Below 0 it is inside out."""
    speed_m_s: float = 20e-3
    """Greatest residual speed of a vertex, m/s."""
    overlap_m: float = 0.1e-3
    """Greatest overlap of skin and object by their shapes, m."""
    imbalance: float = 0.5
    """Greatest force left over, of the contact force, -."""
    creep_m_s: float = 3e-3
    """Greatest rate at which stored energy changes, over the contact force, m/s."""
    area_ratio: float = 0.1
    """Smallest ratio of a facet's area to its undeformed one, -."""
    fold_rad: float = np.radians(160)
    """Greatest angle between the normals of neighbouring facets, rad. At 180 degrees the skin is folded on itself."""
    unsolved: float = 0.1
    """Greatest share of the steps in which the solver ran out of iterations, -."""
    disagreement_m: float = 0.05e-3
    """Greatest distance of the pins from those of twice the step, rms, where skin may catch by chance, m."""

    def while_sliding(self):
        """The QualityLimits of a tip that has just slid, and has not come to rest as a contact does: of forces nothing
        is asked,
        and the penetration may be three times as much [M]."""
        return replace(self, imbalance=np.inf, creep_m_s=np.inf, penetration_m=3 * self.penetration_m)


@dataclass(frozen=True)
class Contact:
    """The record of one contact, at rest, in the sensor frame. (p pins)"""

    pose: np.ndarray
    """(6,) label, m and rad (sim/pose.py)."""
    shear: np.ndarray
    """(6,) motion in contact that led to the pose, m and rad."""
    tips: np.ndarray
    """(p, 3) float, m."""
    directions: np.ndarray
    """(p, 3) float, unit, root to tip."""
    normal_force_n: float
    """Force of the object on the tip along the outward normal, N."""
    tangential_force_n: float
    """Size of the rest of that force, N."""
    penetration_m: float
    """Greatest penetration, m."""
    volume_ratio: float
    """Smallest ratio of an element's volume to its undeformed one, -."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    overlap_m: float
    """Greatest depth of the skin's facets inside the object, by its true shape: what contacts that were missed do not
    show, m."""
    imbalance: float
    """Norm of the force left over on the vertices over that of the contact force on them, -: zero at rest."""
    creep_m_s: float
    """Rate at which the energy stored in the tip changes, over the contact force: the speed of a stimulus that would do
    as much work, m/s."""
    area_ratio: float
    """Smallest ratio of a facet's area to its undeformed one, -."""
    fold_rad: float
    """Greatest angle between the normals of neighbouring facets, rad."""
    unsolved: float
    """Share of the steps in which the solver ran out of iterations, -."""
    warnings: int
    """MuJoCo's warnings on the way."""
    steps: int
    """Time steps taken."""

    def faults(self, bounds):
        """What is wrong with the record: a list of sentences, empty if it can be trusted. bounds: QualityLimits."""
        measures = [getattr(self, f.name) for f in fields(self)]
        if not all(np.isfinite(m).all() for m in measures):
            return ["the state is not finite"]
        mm, degrees = 1e3, np.degrees(1.0)
        checks = [
            (
                self.volume_ratio >= bounds.volume_ratio,
                f"an element shrank to {self.volume_ratio:.3f} of its volume (allowed: {bounds.volume_ratio})",
            ),
            (
                self.penetration_m <= bounds.penetration_m,
                f"the object is {mm * self.penetration_m:.4f} mm inside the skin (allowed: {mm * bounds.penetration_m} mm)",
            ),
            (
                self.speed_m_s <= bounds.speed_m_s,
                f"the skin still moves at {mm * self.speed_m_s:.1f} mm/s (allowed: {mm * bounds.speed_m_s} mm/s)",
            ),
            (
                self.overlap_m <= bounds.overlap_m,
                f"skin and object overlap by {mm * self.overlap_m:.4f} mm (allowed: {mm * bounds.overlap_m} mm)",
            ),
            (
                self.imbalance <= bounds.imbalance,
                f"{100 * self.imbalance:.1f} % of the contact force is not balanced (allowed: {100 * bounds.imbalance} %)",
            ),
            (
                self.creep_m_s <= bounds.creep_m_s,
                f"the stored energy drifts like a press at {mm * self.creep_m_s:.1f} mm/s "
                f"(allowed: {mm * bounds.creep_m_s} mm/s)",
            ),
            (
                self.area_ratio >= bounds.area_ratio,
                f"a facet of the skin shrank to {self.area_ratio:.3f} of its area (allowed: {bounds.area_ratio})",
            ),
            (
                self.fold_rad <= bounds.fold_rad,
                f"the skin is folded by {degrees * self.fold_rad:.0f} degrees (allowed: {degrees * bounds.fold_rad:.0f})",
            ),
            (
                self.unsolved <= bounds.unsolved,
                f"the solver ran out of iterations in {100 * self.unsolved:.0f} % of the steps "
                f"(allowed: {100 * bounds.unsolved:.0f} %)",
            ),
        ]
        return [sentence for good, sentence in checks if not good]
