"""Detection of pins in a binary image and their identification.

A pressed and sheared tip moves its pins by more than their spacing, so the blob nearest to a pin's rest position is often
another pin's. Neighbours, however, move alike: starting from one identified pin, an affine map of the pins identified so far
predicts their neighbours, and the whole hexagon or disc fits in one way only. Every blob near the middle is tried as the
first pin.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay, cKDTree

_GATE = 0.42
"""Largest distance of a pin's blob from its expected position, in spacings of the undeformed pins there."""

_LOCAL = 9
"""Number of pins to which the affine map for the next one is fitted."""


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
        triangles = Delaunay(self.neutral).simplices
        self._neighbours: list[set[int]] = [set() for _ in self.neutral]
        for triangle in triangles:
            for a in triangle:
                self._neighbours[a].update(int(b) for b in triangle if b != a)
        spacing = cKDTree(self.neutral).query(self.neutral, 4)[0][:, 1:].mean(1)
        self._gate = _GATE * spacing
        self._reach = 2.2 * float(np.median(spacing)) + 0.03 * float(np.ptp(self.neutral))

    def match(self, blobs: Blobs) -> np.ndarray:
        """Return the positions (p, 2), px, of the pins; NaN where one is not detected, all NaN if none can be identified."""
        positions = np.full_like(self.neutral, np.nan)
        if len(blobs.centres) < 3:
            return positions
        tree = cKDTree(blobs.centres)
        best, best_score = None, -np.inf
        for first in tree.query_ball_point(self.neutral[self._middle], self._reach):
            found, score = self._grow(tree, first)
            if score > best_score:
                best, best_score = found, score
        if best is None:
            return positions
        best = self._settle(tree, best)
        known = best >= 0
        positions[known] = blobs.centres[best[known]]
        return positions

    def _expected(self, known: np.ndarray, found: np.ndarray, centres: np.ndarray, pins: np.ndarray) -> np.ndarray:
        """Predict the positions (k, 2) of `pins` (k,) by an affine map of the nearest known pins other than itself.

        Args:
            known: Indices of the known pins.
            found: Blob of each pin (p,), -1 if unknown.
            centres: Centres of the blobs (n, 2), px.
            pins: Indices of the pins to predict.
        """
        tree = cKDTree(self.neutral[known])
        _, near = tree.query(self.neutral[pins], min(_LOCAL + 1, len(known)))
        sources = known[near.reshape(len(pins), -1)]
        used = sources != pins[:, None]
        used &= np.cumsum(used, 1) <= _LOCAL
        offset = self.neutral[sources] - self.neutral[pins][:, None]
        moved = centres[found[sources]] - self.neutral[sources]
        # A small ridge on the gradient: few or collinear pins determine the position but not its gradient.
        a = np.concatenate([np.ones((*sources.shape, 1)), offset], 2) * used[..., None]
        ridge = 0.025 * ((offset * used[..., None]) ** 2).sum((1, 2))[:, None, None] * np.diag([0.0, 1.0, 1.0])
        to_solve = a.transpose(0, 2, 1) @ a + ridge + 1e-9 * np.eye(3)
        return self.neutral[pins] + np.linalg.solve(to_solve, a.transpose(0, 2, 1) @ moved)[:, 0]

    def _grow(self, tree: cKDTree, first: int) -> tuple[np.ndarray, float]:
        """Identify the pins, starting from the middle pin being blob `first`.

        Returns:
            Blob of each pin (p,) int, -1 if unknown, and the score of the fit.
        """
        centres = np.asarray(tree.data)
        found = np.full(len(self.neutral), -1)
        found[self._middle] = first
        taken = {int(first)}
        ring, tried, misfit = sorted(self._neighbours[self._middle]), {self._middle}, 0.0
        while ring:
            known = np.flatnonzero(found >= 0)
            expected = self._expected(known, found, centres, np.array(ring))
            distance, nearest = tree.query(expected)
            order = np.argsort(distance / self._gate[ring])
            for k in order:
                pin = ring[k]
                # Around the first pin the stretch is still unknown, so the gate is wider there.
                gate = self._gate[pin] * (1.6 if len(known) == 1 else 1.0)
                if distance[k] < gate and int(nearest[k]) not in taken:
                    found[pin] = nearest[k]
                    taken.add(int(nearest[k]))
                    misfit += (distance[k] / self._gate[pin]) ** 2
            tried.update(ring)
            ring = sorted({n for pin in tried if found[pin] >= 0 for n in self._neighbours[pin]} - tried)
        return found, (found >= 0).sum() - 0.5 * misfit

    def _settle(self, tree: cKDTree, found: np.ndarray) -> np.ndarray:
        """Reassign each pin the blob nearest to its expected position until nothing changes."""
        centres = np.asarray(tree.data)
        for _ in range(10):
            known = np.flatnonzero(found >= 0)
            if len(known) < 4:
                return found
            expected = self._expected(known, found, centres, np.arange(len(self.neutral)))
            cost = np.linalg.norm(expected[:, None] - centres[None], axis=2) / self._gate[:, None]
            pins, chosen = linear_sum_assignment(np.minimum(cost, 1.0))
            new = np.full_like(found, -1)
            good = cost[pins, chosen] < 1.0
            new[pins[good]] = chosen[good]
            if (new == found).all():
                break
            found = new
        return found
