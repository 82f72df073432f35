"""Detection of pins in a binary image and their identification.

A pressed and sheared tip moves its pins by more than their spacing, so the blob nearest to a pin's rest position is often
another pin's. Neighbours, however, move alike: starting from one identified pin, an affine map of the pins identified so far
predicts their neighbours, and the whole hexagon or disc fits in one way only. Every blob near the middle is tried as the
first pin.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay, cKDTree

_GATE = 0.42
"""Largest distance of a pin's blob from its expected position, in spacings of the undeformed pins there."""

_LOCAL = 9
"""Number of pins to which the affine map for the next one is fitted."""

_KEPT_MAPS = 100
"""Number of affine maps that are kept: the same pins are known in the middle of most frames. On the two published sets, 93 %
or more of the maps were kept ones in frames at full size, and about half in tactile images; 2000 were no faster [M]."""

MIN_AREA_PX = 4
"""Smallest area of a pin, px."""


@dataclass(frozen=True)
class Blobs:
    """White blobs of an image that can be pins."""

    centres: np.ndarray
    """(n, 2) float, px: x to the right, y down; the centre of the top left pixel is (0, 0)."""


def find_blobs(image: np.ndarray, max_area: float = 2.6, min_area: float = 0.15) -> Blobs:
    """Return the blobs of a binary image that are round enough and similar in size.

    Crescents of light at the rim are left out because they are long, and so are two pins that touch.

    Args:
        image: (h, w) uint8, pins white.
        max_area: Largest area, in medians of the roundish blobs' areas.
        min_area: Smallest area, likewise.
    """
    _, centres, area, roundish = _components(image)
    if not roundish.any():
        return Blobs(np.zeros((0, 2)))
    middle = np.median(area[roundish])
    keep = roundish & (area < max_area * middle) & (area > min_area * middle)
    return Blobs(centres[keep])


def count_small_spots(image: np.ndarray) -> int:
    """Return the number of white patches of a binary image that are too small for pins. image: (h, w) uint8."""
    return int((_components(image)[2] < MIN_AREA_PX).sum())


def find_reflections(image: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) bool of the long white patches in a binary image: reflections at the rim of the housing."""
    labels, _, area, roundish = _components(image)
    if not roundish.any():
        return np.zeros(np.shape(image), bool)
    long = ~roundish & (area > 2 * np.median(area[roundish]))
    return np.concatenate([[False], long])[labels]


def _components(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the white patches of a binary image.

    Returns:
        Labels (h, w), from 1; centres (n, 2), px; areas (n,), px; whether each patch is roundish (n,).
    """
    white = (np.asarray(image) > 127).astype(np.uint8)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(white, connectivity=8)
    labels = np.asarray(labels, np.int32)
    area = stats[1:, cv2.CC_STAT_AREA].astype(float)
    width, height = stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT]
    x, y = np.meshgrid(np.arange(labels.shape[1]), np.arange(labels.shape[0]))
    flat = labels.ravel()
    dx, dy = x.ravel() - centres[flat, 0], y.ravel() - centres[flat, 1]
    xx, yy, xy = (
        np.bincount(flat, v, count)[1:] / area + c for v, c in ((dx * dx, 1 / 12), (dy * dy, 1 / 12), (dx * dy, 0))
    )
    spread = np.hypot((xx - yy) / 2, xy)
    # Second moments of an ellipse: area = 4 pi sqrt(l1 l2). A crescent or a dumbbell has more spread than area.
    roundness = area / (4 * np.pi * ((xx + yy) / 2 + spread))
    return (
        labels,
        centres[1:],
        area,
        (roundness > 0.45) & (area >= MIN_AREA_PX) & (np.maximum(width, height) < 0.2 * max(labels.shape)),
    )


