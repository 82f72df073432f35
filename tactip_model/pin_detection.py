"""Pins in a binary image: the white blobs, and which pin each of them is.

A pressed and sheared tip moves its pins by more than their spacing, so that the nearest blob is often the next pin's. But
neighbours move alike: from one pin that is known, its neighbours are where an affine map of what is known so far puts them,
and the hexagon or disc fits whole in one way only. All blobs near the middle are tried as the first pin's.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay, cKDTree

_GATE = 0.42
"""Distance from where a pin is expected at which a blob may still be it, in spacings of the undeformed pins there."""

_LOCAL = 9
"""Pins from which the affine map of the next one is fitted."""


@dataclass(frozen=True)
class Blobs:
    """White blobs of an image that may be pins."""

    centres: np.ndarray
    """(n, 2) float, px: x to the right, y down; the centre of the top left pixel is (0, 0)."""


def find_blobs(image, largest=2.6, smallest=0.15):
    """Blobs of a binary image that are round enough and of a size with the others.

    image: (h, w) uint8, pins white. largest, smallest: allowed area, in medians of the roundish blobs' areas. Returns
    Blobs. Crescents of light at the rim are long and go; two pins that touch are one long blob and go as well.
    """
    _, centres, area, roundish = _components(image)
    if not roundish.any():
        return Blobs(np.zeros((0, 2)))
    middle = np.median(area[roundish])
    keep = roundish & (area < largest * middle) & (area > smallest * middle)
    return Blobs(centres[keep])


def find_reflections(image):
    """Pixels (h, w) bool of the long white patches of a binary image: light at the rim, that is fixed to the housing."""
    labels, _, area, roundish = _components(image)
    if not roundish.any():
        return np.zeros(np.shape(image), bool)
    long = ~roundish & (area > 2 * np.median(area[roundish]))
    return np.concatenate([[False], long])[labels]


def _components(image):
    """White patches of a binary image: labels (h, w), from 1; centres (n, 2), areas (n,) and whether each is round (n,)."""
    white = (np.asarray(image) > 127).astype(np.uint8)
    count, labels, stats, centres = cv2.connectedComponentsWithStats(white, connectivity=8)
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
        (roundness > 0.45) & (area >= 4) & (np.maximum(width, height) < 0.2 * max(labels.shape)),
    )


class PinMatcher:
    """Tells which blob is which pin, from where the pins are in the undeformed image."""

    def __init__(self, neutral):
        """neutral: (p, 2) float, px, pins of the undeformed image."""
        self.neutral = np.asarray(neutral, float)
        self._middle = int(np.linalg.norm(self.neutral - self.neutral.mean(0), axis=1).argmin())
        triangles = Delaunay(self.neutral).simplices
        self._neighbours = [set() for _ in self.neutral]
        for triangle in triangles:
            for a in triangle:
                self._neighbours[a].update(int(b) for b in triangle if b != a)
        spacing = cKDTree(self.neutral).query(self.neutral, 4)[0][:, 1:].mean(1)
        self._gate = _GATE * spacing
        self._reach = 2.2 * float(np.median(spacing)) + 0.03 * float(np.ptp(self.neutral))

    def match(self, blobs):
        """Positions (p, 2) px of the pins among Blobs; NaN where a pin is not seen. All NaN if none can be told."""
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

    def _expected(self, known, found, centres, pins):
        """Where `pins` (k,) are (k, 2) by the affine map of the nearest known pins, each left out of its own."""
        tree = cKDTree(self.neutral[known])
        _, near = tree.query(self.neutral[pins], min(_LOCAL + 1, len(known)))
        out = np.empty((len(pins), 2))
        for row, (pin, index) in enumerate(zip(pins, np.atleast_2d(near.reshape(len(pins), -1)), strict=True)):
            sources = known[index]
            sources = sources[sources != pin][:_LOCAL]
            offset = self.neutral[sources] - self.neutral[pin]
            moved = centres[found[sources]] - self.neutral[sources]
            # A little ridge on the gradient: few or collinear pins say where, not how it changes.
            a = np.concatenate([np.ones((len(sources), 1)), offset], 1)
            ridge = np.diag([0.0, 1.0, 1.0]) * 0.05 * (offset**2).sum() / 2
            out[row] = self.neutral[pin] + np.linalg.solve(a.T @ a + ridge + 1e-9 * np.eye(3), a.T @ moved)[0]
        return out

    def _grow(self, tree, first):
        """Blob of each pin (p,) int, -1 unknown, grown from the first pin being blob `first`; and how well it fits."""
        centres = tree.data
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
                # Around the first pin alone nothing is known of the stretch: the gate is wider there.
                gate = self._gate[pin] * (1.6 if len(known) == 1 else 1.0)
                if distance[k] < gate and int(nearest[k]) not in taken:
                    found[pin] = nearest[k]
                    taken.add(int(nearest[k]))
                    misfit += (distance[k] / self._gate[pin]) ** 2
            tried.update(ring)
            ring = sorted({n for pin in tried if found[pin] >= 0 for n in self._neighbours[pin]} - tried)
        return found, (found >= 0).sum() - 0.5 * misfit

    def _settle(self, tree, found):
        """Give each pin the blob nearest to where its neighbours expect it, until nothing changes."""
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
