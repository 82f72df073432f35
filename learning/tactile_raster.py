"""Tactile images of many contacts at once: on a GPU in torch, with the pixels that raster_renderer.py and tactile_image.py
give, and on a CPU by these, which are ten times as fast there."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch

from tactip_twin.learning.pin_projection import PinProjection
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.optics import LedRing, Lens, backdrop
from tactip_twin.tactip_model.raster_renderer import Raster, blur_size
from tactip_twin.tactip_model.tactile_image import tactile_image

_BATCH = 128
"""Number of images that are rendered at once on a GPU."""

_THREAD_BATCH = 8
"""Number of images that a thread renders at once."""


class TactileRaster:
    """Renderer of a design's tactile images."""

    def __init__(self, design: Design, device: str = "cpu") -> None:
        """Prepare the optics and the maps of the image processing.

        Args:
            design: Design of the sensor.
            device: Torch device.

        Raises:
            TactipError: If its images are grey, or have no threshold.
        """
        image, optics = design.image, design.optics
        if image.grey or image.threshold is None:
            raise TactipError("contacts that are drawn in a training are rendered as binary images, but the set's are grey")
        self._design, self._device = design, device
        self._raster, self._projection = Raster(design), PinProjection(design, device)
        self._width = optics.frame_px
        self._backdrop = self._tensor(backdrop(design, Lens(design), LedRing(design))).reshape(-1)
        self._block, self._constant = image.threshold
        left, top, right, bottom = image.crop or (0, 0, self._width, self._width)
        self._rows = self._tensor(_resizing(self._width, top, bottom, image.size_px))
        self._columns = self._tensor(_resizing(self._width, left, right, image.size_px))
        size = blur_size(optics)
        self._blur = self._tensor(cv2.getGaussianKernel(size, optics.blur_px).ravel()) if size > 1 else None

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        """Return values as a float32 tensor on the device."""
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self._device)

    def render(self, pin_tips: np.ndarray, directions: np.ndarray) -> torch.Tensor:
        """Return images (n, size, size) uint8 of pins with tips (n, p, 3), m, and directions (n, p, 3), sensor frame."""
        if self._device == "cpu":
            parts = range(_THREAD_BATCH, len(pin_tips), _THREAD_BATCH)
            with ThreadPoolExecutor(torch.get_num_threads()) as pool:
                images = pool.map(self._images, np.split(pin_tips, parts), np.split(directions, parts))
                return torch.from_numpy(np.concatenate(list(images)))
        return self.render_in_torch(pin_tips, directions)

    def _images(self, pin_tips: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return images (n, size, size) uint8 of pins with tips (n, p, 3) and directions (n, p, 3)."""
        return np.stack([tactile_image(frame, self._design.image) for frame in self._raster.render(pin_tips, directions)])

    def render_in_torch(self, pin_tips: np.ndarray, directions: np.ndarray) -> torch.Tensor:
        """Return the same by torch, for a GPU."""
        images = []
        for start in range(0, len(pin_tips), _BATCH):
            part = slice(start, start + _BATCH)
            tips, towards = (torch.from_numpy(a[part].astype(float)).to(self._device) for a in (pin_tips, directions))
            ellipses, grey = self._projection.ellipses(tips, towards), self._projection.grey(tips, towards)
            images.append(self._process(self._frames(*ellipses, grey)))
        return torch.cat(images)

    def _frames(self, centres: torch.Tensor, axes: torch.Tensor, grey: torch.Tensor) -> torch.Tensor:
        """Return frames (n, w, w) float32, 0 to 255, of ellipses; see Raster for the formulas.

        Args:
            centres: (n, p, 2), px.
            axes: (n, p, 2, 2), half-axes as columns, px.
            grey: (n, p), grey levels, 0 to 255.
        """
        reach = int(axes.square().sum(-1).sqrt().max().ceil()) + 1
        span = torch.arange(-reach, reach + 1, device=self._device)
        nearest = centres.round()
        x, y = nearest[..., :1] + span, nearest[..., 1:] + span
        (p, q), (r, s) = axes.permute(2, 3, 0, 1)[..., None, None]
        size = p * s - q * r
        a, b, c, d = s / size, -q / size, -r / size, p / size
        right, down = (x - centres[..., :1])[..., None, :], (y - centres[..., 1:])[..., :, None]
        u, v = a * right + b * down, c * right + d * down
        length = (u * u + v * v).sqrt()
        gradient = ((a * u + c * v).square() + (b * u + d * v).square()).sqrt()
        cover = (0.5 - (length - 1) * length / gradient.clamp_min(1e-12)).clamp(0, 1)
        cover = torch.where(length < 1e-9, 1.0, cover)
        inside = ((x >= 0) & (x < self._width))[..., None, :] & ((y >= 0) & (y < self._width))[..., :, None]
        cover = torch.where(inside, cover, 0.0)
        cover = cover.float()
        index = y.clamp(0, self._width - 1)[..., :, None] * self._width + x.clamp(0, self._width - 1)[..., None, :]
        count, pixels = len(centres), self._width**2
        index = index.long().reshape(count, -1)
        paint, shade = (torch.zeros(count, pixels, device=self._device) for _ in range(2))
        paint.scatter_reduce_(1, index, cover.reshape(count, -1), "amax")
        shown = torch.where(cover > 0, grey.float()[..., None, None], 0.0)
        shade.scatter_reduce_(1, index, shown.reshape(count, -1), "amax")
        frames = (1 - paint) * self._backdrop + paint * shade
        return frames.reshape(count, self._width, self._width)

    def _process(self, frames: torch.Tensor) -> torch.Tensor:
        """Return tactile images (n, size, size) uint8 of frames (n, w, w), as the camera and tactile_image.py make them."""
        if self._blur is not None:
            half = len(self._blur) // 2
            padded = torch.nn.functional.pad(frames[:, None], (half,) * 4, mode="reflect")
            kernel = self._blur[None, None]
            frames = torch.nn.functional.conv2d(padded, kernel[:, :, :, None])
            frames = torch.nn.functional.conv2d(frames, kernel[:, :, None, :])[:, 0]
        frames = frames.round().clamp(0, 255)
        half = self._block // 2
        padded = torch.nn.functional.pad(frames[:, None], (half,) * 4, mode="replicate")[:, 0]
        # Sums of whole numbers below 2^24 are exact in single precision.
        mean = (_sums(_sums(padded, self._block).transpose(1, 2), self._block).transpose(1, 2) / self._block**2).round()
        white = (frames > mean - np.ceil(self._constant)).float()
        small = torch.einsum("rh,nhw,cw->nrc", self._rows, white, self._columns)
        return (small > 0.5).to(torch.uint8) * 255


def _sums(values: torch.Tensor, count: int) -> torch.Tensor:
    """Return the sums (n, h, w - count + 1) of `count` successive values along the last axis of (n, h, w)."""
    total = torch.nn.functional.pad(values, (1, 0)).cumsum(-1)
    return total[..., count:] - total[..., :-count]


def _resizing(width: int, low: int, high: int, size: int) -> np.ndarray:
    """Return the map (size, width) of a crop's pixels, `low` to `high`, to `size` pixels, as OpenCV resizes one axis."""
    identity = np.eye(high - low, dtype=np.float32)
    method = cv2.INTER_AREA if size <= high - low else cv2.INTER_LINEAR
    out = np.zeros((size, width), np.float32)
    out[:, low:high] = np.stack([cv2.resize(row[None], (size, 1), interpolation=method)[0] for row in identity], 1)
    return out
