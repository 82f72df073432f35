"""Where in a frame the pins can be: outside of it, light at the rim of a real sensor is left out of the image."""

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pin_detection import find_blobs

_FEWEST = 20
"""Blobs below which an image does not tell where the pins are."""

_LONELY = 2.2
"""A blob whose third neighbour is farther off than this, in medians of such distances, is no pin: a speck at the rim."""


def pin_area(images, margin=1.0):
    """Part of the frame (h, w) bool in which the pins of some binary images lie, pressed or not.

    images: iterable of (h, w) uint8, pins white. margin: float, spacings of the outermost pins by which their convex
    hull is grown: they go outward by a third of one when the tip is pressed [M]. Raises TactipError where pins are not seen.
    """
    area, most = None, 0
    for image in images:
        area = np.zeros(image.shape[:2], np.uint8) if area is None else area
        points = _pins(find_blobs(image).centres)
        most = max(most, len(points))
        if len(points) < _FEWEST:
            continue
        hull = cv2.convexHull(points.astype(np.float32))[:, 0]
        spacing = np.median(cKDTree(points).query(hull, 2)[0][:, 1])
        grown = np.zeros_like(area)
        cv2.fillConvexPoly(grown, np.rint(hull).astype(np.int32), 1)
        reach = round(margin * spacing)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        area = np.maximum(area, cv2.dilate(grown, disc))
    if area is None or not area.any():
        raise TactipError(f"at most {most} pins are seen in an image: at least {_FEWEST} are needed to tell where they are")
    return area.astype(bool)


def pins_of(image):
    """Where the pins of a binary image (h, w) uint8 are: (n, 2) px. Raises TactipError where they are too few to tell."""
    points = _pins(find_blobs(image).centres)
    if len(points) < _FEWEST:
        raise TactipError(f"{len(points)} pins are seen: at least {_FEWEST} are needed")
    return points


def _pins(centres):
    """Those of centres (n, 2) that have neighbours."""
    if len(centres) < _FEWEST:
        return centres
    third = cKDTree(centres).query(centres, 4)[0][:, 3]
    return centres[third < _LONELY * np.median(third)]
