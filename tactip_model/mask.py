"""The part of a frame in which pins can appear. Outside it, reflections at the rim of a real sensor are masked."""

from collections.abc import Iterable

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pin_detection import find_blobs

_MIN_PINS = 20
"""Smallest number of pins that locates the pattern in an image."""

_MAX_ISOLATION = 2.2
"""Largest distance of a pin's third neighbour, in medians of such distances; a more isolated blob is a speck at the rim."""


def pin_area(images: Iterable[np.ndarray], margin: float = 1.0) -> np.ndarray:
    """Return the part of the frame (h, w) bool in which the pins of some binary images lie, pressed or not.

    Args:
        images: Binary images (h, w) uint8, pins white.
        margin: Growth of the pins' convex hull, in spacings of the outermost pins. These move outward by a third of a
            spacing when the tip is pressed [M].

    Raises:
        TactipError: Fewer than 20 pins are detected in every image.
    """
    area, max_pins = None, 0
    for image in images:
        area = np.zeros(image.shape[:2], np.uint8) if area is None else area
        points = _pins(find_blobs(image).centres)
        max_pins = max(max_pins, len(points))
        if len(points) < _MIN_PINS:
            continue
        hull = cv2.convexHull(points.astype(np.float32))[:, 0]
        spacing = np.median(cKDTree(points).query(hull, 2)[0][:, 1])
        grown = np.zeros_like(area)
        cv2.fillConvexPoly(grown, np.rint(hull).astype(np.int32), 1)
        reach = round(margin * spacing)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        area = np.maximum(area, cv2.dilate(grown, disc))
    if area is None or not area.any():
        raise TactipError(f"at least {_MIN_PINS} pins must be detected in an image, got {max_pins}")
    return area.astype(bool)


def detect_pins(image: np.ndarray) -> np.ndarray:
    """Return the positions (n, 2) px of the pins in a binary image (h, w) uint8; raise TactipError if there are too few."""
    points = _pins(find_blobs(image).centres)
    if len(points) < _MIN_PINS:
        raise TactipError(f"at least {_MIN_PINS} pins must be detected in an image, got {len(points)}")
    return points


def _pins(centres: np.ndarray) -> np.ndarray:
    """Return those of the blob centres (n, 2) that have neighbours."""
    if len(centres) < _MIN_PINS:
        return centres
    third = cKDTree(centres).query(centres, 4)[0][:, 3]
    return centres[third < _MAX_ISOLATION * np.median(third)]
