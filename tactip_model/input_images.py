"""Reading images that may be damaged or malicious: format and size are checked before decoding."""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import read_file

MAX_PIXELS = 2**26
"""Maximum number of pixels of an image: a frame of 8192 by 8192."""

_IMAGE_FORMATS = ("PNG", "JPEG", "BMP", "TIFF")


def decode_image(data: bytes, name: str, color: bool = False) -> np.ndarray:
    """Return the image in the bytes of a PNG, JPEG, BMP or TIFF file: (h, w) uint8, or (h, w, 3) in color.

    Args:
        data: Content of the file.
        name: Name of the file, for messages.
        color: Whether it is read in color.
    """
    try:
        with warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning):
            width, height = Image.open(io.BytesIO(data), formats=_IMAGE_FORMATS).size
    except Image.DecompressionBombError:
        raise TactipError(f"{name} must have at most {MAX_PIXELS} pixels") from None
    except Exception as error:  # Pillow has no specific error for a damaged header
        raise TactipError(f"{name} cannot be read as an image") from error
    if width * height > MAX_PIXELS:
        raise TactipError(f"{name} must have at most {MAX_PIXELS} pixels, got {width} by {height}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR if color else cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise TactipError(f"{name} cannot be read as an image: {error.err}") from error
    if image is None:
        raise TactipError(f"{name} cannot be read as an image")
    return image


def read_image(path: str | Path, color: bool = False) -> np.ndarray:
    """Return the image in a PNG, JPEG, BMP or TIFF file: (h, w) uint8, or (h, w, 3) in color."""
    return decode_image(read_file(path), str(path), color)
