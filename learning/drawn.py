"""Training images drawn as training runs, from the pins of simulated contacts, under varied cameras and lights.

Physics once, optics many: what differs between two sensors of a kind, and between today and tomorrow, is where the camera
sits, how large its pins appear and where the threshold falls. And a pin of two or three pixels falls among them by chance: a
network that always sees the same image of a contact learns that chance by heart.

A pin is a disc here, and a pixel is white if its middle lies on one; the discs grow by what makes as many pixels white as
the set's own images have. That is 50 times faster than a frame and its pipeline, and nine of ten white pixels are the same.
"""

import zipfile
from dataclasses import dataclass

import numpy as np
import torch

from tactip_model.bounds import check, within
from tactip_model.design_file import design_from
from tactip_model.errors import TactipError
from tactip_model.raster import Raster

_BLOCK = 256
"""Images whose pins are projected, and compared, at a time."""


@dataclass(frozen=True)
class OpticsRanges:
    """How far the optics of a design are varied from image to image; uniform."""

    zoom: float = within(0, 0.1, default=0.012)
    """Size of the image, either way, -; 1 % was seen between a neutral image and the frames after it [M]."""
    turn_deg: float = within(0, 10, default=0.5)
    """Turn of the image about its middle, either way [?]."""
    drift: float = within(0, 0.05, default=0.008)
    """Place of the image, either way, in its widths [?]."""
    pin_size: float = within(0, 0.5, default=0.12)
    """Diameter of the pins, either way, of theirs: their make, light and threshold [?]."""

    def __post_init__(self):
        check(self)


class DrawnImages:
    """The images of a set's samples, drawn anew whenever they are asked for."""

    def __init__(self, samples, share=1.0, ranges=OpticsRanges(), device="cpu"):
        """samples: Samples of a simulated set. share: float, of the `ranges` (OpticsRanges) that is used. device: str.

        Raises TactipError where the set has no pins.
        """
        tips, directions = _pins_of(samples)
        design = design_from(samples.dataset.meta["configuration"]["design"], f"{samples.folder}: design")
        centres, radii = _discs(tips, directions, design, samples.size)
        self._size, self._device = samples.size, device
        self._centres, self._radii = torch.from_numpy(centres).to(device), torch.from_numpy(radii).to(device)
        widths = share * np.array([ranges.zoom, ranges.turn_deg * np.pi / 180, ranges.drift * self._size, ranges.pin_size])
        self._zoom, self._turn, self._drift, self._pin_size = widths.tolist()
        self._growth = self._fit_growth(samples.images[:_BLOCK])

    def draw(self, chosen):
        """Images (m, size, size) uint8 of samples `chosen` (m,) int, under optics that torch's generator draws."""
        zoom, turn, right, down, size = (2 * torch.rand(5, len(chosen), 1, device=self._device) - 1).unbind()
        middle = (self._size - 1) / 2
        x, y = (self._centres[chosen] - middle).unbind(-1)
        zoom, turn = 1 + self._zoom * zoom, self._turn * turn
        cos, sin = zoom * torch.cos(turn), zoom * torch.sin(turn)
        x, y = cos * x - sin * y + self._drift * right, sin * x + cos * y + self._drift * down
        return self._paint(
            torch.stack([x, y], -1) + middle, (self._radii[chosen] + self._growth) * (1 + self._pin_size * size)
        )

    def plain(self, chosen):
        """Images (m, size, size) uint8 of samples `chosen` under the design's own optics."""
        return self._paint(self._centres[chosen], self._radii[chosen] + self._growth)

    def _paint(self, centres, radii):
        """Images (m, size, size) uint8 with discs (m, p, 2) px and radii (m, p) px."""
        reach = int(np.ceil(float(radii.max()))) if radii.numel() else 1
        span = torch.arange(-reach, reach + 1, device=self._device)
        offsets = torch.stack(torch.meshgrid(span, span, indexing="xy"), -1).reshape(-1, 2)
        near = torch.round(centres)
        away = (near - centres)[:, :, None] + offsets
        pixels = near.long()[:, :, None] + offsets
        white = (away.square().sum(-1) < radii.square()[:, :, None]) & ((pixels >= 0) & (pixels < self._size)).all(-1)
        images = torch.zeros(len(centres), self._size**2, dtype=torch.uint8, device=self._device)
        which = torch.arange(len(centres), device=self._device)[:, None, None] * self._size**2
        images.view(-1)[(which + pixels[..., 1] * self._size + pixels[..., 0])[white]] = 255
        return images.view(-1, self._size, self._size)

    def _fit_growth(self, images):
        """What is added to the radii, px, so that as many pixels are white as in plain `images`; by bisection."""
        wanted, low, high = int((images > 127).sum()), -1.0, 1.5
        chosen = torch.arange(len(images), device=self._device)
        for _ in range(12):
            self._growth = (low + high) / 2
            few = int((self.plain(chosen) > 127).sum()) < wanted
            low, high = (self._growth, high) if few else (low, self._growth)
        return (low + high) / 2


def _pins_of(samples):
    """Tips and directions (n, p, 3) of Samples."""
    path = samples.folder / "pins.npz"
    try:
        with np.load(path, allow_pickle=False) as pins:
            tips, directions = pins["tips"], pins["directions"]
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TactipError(
            f"{path} cannot be read ({error}): only simulated sets, which have pins, can be drawn anew"
        ) from error
    count = len(samples.dataset.images)
    if len(tips) != count:
        raise TactipError(f"{path} has {len(tips)} records for {count} images: the set is damaged")
    return tips[samples.rows], directions[samples.rows]


def _discs(tips, directions, design, size):
    """Middles (n, p, 2) and radii (n, p) of the pins in tactile images `size` px wide, px, float32."""
    raster = Raster(design)
    left, top, right, bottom = design.image.crop or (0, 0, design.optics.frame_px, design.optics.frame_px)
    scale = size / np.array([right - left, bottom - top])
    centres, radii = np.empty((*tips.shape[:2], 2), np.float32), np.empty(tips.shape[:2], np.float32)
    for k in range(0, len(tips), _BLOCK):
        part = slice(k, k + _BLOCK)
        middle, axes = raster.ellipses(tips[part].astype(float), directions[part].astype(float))
        centres[part] = (middle - (left, top) + 0.5) * scale - 0.5
        radii[part] = np.sqrt(np.abs(np.linalg.det(axes)) * scale.prod())
    return centres, radii
