"""Preprocessing of real frames to tactile images: mirror, rotate, threshold, mask and crop."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.sim2real.sensor.video_frames import VIDEOS, frame_of
from tactip_twin.tactip_model.design import TactileImage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_file
from tactip_twin.tactip_model.input_images import decode_image
from tactip_twin.tactip_model.mask import detect_pins, pin_area
from tactip_twin.tactip_model.tactile_image import binary_frame, tactile_image

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
"""File endings of images."""

MIN_PIN_FRACTION = 0.8
"""Fraction of the usual number of pins below which a frame is unusable."""

_MAX_OBLONG = 0.05
"""Maximum deviation of a crop's width over its height from 1; published crops are off by 1.5 % [M]."""

_GREY, _MAX_GREY_FRACTION = (24, 232), 0.25
"""Maximum fraction of pixels of a binary frame that are neither black nor white, allowing for scaling (3 % [M]) and JPEG;
grey frames have 97 %. An estimate [?]."""

_MARGIN = 1.28
"""Half the width of a frame relative to the outermost pins' distance from the middle, as in the presets' cameras."""


def load(path: str | Path, video_frame: int = -1) -> np.ndarray:
    """Return a frame (h, w, 3) uint8: an image, or one frame of a video.

    Args:
        path: Image or video.
        video_frame: Frame of a video: 0 is the first, -1 the last.

    Raises:
        TactipError: If it cannot be read.
    """
    if not Path(path).is_file():
        raise TactipError("it does not exist")
    if Path(path).suffix.lower() in VIDEOS:
        return frame_of(path, video_frame)
    return decode_image(read_file(path), "it", color=True)


def load_neutral(path: str | Path) -> np.ndarray:
    """Return the neutral image (h, w, 3) uint8. Raises TactipError if it cannot be read."""
    try:
        return load(path)
    except TactipError as error:
        raise TactipError(f"the neutral image {path}: {error}") from error


def check_frame(frame: np.ndarray, options: ImagePreprocessing) -> None:
    """Check that a frame (h, w[, 3]) uint8 is binary, or a threshold is set.

    Raises:
        TactipError: If it is grey and no threshold is set; the message names the option that helps.
    """
    if options.threshold is not None:
        return
    low, high = _GREY
    grey = ((frame >= low) & (frame < high)).mean()
    if grey > _MAX_GREY_FRACTION:
        block = min(frame.shape[:2]) // 6 | 1
        raise TactipError(
            f"{grey:.0%} of its pixels are neither black nor white: frames must be binary, or give --threshold {block} -5 "
            "(block width in px, and minus the brightness of a pin above the mean of its block)"
        )


def _crop_round_pins(binary: np.ndarray) -> str:
    """Return a suitable crop of a binary frame (h, w) as text, with numbers if pins are detected."""
    try:
        pins = detect_pins(binary)
    except TactipError:
        return "LEFT TOP RIGHT BOTTOM"
    low, high = pins.min(0), pins.max(0)
    middle = (low + high) / 2
    height, width = binary.shape
    ends = np.array([width, height]) - 1
    half = min(_MARGIN * np.linalg.norm(pins - middle, axis=1).max(), *middle, *(ends - middle))
    left, top, right, bottom = np.rint([*(middle - half), *(middle + half + 1)]).astype(int)
    return f"{left} {top} {right} {bottom}, which centers the pins"


