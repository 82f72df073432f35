"""A grey frame, simulated or real, to the binary tactile image that the network sees."""

import cv2
import numpy as np

from tactip_twin.tactip_model.errors import TactipError


def binary_frame(frame, threshold):
    """A camera's frame with the pins white (h, w) uint8.

    frame: (h, w) uint8 grey, or (h, w, 3) uint8 BGR. threshold: block and constant as in design.TactileImage, or None: the
    frame is only made grey. Raises TactipError on a frame of another type or shape, and a block that does not do.
    """
    frame = np.asarray(frame)
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or (frame.ndim == 3 and frame.shape[2] != 3):
        raise TactipError(
            f"a frame of {frame.dtype} {frame.shape} is no camera image: it must be uint8, (height, width) grey or "
            "(height, width, 3) colour"
        )
    if frame.ndim == 3:
        frame = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if threshold is not None:
        block, constant = threshold
        if block % 2 == 0 or block < 3:
            raise TactipError(f"a threshold block of {block} px does not do: it must be odd and at least 3")
        frame = cv2.adaptiveThreshold(frame, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, constant)
    return frame


def tactile_image(frame, settings):
    """Threshold, crop and subsample a frame.

    frame: (h, w) uint8 grey, or (h, w, 3) uint8 BGR. settings: design.TactileImage.
    Returns (size_px, size_px) uint8, values 0 and 255 only, pins white.
    Raises TactipError on a frame of another type or shape, and on a crop or threshold that does not fit it.
    """
    frame = binary_frame(frame, settings.threshold)
    if settings.crop is not None:
        left, top, right, bottom = settings.crop
        height, width = frame.shape
        if not (0 <= left < right <= width and 0 <= top < bottom <= height):
            raise TactipError(
                f"a crop of left, top, right, bottom {settings.crop} does not fit a frame of {width} by {height} px"
            )
        frame = frame[top:bottom, left:right]
    shrink = settings.size_px <= min(frame.shape)
    size = (settings.size_px, settings.size_px)
    small = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    return np.where(small > 127, 255, 0).astype(np.uint8)
