"""Options that turn a real sensor's frames into tactile images. Light to import, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup

Mask = Literal["pins", "none"]
"""Treatment of the part of a frame outside the pins."""


@dataclass(frozen=True)
class ImagePreprocessing:
    """Steps from a real frame to a tactile image. By default, frames are binary already."""

    rotate_image_deg: float = within(-360, 360, default=0.0)
    """Counter-clockwise rotation of the frames before use, degrees. On an edge it corrects the yaw of a rotated
    camera."""
    mirror: bool = False
    """Mirror the frames left to right before they are rotated."""
    dark_pins: bool = False
    """Frames show dark pins on a light background."""
    crop: tuple[int, int, int, int] | None = within(0, 65536, default=None)
    """Crop of the frame: left, top, right, bottom, px. Default: the whole frame."""
    threshold: tuple[int, float] | None = within((3, -255), (65535, 255), default=None)
    """Block size (px) and constant of the adaptive threshold of grey frames; None for binary frames."""
    size_px: int = within(8, 4096, default=128)
    """Width of the tactile images, px."""
    grey: bool = False
    """Keep the grey levels of the tactile images. The threshold then only serves to detect the pins."""
    mask: Mask = "pins"
    """pins: black out what lies outside the pins, such as light at the rim; none: keep it."""

    def __post_init__(self) -> None:
        check(self)
        lookup("mask", self.mask, dict.fromkeys(get_args(Mask)))
