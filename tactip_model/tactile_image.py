"""Conversion of a grey frame, simulated or real, to the tactile image that the network receives."""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from tactip_twin.tactip_model.design import TactileImage
from tactip_twin.tactip_model.errors import TactipError


def binary_frame(frame: ArrayLike, threshold: tuple[int, float] | None) -> np.ndarray:
    """Convert a camera frame to a binary image (h, w) uint8, pins white.

    Args:
        frame: (h, w) uint8 grey, or (h, w, 3) uint8 BGR.
        threshold: Block and constant as in design.TactileImage; None for conversion to grey only.

    Raises:
        TactipError: The frame has another type or shape, or the block is even or below 3.
    """
    frame = np.asarray(frame)
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or (frame.ndim == 3 and frame.shape[2] != 3):
        raise TactipError(
            f"a frame must be uint8, (height, width) grey or (height, width, 3) colour, got {frame.dtype} {frame.shape}"
        )
    if frame.ndim == 3:
        frame = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if threshold is not None:
        block, constant = threshold
        if block % 2 == 0 or block < 3:
            raise TactipError(f"the threshold block must be odd and at least 3 px, got {block}")
        # As cv2.adaptiveThreshold with ADAPTIVE_THRESH_MEAN_C, in half of the time.
        mean, limit = cv2.blur(frame, (block, block), borderType=cv2.BORDER_REPLICATE), -math.ceil(constant)
        if limit >= 0:
            frame = cv2.threshold(cv2.subtract(frame, mean), limit, 255, cv2.THRESH_BINARY)[1]
        else:
            frame = cv2.threshold(cv2.subtract(mean, frame), -limit - 1, 255, cv2.THRESH_BINARY_INV)[1]
    return frame


def tactile_image(frame: ArrayLike, settings: TactileImage) -> np.ndarray:
    """Threshold, unless grey levels are kept, crop and subsample a frame.

    Args:
        frame: (h, w) uint8 grey, or (h, w, 3) uint8 BGR.
        settings: Threshold, crop, size, and whether to keep grey levels.

    Returns:
        The tactile image (size_px, size_px) uint8, pins white; values 0 and 255 only, unless grey levels are kept.

    Raises:
        TactipError: The frame has another type or shape, or the crop or threshold does not fit it.
    """
    image = binary_frame(frame, None if settings.grey else settings.threshold)
    if settings.crop is not None:
        left, top, right, bottom = settings.crop
        height, width = image.shape
        if not (0 <= left < right <= width and 0 <= top < bottom <= height):
            raise TactipError(
                f"the crop (left, top, right, bottom) must lie within the frame of {width}×{height} px, got {settings.crop}"
            )
        image = image[top:bottom, left:right]
    shrink = settings.size_px <= min(image.shape)
    size = (settings.size_px, settings.size_px)
    # OpenCV is slow where pixels are divided.
    if shrink and settings.threshold is not None and not settings.grey and any(n % settings.size_px for n in image.shape):
        return _mostly_white(image, settings.size_px)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    return small if settings.grey else cv2.threshold(small, 127, 255, cv2.THRESH_BINARY)[1]


def _mostly_white(image: np.ndarray, size: int) -> np.ndarray:
    """Return an image (size, size) uint8, 0 and 255, of a larger binary one (h, w): a pixel is white where at least half of
    what it covers is. The same as cv2.resize with INTER_AREA and a threshold of one half, but for rounding; from 360 to 128
    px, in a third of the time [M]."""
    (height, rows), (width, columns) = (_overlaps(count, size) for count in image.shape)
    parts = np.uint16 if height * width <= np.iinfo(np.uint16).max else np.uint32
    white = rows[parts] @ (image & 1).astype(parts)
    white = np.ascontiguousarray((columns[parts] @ np.ascontiguousarray(white.T)).T)
    half = (height * width + 1) // 2
    return np.where(white < half, np.uint8(0), np.uint8(255))


@lru_cache(maxsize=16)
def _overlaps(count: int, size: int) -> tuple[int, dict[type, csr_array]]:
    """Return how far each of `size` equal parts of a row of `count` pixels overlaps with each pixel, in whole numbers, as
    sparse matrices (size, count) by their type, and the sum of a part."""
    part, pixel = count // math.gcd(count, size), size // math.gcd(count, size)
    parts, pixels = part * np.arange(size)[:, None], pixel * np.arange(count)
    overlap = np.maximum(np.minimum(parts + part, pixels + pixel) - np.maximum(parts, pixels), 0)
    return part, {kind: csr_array(overlap.astype(kind)) for kind in (np.uint16, np.uint32)}
