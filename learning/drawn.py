"""Images drawn as training runs, from the pins of simulated contacts, under varied cameras and lights.

Physics once, optics many: what differs between two sensors of a kind, and between today and tomorrow, is where the camera
sits, how large and bright its pins appear and where the threshold falls. A network that has seen them vary does not mind.
"""

from dataclasses import dataclass, replace

import numpy as np

from tactip_model.bounds import check, within
from tactip_model.design_file import design_from
from tactip_model.errors import TactipError
from tactip_model.image import tactile_image
from tactip_model.raster import Raster

CAMERAS = 24
"""Varied sensors of a training: each image is drawn by one of them, by chance."""

_BLOCK = 256
"""Images that are handed over at a time."""


@dataclass(frozen=True)
class OpticsRanges:
    """How far the optics of a design are varied; uniform."""

    zoom: float = within(0, 0.1, default=0.012)
    """Size of the image, either way, -; 1 % was seen between a neutral image and the frames after it [M]."""
    drift: float = within(0, 0.05, default=0.008)
    """Place of the image, either way, in its widths [?]."""
    pin_size: float = within(0, 0.5, default=0.12)
    """Diameter of the pins' tips, either way, of theirs [?]."""
    blur_px: float = within(0, 5, default=0.3)
    """Blur, either way, px of the frame [?]."""
    exposure: float = within(0, 0.9, default=0.2)
    """Brightness, either way, of its own [?]."""
    threshold: float = within(0, 20, default=2.0)
    """Constant of the threshold, either way, grey levels [?]."""

    def __post_init__(self):
        check(self)

    def vary(self, design, generator):
        """A Design with optics drawn about those of `design` by a numpy Generator."""
        zoom, x, y, size, blur, exposure, threshold = generator.uniform(-1, 1, 7)
        optics, pins, image = design.optics, design.pins, design.image
        grow = 1 + self.pin_size * size
        if image.threshold is not None:
            block, constant = image.threshold
            image = replace(image, threshold=(block, constant + self.threshold * threshold))
        return replace(
            design,
            pins=replace(pins, diameter_m=pins.diameter_m * grow, rim_diameter_m=pins.rim_diameter_m * grow),
            optics=replace(
                optics,
                zoom=optics.zoom * (1 + self.zoom * zoom),
                drift=(optics.drift[0] + self.drift * x, optics.drift[1] + self.drift * y),
                blur_px=max(0.0, optics.blur_px + self.blur_px * blur),
                exposure=optics.exposure * (1 + self.exposure * exposure),
            ),
            image=image,
        )


class DrawnImages:
    """The training images of each epoch: a share of them is drawn anew before each."""

    def __init__(self, samples, seed, every, ranges=OpticsRanges()):
        """samples: Samples of a simulated set. seed: int. every: int, epochs that an image lasts. ranges: OpticsRanges.

        Raises TactipError where the set has no pins.
        """
        path = samples.folder / "pins.npz"
        try:
            with np.load(path, allow_pickle=False) as pins:
                self._tips, self._directions = pins["tips"], pins["directions"]
        except (OSError, ValueError, KeyError) as error:
            raise TactipError(
                f"{path} cannot be read ({error}): only simulated sets, which have pins, can be drawn anew"
            ) from error
        if len(self._tips) != len(samples):
            raise TactipError(f"{path} has {len(self._tips)} records for {len(samples)} images: the set is damaged")
        design = design_from(samples.dataset.meta["configuration"]["design"], f"{samples.folder}: design")
        self._seed, self._every, self._drawn = seed, every, False
        cameras = [ranges.vary(design, self._generator(0, k)) for k in range(CAMERAS)]
        self._eyes = [(Raster(camera), camera.image) for camera in cameras]

    def _generator(self, *key):
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=(1, *key))))

    def image(self, index, epoch):
        """Image `index` as it is in an epoch, (size, size) uint8: the same for `every` epochs, then another."""
        turn = (epoch + index) // self._every
        raster, settings = self._eyes[self._generator(1, index, turn).integers(CAMERAS)]
        return tactile_image(raster.render(self._tips[index], self._directions[index]), settings)

    def due(self, epoch):
        """What is new in an epoch: pairs of an index and images (m, size, size) from there on; all at the first call."""
        first, self._drawn = not self._drawn, True
        count = len(self._tips)
        if first:
            for start in range(0, count, _BLOCK):
                yield start, np.stack([self.image(i, epoch) for i in range(start, min(start + _BLOCK, count))])
            return
        for i in range(-epoch % self._every, count, self._every):
            yield i, self.image(i, epoch)[None]
