"""Options of a real sensor's frames: how they become binary tactile images. Light to import, for the command line."""

from dataclasses import dataclass
from typing import Literal, get_args

from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import lookup

Mask = Literal["pins", "none"]
"""What happens to the part of a frame outside the pins."""


@dataclass(frozen=True)
class ImagePreprocessing:
    """Steps from a real frame to a tactile image. By default, frames are binary already."""

    rotate_image_deg: float = within(-360, 360, default=0.0)
    """Turn of the frames before they are used, degrees, counter-clockwise: for an edge, whose yaw the camera's turn would
    shift."""
    mirror: bool = False
    """Whether the frames are mirror images, left for right; undone before they are turned."""
    dark_pins: bool = False
    """Whether the pins are dark on light."""
    crop: tuple[int, int, int, int] | None = within(0, 65536, default=None)
    """Left, top, right, bottom of the part of the frame that is used, px; all if not given."""
    threshold: tuple[int, float] | None = within((3, -255), (65535, 255), default=None)
    """Block and constant of the adaptive threshold of grey frames; None for frames that are binary."""
    size_px: int = within(8, 4096, default=128)
    """Width of the images that are made, px."""
    mask: Mask = "pins"
    """pins: what is outside of the pins is made black (light at the rim); none: it stays."""

    def __post_init__(self) -> None:
        check(self)
        lookup("mask", self.mask, dict.fromkeys(get_args(Mask)))
