"""Whether images are like those that a network learned: pins, white area and their places against the neutral image.

The neutral image is rendered from the design that the training records, so nothing else is kept with a network. Contacts
move pins, tilt them and hide some, within limits that were measured (docs/uncertainty.md).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_from_dict
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

if TYPE_CHECKING:
    from tactip_twin.learning.model import Model

MAX_UNLIKE_FRACTION = 0.1
"""Fraction of images unlike those that were learned above which a network does not fit a set. An estimate [?]."""

_MAX_IMAGES = 200
"""Number of images of a set that are looked at, evenly spread."""

_SECTORS = 6
"""Number of sectors of the image about the middle of the pins, for the emptiest one: a lens may be covered on one side."""


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of a tactile image, each over that of the neutral image."""

    pins: float
    """Number of detected pins, -."""
    white: float
    """Number of white pixels, -."""
    spacing: float
    """Median distance of a pin from the nearest other one, -."""
    emptiest: float
    """White pixels in the emptiest sector of the image, over those in a mean sector of the neutral image, -."""


_LIMITS = {"pins": (0.75, 1.4), "white": (0.7, 1.6), "spacing": (0.8, 1.25), "emptiest": (0.6, 1.8)}
"""Limits of each statistic within which an image is like those that were learned [M]."""

_WORDS = {
    "pins": "the number of pins",
    "white": "the white area",
    "spacing": "the spacing of the pins",
    "emptiest": "the white area of the emptiest sector",
}


class ImageCheck:
    """Comparison of images with those that a network learned."""

    def __init__(self, neutral: np.ndarray) -> None:
        """Take the neutral image of the training's sensor, (size, size) uint8."""
        self._centre = np.argwhere(neutral > 127).mean(0)
        self._neutral = _raw(neutral, self._centre)

    def statistics(self, image: np.ndarray) -> ImageStatistics:
        """Return the statistics of an image, (size, size) uint8."""
        values = _raw(image, self._centre)
        return ImageStatistics(*(float(v) for v in values / np.maximum(self._neutral, 1e-9)))

    def problem(self, image: np.ndarray) -> str:
        """Return the statistic of an image (size, size) that is farthest outside of its limits, in words; empty if none."""
        found = self.statistics(image)
        factors = {}
        for name, (low, high) in _LIMITS.items():
            value = max(getattr(found, name), 1e-9)
            factors[name] = max(low / value, value / high)
        worst = max(factors, key=lambda name: factors[name])
        return _WORDS[worst] if factors[worst] > 1 else ""

    def of(self, images: np.ndarray) -> tuple[float, str]:
        """Return the fraction of images unlike those that were learned, and in what most of them differ, in words.

        Args:
            images: (n, size, size) uint8; some of them are looked at.
        """
        chosen = np.unique(np.linspace(0, len(images) - 1, _MAX_IMAGES).astype(int))
        problems = [problem for problem in (self.problem(images[i]) for i in chosen) if problem]
        return len(problems) / len(chosen), max(_WORDS.values(), key=problems.count) if problems else ""


def design_of(model: "Model") -> Design | None:
    """Return the design of the sensor on whose images a network was trained; None where that is not recorded."""
    return recorded_design(model.provenance.get("train", {}).get("configuration"))


def recorded_design(configuration: Any) -> Design | None:
    """Return the design in the configuration of a set (a JSON value); None if it has none, because its frames are real."""
    if not isinstance(configuration, dict) or "design" not in configuration:
        return None
    return design_from_dict(configuration["design"], "the design of the training")


def image_check(model: "Model") -> ImageCheck | None:
    """Return the check of a network's images; None where its training records no design, or grey images or of another
    size."""
    design = design_of(model)
    if design is None or design.image.size_px != model.size or design.image.grey:
        return None
    return ImageCheck(tactile_image(Raster(design).render(*neutral_pins(design)), design.image))


MAX_APART_PX = 2.0
"""Distance of the pins at rest from those that a network learned, px of 256, above which the sensor or its camera is another
one: 0.0 px for the tips of shipped networks, 3.5 to 6.4 px for 40 other tips [M]."""


def pins_apart_px(design: Design, centres_px: np.ndarray) -> float:
    """Return the median distance of a tip's pins at rest from the nearest ones of a design, px of 256.

    Args:
        design: The design.
        centres_px: (n, 2) px of a 256 px image, n > 0, the pins of the neutral image.
    """
    return float(np.median(cKDTree(neutral_px(design)).query(centres_px)[0]))


def _raw(image: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the statistics of an image (size, size) before they are divided, (4,). centre: (2,) px, row and column."""
    centres = find_blobs(image).centres
    spacing = float(np.median(cKDTree(centres).query(centres, 2)[0][:, 1])) if len(centres) > 1 else 0.0
    places = np.argwhere(image > 127) - centre
    sector = ((np.arctan2(places[:, 0], places[:, 1]) + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    return np.array([len(centres), len(places), spacing, np.bincount(sector, minlength=_SECTORS).min()])