class FrameReader:
    """Converts real frames to tactile images: mirrors, rotates, thresholds, masks and crops them, in this order."""

    def __init__(
        self, options: ImagePreprocessing, neutral: np.ndarray | None = None, others: Iterable[np.ndarray] = ()
    ) -> None:
        """Prepare the mask.

        Args:
            options: Steps of the preprocessing.
            neutral: (h, w[, 3]) uint8, image of the undeformed tip, if there is one.
            others: Frames that locate the pins if there is no neutral image.

        Raises:
            TactipError: If a mask is needed and no pins are detected.
        """
        self._options = options
        # The frame is thresholded already, and the crop applies to the rotated frame.
        self._image = TactileImage(crop=options.crop, threshold=None, size_px=options.size_px)
        self.shape = None if neutral is None else neutral.shape[:2]
        """Height and width of a frame, px; None before the first."""
        self._like = "the others" if neutral is None else "the neutral image"
        self._mask = None
        if options.mask == "pins":
            # In pressed frames the pins have already moved outward.
            frames, margin = ([neutral], 1.0) if neutral is not None else (others, 0.5)
            self._mask = pin_area((self.binary(frame) for frame in frames), margin)

    def binary(self, frame: np.ndarray) -> np.ndarray:
        """Return a frame (h, w[, 3]) as binary frame (h, w) uint8, pins white, upright; neither cropped nor masked."""
        return binary_frame(self._upright(frame), self._options.threshold)

    def _upright(self, frame: np.ndarray) -> np.ndarray:
        """Return a frame (h, w[, 3]) mirrored and rotated, pins light."""
        frame = frame[:, ::-1] if self._options.mirror else frame
        frame = _turned(np.ascontiguousarray(frame), self._options.rotate_image_deg)
        return 255 - frame if self._options.dark_pins else frame

    def masked(self, frame: np.ndarray) -> np.ndarray:
        """Return the binary frame (h, w), black outside the pins. Raises TactipError on a frame of another size."""
        if self.shape is None:
            self.shape = frame.shape[:2]
        if frame.shape[:2] != self.shape:
            one, other = (f"{w}×{h} px" for h, w in (frame.shape[:2], self.shape))
            raise TactipError(f"it must be {other} like {self._like}, got {one}")
        binary = self.binary(frame)
        return binary if self._mask is None else np.where(self._mask, binary, 0).astype(np.uint8)

    def read(self, frame: np.ndarray) -> np.ndarray:
        """Return the tactile image (size, size) of a frame. Raises TactipError if the frame is unusable."""
        return self.tactile(frame, self.masked(frame))

    def tactile(self, frame: np.ndarray, binary: np.ndarray) -> np.ndarray:
        """Return the tactile image (size, size) of a frame, grey if the options say so. binary: the `masked` frame."""
        if not self._options.grey:
            return self.shrunk(binary)
        grey = binary_frame(self._upright(frame), None)
        grey = grey if self._mask is None else np.where(self._mask, grey, 0).astype(np.uint8)
        return self._square(grey, self._image.size_px, grey=True)

    def shrunk(self, binary: np.ndarray) -> np.ndarray:
        """Return the binary tactile image (size, size) of a `masked` frame."""
        return self._square(binary, self._image.size_px)

    def on_image(self, places: np.ndarray, binary: np.ndarray) -> np.ndarray:
        """Return the places (..., 2), px, on the tactile image of places on a `masked` frame (h, w)."""
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        return (places + 0.5 - (left, top)) * self._image.size_px / (right - left, bottom - top) - 0.5

    def with_rim(self, frame: np.ndarray) -> np.ndarray:
        """Return the binary frame in its own resolution, cropped but not masked."""
        return self.cropped(self.binary(frame))

    def cropped(self, binary: np.ndarray) -> np.ndarray:
        """Return a `masked` frame in its own resolution, cropped."""
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        return self._square(binary, min(right - left, bottom - top))

    def uncropped(self, part: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Return a binary frame of a `shape` (h, w), uint8, that is black but for its `cropped` part."""
        left, top, right, bottom = self._image.crop or (0, 0, *shape[::-1])
        out = np.zeros(shape, np.uint8)
        out[top:bottom, left:right] = cv2.resize(part, (right - left, bottom - top), interpolation=cv2.INTER_NEAREST)
        return out

    def _square(self, binary: np.ndarray, size: int, grey: bool = False) -> np.ndarray:
        left, top, right, bottom = self._image.crop or (0, 0, *binary.shape[::-1])
        if abs((right - left) / max(bottom - top, 1) - 1) > _MAX_OBLONG:
            problem = f"the used part of the frame must be square, got {right - left}×{bottom - top} px"
            raise TactipError(f"{problem}: give --crop {_crop_round_pins(binary)}")
        return tactile_image(binary, replace(self._image, size_px=size, grey=grey))


def _turned(frame: np.ndarray, degrees: float) -> np.ndarray:
    """Return a frame rotated counter-clockwise; multiples of 90 degrees are exact."""
    if degrees % 90 == 0:
        return np.ascontiguousarray(np.rot90(frame, round(degrees / 90)))
    height, width = frame.shape[:2]
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    return cv2.warpAffine(frame, turn, (width, height), flags=cv2.INTER_LINEAR)
