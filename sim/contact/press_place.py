"""Places on a mesh to press on: the contact frame where a vertical line meets the mesh from above."""

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh

_GAP_M = 1e-3
"""Height above the mesh at which the line begins, m."""


def place_below(solid: SignedDistanceMesh, at: np.ndarray) -> np.ndarray | None:
    """Return the place (3,) m where a vertical line at (2,) m meets a solid from above; None if it passes beside it."""
    top = np.array([*at, solid.vertices[:, 2].max() + _GAP_M])
    gap = solid.first_hit(top, np.array([0.0, 0.0, -1.0]))
    return top - [0, 0, gap] if np.isfinite(gap) else None


def in_contact_frame(solid: SignedDistanceMesh, place: np.ndarray) -> SignedDistanceMesh:
    """Return a solid in the contact frame at a place (3,) m on it: z along the normal, x as near to the solid's x as it
    can."""
    normal = solid.smooth_normal(place[None])[0]
    turn = Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0]  # the shortest turn from the vertical
    return solid.moved(turn.as_matrix(), place)
