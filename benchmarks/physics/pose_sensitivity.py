"""Change of pose equivalent to an error of the pins: the one that moves the pins in the same way, by least squares.

The pins' positions in the tactile image are taken as linear in the pose near a contact. This simple estimator attributes as
much of an error as possible to a change of pose, so it bounds the effect on an estimator that also knows shear and the
ranges of poses.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.benchmarks.physics.contact_cache import STANDARD, CachedContact, Variant
from tactip_twin.benchmarks.physics.contact_cases import LABELS, Case, moved
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.optics import Lens

STEP = {"x": 0.25, "y": 0.25, "z": 0.25, "Rx": 1.5, "Ry": 1.5, "Rz": 1.5}
"""Half the distance between the two poses of a finite difference, mm or degrees: several times the steps in which vertices
of the mesh come into contact."""

MIN_CHANGE_PX = 0.1
"""Minimum change of the pins (root of the sum of squares over all of them, px) by a step in any direction of pose. Below it,
the contact does not determine that direction: an edge beside the contact, or hardly touched, does not determine its yaw."""


def moved_about(case: Case) -> list[Case]:
    """Return the case moved up and down in each component of pose that it determines."""
    return [moved(case, name, sign * STEP[name]) for name in LABELS[case.stimulus] for sign in (1, -1)]


class ImagePins:
    """Projection of a design's pins into its tactile image."""

    def __init__(self, design: Design) -> None:
        """Prepare the projection of a design whose whole frame is used."""
        self._lens, self._size = Lens(design), design.image.size_px

    def __call__(self, tips: ArrayLike) -> np.ndarray:
        """Return positions (..., p, 2), px of the tactile image, of pin tips (..., p, 3), m, in the sensor frame."""
        return (self._lens.project(np.asarray(tips, float)) + 0.5) * self._size / self._lens.width - 0.5


class PoseSensitivity:
    """Linear estimator of pose about one contact."""

    def __init__(self, components: Sequence[str], jacobian: ArrayLike) -> None:
        """Prepare the estimator.

        Args:
            components: Names of COMPONENTS.
            jacobian: (p, 2, c), px per mm or degree.
        """
        self.components = tuple(components)
        self._jacobian = np.asarray(jacobian, float)
        steps = np.array([STEP[c] for c in self.components])
        weakest = np.linalg.svd(self._jacobian.reshape(-1, len(steps)) * steps, compute_uv=False)[-1]
        self.is_determined = bool(weakest >= MIN_CHANGE_PX)
        """Whether the contact determines all components; a very light contact does not."""

    @classmethod
    def about(cls, case: Case, contact_of: Callable[[Case, Variant], CachedContact], pins: ImagePins) -> "PoseSensitivity":
        """Return the estimator about a case at `standard`.

        Args:
            case: The contact.
            contact_of: Simulator of contacts, such as a ContactCache.
            pins: Projection of the pins.
        """
        positions = [pins(contact_of(other, STANDARD).pin_tips) for other in moved_about(case)]
        components = LABELS[case.stimulus]
        pairs = zip(components, positions[::2], positions[1::2], strict=True)
        return cls(components, np.stack([(up - down) / (2 * STEP[name]) for name, up, down in pairs], -1))

    def __call__(self, error: ArrayLike) -> dict[str, float]:
        """Return the change of pose, mm or degrees by component, equivalent to an error (p, 2) px. Pins that are NaN are
        ignored."""
        error = np.asarray(error, float)
        seen = np.isfinite(error).all(-1)
        matrix = self._jacobian[seen].reshape(-1, len(self.components))
        values = np.linalg.lstsq(matrix, error[seen].ravel(), rcond=None)[0]
        return dict(zip(self.components, values.tolist(), strict=True))