class PinMatcher:
    """Identifies pins among blobs from the pins' positions in the undeformed image."""

    def __init__(self, neutral: ArrayLike) -> None:
        """Prepare for the pins (p, 2), px, of an undeformed image."""
        self.neutral = np.asarray(neutral, float)
        self._middle = int(np.linalg.norm(self.neutral - self.neutral.mean(0), axis=1).argmin())
        self._adjacent = np.zeros((len(self.neutral), len(self.neutral)), bool)
        for triangle in Delaunay(self.neutral).simplices:
            self._adjacent[np.ix_(triangle, triangle)] = True
        spacing = cKDTree(self.neutral).query(self.neutral, 4)[0][:, 1:].mean(1)
        self._gate = _GATE * spacing
        self._reach = 2.2 * float(np.median(spacing)) + 0.03 * float(np.ptp(self.neutral))
        self._map = lru_cache(_KEPT_MAPS)(self._affine_map)

    def match(self, blobs: Blobs) -> np.ndarray:
        """Return the positions (p, 2), px, of the pins; NaN where one is not detected, all NaN if none can be identified."""
        positions = np.full_like(self.neutral, np.nan)
        if len(blobs.centres) < 3:
            return positions
        tree = cKDTree(blobs.centres)
        middle = self.neutral[self._middle]
        tried = np.array(tree.query_ball_point(middle, self._reach), int)
        # The likely ones first, so that others can be given up early.
        shifted = middle + blobs.centres.mean(0) - self.neutral.mean(0)
        tried = tried[np.linalg.norm(blobs.centres[tried] - shifted, axis=1).argsort(kind="stable")]
        best, best_score = None, -np.inf
        for first in tried:
            found, score = self._grow(tree, int(first), best_score)
            if score > best_score:
                best, best_score = found, score
        if best is None:
            return positions
        best = self._settle(tree, best)
        known = best >= 0
        positions[known] = blobs.centres[best[known]]
        return positions

    def _expected(self, found: np.ndarray, centres: np.ndarray, pins: np.ndarray) -> np.ndarray:
        """Predict the positions (k, 2) of `pins` (k,) by an affine map of the nearest known pins other than itself.

        Args:
            found: Blob of each pin (p,), -1 if unknown.
            centres: Centres of the blobs (n, 2), px.
            pins: Indices of the pins to predict.
        """
        sources, weights = self._map((found >= 0).tobytes(), pins.tobytes())
        moved = centres[found[sources]] - self.neutral[sources]
        return self.neutral[pins] + np.einsum("kl,kld->kd", weights, moved)

    def _affine_map(self, known_bytes: bytes, pins_bytes: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Return the pins (k, l) by which each of some pins (k,) is predicted, and the weights (k, l) of their motions, for
        the bytes of which pins are known (p,) bool, and of the pins, int. Neither depends on the image."""
        known, pins = np.flatnonzero(np.frombuffer(known_bytes, bool)), np.frombuffer(pins_bytes, int)
        _, near = cKDTree(self.neutral[known]).query(self.neutral[pins], min(_LOCAL + 1, len(known)))
        sources = known[near.reshape(len(pins), -1)]
        used = sources != pins[:, None]
        used &= np.cumsum(used, 1) <= _LOCAL
        offset = self.neutral[sources] - self.neutral[pins][:, None]
        # A small ridge on the gradient: few or collinear pins determine the position but not its gradient.
        a = np.concatenate([np.ones((*sources.shape, 1)), offset], 2) * used[..., None]
        ridge = 0.025 * ((offset * used[..., None]) ** 2).sum((1, 2))[:, None, None] * np.diag([0.0, 1.0, 1.0])
        to_solve = a.transpose(0, 2, 1) @ a + ridge + 1e-9 * np.eye(3)
        return sources, np.linalg.solve(to_solve, a.transpose(0, 2, 1))[:, 0]

    def _grow(self, tree: cKDTree, first: int, to_beat: float) -> tuple[np.ndarray, float]:
        """Identify the pins, starting from the middle pin being blob `first`.

        Args:
            tree: The blobs.
            first: Blob of the middle pin.
            to_beat: Score that the fit must exceed; one that cannot is given up.

        Returns:
            Blob of each pin (p,) int, -1 if unknown, and the score of the fit; `to_beat` if it was given up.
        """
        centres = np.asarray(tree.data)
        found, tried = np.full(len(self.neutral), -1), np.zeros(len(self.neutral), bool)
        taken = np.zeros(len(centres), bool)
        found[self._middle], tried[self._middle], taken[first], misfit = first, True, True, 0.0
        # Around the first pin the stretch is still unknown, so the gate is wider there.
        gate = 1.6
        while len(ring := np.flatnonzero(self._adjacent[found >= 0].any(0) & ~tried)):
            if np.count_nonzero(~tried | (found >= 0)) - 0.5 * misfit <= to_beat:
                return found, to_beat
            distance, nearest = tree.query(self._expected(found, centres, ring))
            relative = distance / self._gate[ring]
            order = np.argsort(relative)
            order = order[(relative[order] < gate) & ~taken[nearest[order]]]
            # Of several pins at one blob, the nearest has it.
            chosen = order[np.unique(nearest[order], return_index=True)[1]]
            found[ring[chosen]] = nearest[chosen]
            taken[nearest[chosen]] = True
            misfit += float((relative[chosen] ** 2).sum())
            tried[ring] = True
            gate = 1.0
        return found, np.count_nonzero(found >= 0) - 0.5 * misfit

    def _settle(self, tree: cKDTree, found: np.ndarray) -> np.ndarray:
        """Reassign each pin the blob nearest to its expected position until nothing changes."""
        centres = np.asarray(tree.data)
        for _ in range(10):
            known = np.flatnonzero(found >= 0)
            if len(known) < 4:
                return found
            expected = self._expected(found, centres, np.arange(len(self.neutral)))
            cost = np.linalg.norm(expected[:, None] - centres[None], axis=2) / self._gate[:, None]
            pins, chosen = linear_sum_assignment(np.minimum(cost, 1.0))
            new = np.full_like(found, -1)
            good = cost[pins, chosen] < 1.0
            new[pins[good]] = chosen[good]
            if (new == found).all():
                break
            found = new
        return found
