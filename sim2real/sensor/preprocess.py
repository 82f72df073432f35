"""A laboratory's frames as binary tactile images: read, mirrored, turned, thresholded, masked and cropped."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.sim2real.sensor.video_frames import FILMS, frame_of
from tactip_twin.tactip_model.design import TactileImage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mask import pin_area, pins_of
from tactip_twin.tactip_model.tactile_image import binary_frame, tactile_image

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""Endings of files that are taken for images."""

_OBLONG = 0.05
"""How far from square what is used of a frame may be; published crops are off by 1.5 % [M]."""

_GREY, _MOST_GREY = (24, 232), 0.25
"""Pixels from one value to the other are neither black nor white; a binary frame has fewer of them than this share, also one
that was made smaller (3 % [M]) or kept as JPEG; an estimate between that and the 97 % of a grey one [?]."""

_ROOM = 1.28
"""Half of the width of a frame, in distances of the outermost pins from the middle, as the presets' cameras have it."""


def load(path, film_frame=-1):
    """A frame (h, w, 3) uint8: an image, or one of a film. film_frame: int, as sim.sensor_film.frame_of has it.

    Raises TactipError where it cannot be read.
    """
    if not Path(path).is_file():
        raise TactipError("it does not exist")
    if Path(path).suffix.lower() in FILMS:
        return frame_of(path, film_frame)
    frame = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if frame is None:
        raise TactipError("it cannot be read as an image")
    return frame


def load_neutral(path):
    """The neutral image (h, w, 3) uint8. Raises TactipError where it cannot be read."""
    try:
        return load(path)
    except TactipError as error:
        raise TactipError(f"the neutral image {path}: {error}") from error


def check_frame(frame: np.ndarray, options: ImagePreprocessing) -> None:
    """Raise TactipError, with the option that helps, where a frame is grey and the options take it for binary.

    frame: (h, w[, 3]) uint8.
    """
    if options.threshold is not None:
        return
    low, high = _GREY
    share = ((frame >= low) & (frame < high)).mean()
    if share > _MOST_GREY:
        block = min(frame.shape[:2]) // 6 | 1
        raise TactipError(
            f"{share:.0%} of its pixels are neither black nor white: frames must be binary, or give --threshold {block} -5 "
            "(width of the block whose mean a pixel is compared with, and by how much a pin is brighter, negative)"
        )


def _crop_round_pins(binary):
    """What a crop should be, in words; with numbers, if pins are seen in a binary frame (h, w)."""
    try:
        pins = pins_of(binary)
    except TactipError:
        return "LEFT TOP RIGHT BOTTOM"
    low, high = pins.min(0), pins.max(0)
    middle = (low + high) / 2
    height, width = binary.shape
    ends = np.array([width, height]) - 1
    half = min(_ROOM * np.linalg.norm(pins - middle, axis=1).max(), *middle, *(ends - middle))
    left, top, right, bottom = np.rint([*(middle - half), *(middle + half + 1)]).astype(int)
    return f"{left} {top} {right} {bottom}, which has the pins in its middle"


class FrameReader:
    """Binary tactile images of a laboratory's frames: mirrored, turned, thresholded, masked and cropped, in this order."""

    def __init__(self, options: ImagePreprocessing, neutral: np.ndarray | None = None, others=()):
        """neutral: (h, w[, 3]) uint8, the undeformed tip, or None; then others, frames, tell where pins are.

        Raises TactipError where that cannot be told and is needed.
        """
        self._options, self._mask = options, None
        # Nothing is thresholded twice, and a crop is of the frame as it comes out of the turn.
        self._image = TactileImage(crop=options.crop, threshold=None, size_px=options.size_px)
        self.shape = None if neutral is None else neutral.shape[:2]
        """Height and width of a frame, px; None until one was seen."""
        if options.mask == "pins":
            # In pressed frames the pins have gone outward already.
            told, margin = ([neutral], 1.0) if neutral is not None else (others, 0.5)
            self._mask = pin_area((self.binary(frame) for frame in told), margin)

    def binary(self, frame):
        """Binary frame (h, w) uint8, pins white, upright; not cropped and not masked. frame: (h, w[, 3]) uint8."""
        frame = frame[:, ::-1] if self._options.mirrored else frame
        frame = _turned(np.ascontiguousarray(frame), self._options.image_turn_deg)
        if self._options.dark:
            frame = 255 - frame
        return binary_frame(frame, self._options.threshold)

    def masked(self, frame):
        """Binary frame (h, w) with what is outside of the pins black. Raises TactipError on a frame of another size."""
        if self.shape is None:
            self.shape = frame.shape[:2]
        if frame.shape[:2] != self.shape:
            one, other = (f"{w} by {h} px" for h, w in (frame.shape[:2], self.shape))
            raise TactipError(f"it is {one}, the others are {other}")
        binary = self.binary(frame)
        return binary if self._mask is None else np.where(self._mask, binary, 0).astype(np.uint8)

    def read(self, frame):
        """The tactile image (size, size) of a frame. Raises TactipError where it does not fit."""
        return self.shrunk(self.masked(frame))

    def shrunk(self, binary):
        """The tactile image (size, size) of a `masked` frame."""
        return self._square(binary, self._image.size_px)

    def with_rim(self, frame):
        """The frame as large as it came, cropped, with what is outside of the pins."""
        return self.cropped(self.binary(frame))

    def cropped(self, binary):
        """A `masked` frame as large as it came."""
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        return self._square(binary, min(right - left, bottom - top))

    def _square(self, binary, size):
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        if abs((right - left) / max(bottom - top, 1) - 1) > _OBLONG:
            told = f"what is used of it is {right - left} by {bottom - top} px, and should be square"
            raise TactipError(f"{told}: give --crop {_crop_round_pins(binary)}")
        return tactile_image(binary, replace(self._image, size_px=size))


def _turned(frame, degrees):
    """A frame turned counter-clockwise; by quarters exactly."""
    if degrees % 90 == 0:
        return np.ascontiguousarray(np.rot90(frame, round(degrees / 90)))
    height, width = frame.shape[:2]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    return cv2.warpAffine(frame, turn, (width, height), flags=cv2.INTER_LINEAR)
