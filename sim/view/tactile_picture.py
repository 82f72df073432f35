"""The tactile image as it is shown: enlarged, with an arrow from each pin's place at rest to its place now."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_from_dict
from tactip_twin.tactip_model.optics import Lens

SIZE_PX = 384
"""Width up to which small images are enlarged, px."""

_PIN_GREY = 176
"""Grey of the pins under the arrows, which are brighter."""

_ARROW_COLOR = (255, 146, 43)

_USUAL_PX = 128
"""Width of the tactile images for which lengths in px are given; they grow with the width."""

_MIN_ARROW_PX, _HEAD_PX = 0.35, 0.9
"""Displacement below which no arrow is drawn, within the noise of detected pins, and length of an arrow's head, px."""

_STRETCH = 3
"""Factor by which arrows are longer than displacements, most of which are within two pixels."""

ARROW_TEXT = f"arrows: displacement of pins from rest, × {_STRETCH}"

_SHIFT = 4
"""Bits after the point of OpenCV's coordinates."""


class PinProjection:
    """Projects the pins of a design to its tactile image."""

    def __init__(self, design: Design) -> None:
        """Fit the lens of a design."""
        self._lens, settings = Lens(design), design.image
        left, top, right, bottom = settings.crop or (0, 0, self._lens.width, self._lens.width)
        self._corner = np.array([left, top])
        self._scale = settings.size_px / np.array([right - left, bottom - top])

    def __call__(self, pin_tips: np.ndarray) -> np.ndarray:
        """Return the places (p, 2), px of the tactile image, of pin tips (p, 3), m, sensor frame."""
        return (self._lens.project(pin_tips) + 0.5 - self._corner) * self._scale - 0.5


def pin_projection(record: Mapping[str, Any]) -> PinProjection | None:
    """Return the projection of pins to the images of a recording, from its record; None if that does not hold the design.

    Raises:
        TactipError: If the design is not one.
    """
    if record.get("design") is None:
        return None
    design = design_from_dict(record["design"], "the design of the recording")
    # A network may take images of another width than the design's. The width is 0 if no step has an image.
    width = record["size_px"] or design.image.size_px
    return PinProjection(replace(design, image=replace(design.image, size_px=width)))


def tactile_picture(image: np.ndarray, arrows: np.ndarray | None = None) -> np.ndarray:
    """Return a tactile image (n, n) uint8 enlarged by a whole factor, (m, m, 3) uint8, red, green and blue.

    Args:
        image: (n, n) uint8, pins white.
        arrows: (p, 2, 2) start and end of each arrow, px of the image; NaN for none.
    """
    factor, unit = max(1, SIZE_PX // max(image.shape)), max(image.shape) / _USUAL_PX
    large = np.repeat(np.repeat(image, factor, 0), factor, 1)
    picture = np.repeat(large[..., None], 3, axis=-1)
    if arrows is None:
        return picture
    picture = (picture * (_PIN_GREY / 255)).astype(np.uint8)
    lengths = np.linalg.norm(arrows[:, 1] - arrows[:, 0], axis=1)
    ends = arrows[:, 0] + _STRETCH * (arrows[:, 1] - arrows[:, 0])
    places = (np.stack([arrows[:, 0], ends], 1) + 0.5) * factor - 0.5
    for start, end in np.rint(places[lengths > _MIN_ARROW_PX * unit] * 2**_SHIFT).astype(int):
        _arrow(picture, start, end, _HEAD_PX * unit * factor * 2**_SHIFT)
    return picture


def _arrow(picture: np.ndarray, start: np.ndarray, end: np.ndarray, head: float) -> None:
    """Draw an arrow on a picture; places (2,) and the length of its head in units of 2^-_SHIFT px."""
    along = (end - start) / max(np.linalg.norm(end - start), 1e-9)
    head = min(1.6 * head, 0.6 * float(np.linalg.norm(end - start)))
    across = np.array([-along[1], along[0]])
    cv2.line(picture, start.tolist(), end.tolist(), _ARROW_COLOR, 2, cv2.LINE_AA, _SHIFT)
    for side in (-1, 1):
        wing = np.rint(end - head * along + side * 0.6 * head * across).astype(int)
        cv2.line(picture, end.tolist(), wing.tolist(), _ARROW_COLOR, 1, cv2.LINE_AA, _SHIFT)
