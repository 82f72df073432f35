"""Pins followed from frame to frame of a real sensor, for the arrows on its page.

Between two frames a pin moves by less than half the distance to the next one, so it is the nearest blob to where it was.
A pin that moves unlike its neighbours is a mistake.
"""

import warnings

import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.tactip_model.pin_detection import Blobs, PinMatcher

_GATE = 0.45
"""Largest distance of a pin from where it is expected, in distances to its nearest neighbour at rest."""

_NEIGHBOURS = 6

_MIN_FRACTION = 0.6
"""Fraction of the pins that must be followed; below it they are identified anew, which is slower."""


class PinTracker:
    """Follows pins from their places at rest."""

    def __init__(self, rest: np.ndarray) -> None:
        """Start at rest (p, 2), px, at least two pins."""
        self.rest = rest
        """(p, 2) places at rest, px."""
        tree = cKDTree(rest)
        self._gate = _GATE * tree.query(rest, 2)[0][:, 1]
        self._near = tree.query(rest, min(_NEIGHBOURS + 1, len(rest)))[1][:, 1:]
        self._expected, self._matcher = rest.copy(), None

    def track(self, centres: np.ndarray) -> np.ndarray:
        """Return the places (p, 2) of the pins among blobs with centres (n, 2), px; NaN where one is not found."""
        found = self._followed(centres)
        if np.isfinite(found[:, 0]).mean() < _MIN_FRACTION and len(self.rest) > _NEIGHBOURS:
            self._matcher = self._matcher or PinMatcher(self.rest)
            again = self._matcher.match(Blobs(centres))
            found = again if np.isfinite(again).sum() > np.isfinite(found).sum() else found
        moved = found - self.rest
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # pins without a neighbour that was found
            usual = np.nanmedian(moved[self._near], axis=1)
        found[np.linalg.norm(moved - usual, axis=1) > self._gate] = np.nan
        lost = ~np.isfinite(found[:, 0])
        self._expected = np.where(lost[:, None], self.rest + np.nan_to_num(usual), found)
        return found

    def _followed(self, centres: np.ndarray) -> np.ndarray:
        """Return the blob nearest to where each pin is expected, (p, 2); NaN where it is too far or another pin's."""
        found = np.full_like(self.rest, np.nan)
        if not len(centres):
            return found
        distance, index = cKDTree(centres).query(self._expected)
        order = np.argsort(distance, kind="stable")
        nearest = order[np.unique(index[order], return_index=True)[1]]  # of each blob, the nearest pin
        good = nearest[distance[nearest] < self._gate[nearest]]
        found[good] = centres[index[good]]
        return found
