"""What an error of the pins is worth in the label: the change of pose that moves the pins alike, by least squares.

The pins' places in the tactile image are taken for linear in the pose about a contact. It is a plain estimator: it takes
whatever it can of an error for a change of pose, and so bounds what an estimator makes of it that knows shear and the
ranges of poses beside.
"""

import numpy as np

from tactip_twin.benchmarks.physics.contact_cache import STANDARD
from tactip_twin.benchmarks.physics.contact_cases import LABELS, moved
from tactip_twin.tactip_model.optics import Lens

STEP = {"x": 0.25, "y": 0.25, "z": 0.25, "Rx": 1.5, "Ry": 1.5, "Rz": 1.5}
"""Half the distance of the two poses that a derivative is taken from, mm or degrees: several times the steps in which
vertices of the mesh meet the stimulus."""

TELLS_PX = 0.1
"""Least change of the pins (root of the sum of squares over all of them, px) by a step in any direction of pose for a
contact to tell that direction. An edge that lies beside the contact, or is hardly touched, does not tell its yaw."""


def moved_about(case):
    """The Case moved up and down in each component that it tells: a list of Case."""
    return [moved(case, name, sign * STEP[name]) for name in LABELS[case.stimulus] for sign in (1, -1)]


class ImagePins:
    """Where a design's pins appear in its tactile image."""

    def __init__(self, design):
        """design: Design, whose frame is used whole."""
        self._lens, self._size = Lens(design), design.image.size_px

    def __call__(self, tips):
        """Places (..., p, 2), px of the tactile image, of tips (..., p, 3), m, sensor frame."""
        return (self._lens.project(np.asarray(tips, float)) + 0.5) * self._size / self._lens.width - 0.5


class PoseSensitivity:
    """The linear estimator about one contact."""

    def __init__(self, components, jacobian):
        """components: names, of COMPONENTS. jacobian: (p, 2, c), px over mm or degrees."""
        self.components = tuple(components)
        self._jacobian = np.asarray(jacobian, float)
        steps = np.array([STEP[c] for c in self.components])
        weakest = np.linalg.svd(self._jacobian.reshape(-1, len(steps)) * steps, compute_uv=False)[-1]
        self.tells = bool(weakest >= TELLS_PX)
        """Whether the contact tells all components: one that hardly touches does not."""

    @classmethod
    def about(cls, case, plays, pins):
        """The estimator about a Case at `standard`. plays: called with Case and Variant. pins: ImagePins."""
        places = [pins(plays(other, STANDARD).tips) for other in moved_about(case)]
        components = LABELS[case.stimulus]
        pairs = zip(components, places[::2], places[1::2], strict=True)
        return cls(components, np.stack([(up - down) / (2 * STEP[name]) for name, up, down in pairs], -1))

    def __call__(self, error):
        """The pose (dict of component to mm or degrees) that an error (p, 2) px is worth. Pins that are NaN do not count."""
        error = np.asarray(error, float)
        seen = np.isfinite(error).all(-1)
        matrix = self._jacobian[seen].reshape(-1, len(self.components))
        values = np.linalg.lstsq(matrix, error[seen].ravel(), rcond=None)[0]
        return dict(zip(self.components, values.tolist(), strict=True))
