"""Augmentation: training images rendered at every step from the pins of simulated contacts, under random optics.

The mechanics are simulated once and only the optics vary, because two sensors of the same design, or one sensor on two
days, differ in camera position, apparent pin size and threshold. Moreover, it is chance which pixels a pin of two or
three pixels covers, and a network that always sees the same image of a contact memorizes that chance.

Here a pin is a disc, and a pixel is white if its centre lies on one. The radii are corrected so the images have as many
white pixels as those of the set. This is 50 times faster than rendering and processing a frame, and nine of ten white pixels
agree.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from tactip_twin.learning.data import Samples
from tactip_twin.learning.optics_ranges import OPTICS, OpticsRanges
from tactip_twin.learning.pin_projection import PinProjection
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_from_dict
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pins import neutral_pins

_COMPARED = 256
"""Number of images of the set that the radius correction is fitted to."""

_CAMERA_COUNT = 64
"""Number of random cameras, where their position varies; the lens is fitted for each."""

_ARC_DISCS = 24
"""Number of discs that make up an arc of light."""


class OpticsAugmentation:
    """Images of the n samples of a set under random optics, and, as sample n, of the undeformed tip."""

    def __init__(
        self, samples: Samples, fraction: float = 1.0, ranges: OpticsRanges = OPTICS["lens"], device: str = "cpu"
    ) -> None:
        """Project the pins of the samples.

        Args:
            samples: Samples of a simulated set.
            fraction: Factor by which the ranges are scaled.
            ranges: Ranges of the optics.
            device: Torch device.

        Raises:
            TactipError: If the set has no pins, or its images are grey.
        """
        if samples.grey:
            raise TactipError(
                f"the images in {samples.folder} are grey, but images that are rendered again are binary: set "
                "augmented_fraction, undeformed_fraction and validation_renderings to 0"
            )
        tips, directions = _read_pins(samples)
        self.undeformed = len(tips)
        """Index of the undeformed tip."""
        self._design = design = design_from_dict(
            samples.dataset.meta["configuration"]["design"], f"{samples.folder}: design"
        )
        neutral = neutral_pins(design)
        tips, directions = (
            np.concatenate([a, b[None].astype(a.dtype)]) for a, b in zip((tips, directions), neutral, strict=True)
        )
        self._size, self._device, self._projection = samples.size, device, PinProjection(design, device)
        self._centres, self._radii = self._projection.discs(tips, directions, samples.size)
        r = ranges
        widths = fraction * np.array([r.zoom, r.rotation_deg * np.pi / 180, r.drift * self._size, r.pin_size])
        self._zoom, self._turn, self._drift, self._pin_size = widths.tolist()
        self._fraction, self._ranges, self._px = fraction, ranges, samples.size / 128
        self._cameras: _Cameras | None = None
        if fraction * max(r.camera_height_m, r.camera_offset_m) > 0:
            self._cameras = _Cameras(
                design, fraction * r.camera_height_m, fraction * r.camera_offset_m, samples.size, device
            )
            self._tips = torch.from_numpy(tips.astype(np.float32)).to(device)
        self._radius_correction = self._fit_radius_correction(samples.images[:_COMPARED])

    def replace_drawn(self, tips: np.ndarray, directions: np.ndarray) -> None:
        """Replace the contacts after the undeformed tip by others, with pin tips (m, p, 3), m, and directions (m, p, 3)."""
        own = self.undeformed + 1
        centres, radii = self._projection.discs(tips, directions, self._size)
        self._centres = torch.cat([self._centres[:own], centres])
        self._radii = torch.cat([self._radii[:own], radii])
        if self._cameras is not None:
            drawn = torch.from_numpy(tips.astype(np.float32)).to(self._device)
            self._tips = torch.cat([self._tips[:own], drawn])

    def render(self, chosen: torch.Tensor) -> torch.Tensor:
        """Render images (m, size, size) uint8 of samples `chosen` (m,) int, under optics from torch's random generator."""
        zoom, turn, right, down, size = self._uniform(5, len(chosen), 1)
        middle = (self._size - 1) / 2
        positions = self._centres[chosen] if self._cameras is None else self._cameras.project(self._tips[chosen])
        x, y = self._distort(positions - middle).unbind(-1)
        zoom, turn = 1 + self._zoom * zoom, self._turn * turn
        cos, sin = zoom * torch.cos(turn), zoom * torch.sin(turn)
        x, y = cos * x - sin * y + self._drift * right, sin * x + cos * y + self._drift * down
        radii = (self._radii[chosen] + self._radius_correction) * (1 + self._pin_size * size)
        positions, radii, soft = self._add_noise(torch.stack([x, y], -1) + middle, radii)
        images = self._rasterize(positions, radii) if soft is None else self._rasterize_soft(positions, radii, soft)
        if self._ranges.salt:
            white = self._fraction * self._ranges.salt * torch.rand(len(images), 1, 1, device=self._device).square()
            images[torch.rand(images.shape, device=self._device) < white] = 255
        return images

    def _uniform(self, *shape: int) -> tuple[torch.Tensor, ...]:
        """Return random numbers (shape) from -1 to 1, unpacked along the first axis."""
        return (2 * torch.rand(*shape, device=self._device) - 1).unbind()

    def _distort(self, positions: torch.Tensor) -> torch.Tensor:
        """Return positions (m, p, 2), px from the image centre, stretched and distorted at random."""
        r, fraction = self._ranges, self._fraction
        if r.distortion:
            (bend,) = self._uniform(1, len(positions), 1, 1)
            positions = positions * (
                1 + fraction * r.distortion * bend * (positions / (self._size / 2)).square().sum(-1, keepdim=True)
            )
        if r.stretch:
            (wide,) = self._uniform(1, len(positions), 1)
            wide = 0.5 * fraction * r.stretch * wide
            positions = positions * torch.stack([1 + wide, 1 - wide], -1)
        return positions

    def _add_noise(
        self, positions: torch.Tensor, radii: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """Add effects other than the lens's: displaced, resized and missing pins, and lights.

        Args:
            positions: (m, p, 2), px.
            radii: (m, p), px.

        Returns:
            Positions and radii of the pins and lights, and the softness of the discs' edges (m, 1, 1), px, or None.
        """
        r, fraction, soft = self._ranges, self._fraction, None
        count = len(positions)

        def up_to(high: float, *shape: int) -> torch.Tensor:
            """Return random numbers (m, *shape) from 0 to a fraction of `high`."""
            return fraction * high * torch.rand(count, *shape, device=self._device)

        if r.pin_each:
            (each,) = self._uniform(1, *radii.shape)
            radii = radii * (1 + fraction * r.pin_each * each)
        if r.jitter_px:
            positions = positions + fraction * r.jitter_px * self._px * torch.randn(positions.shape, device=self._device)
        if r.missing:
            radii = torch.where(torch.rand(radii.shape, device=self._device) < up_to(r.missing, 1), -9.0, radii)
        if r.speckles:
            number = int(np.ceil(r.speckles))
            shown = torch.arange(number, device=self._device) < up_to(number + 1, 1).floor()
            sizes = self._px * (0.5 + torch.rand(count, number, device=self._device))
            positions = torch.cat([positions, self._size * torch.rand(count, number, 2, device=self._device)], 1)
            radii = torch.cat([radii, torch.where(shown, sizes, -9.0)], 1)
        if r.rim_lights:
            rim = _rim_lights(count, int(np.ceil(r.rim_lights)), fraction, self._device)
            positions = torch.cat([positions, self._size * (0.5 + rim[0])], 1)
            radii = torch.cat([radii, torch.where(rim[1] > 0, self._size * rim[1], -9.0)], 1)
        if r.merged_px:
            soft = up_to(r.merged_px * self._px, 1, 1) + 1e-3
        return positions, radii, soft

    def render_plain(self, chosen: torch.Tensor) -> torch.Tensor:
        """Render images (m, size, size) uint8 of samples `chosen` (m,) int, under the optics of the design."""
        return self._rasterize(self._centres[chosen], self._radii[chosen] + self._radius_correction)

    def _rasterize(self, centres: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
        """Render images (m, size, size) uint8 of discs with centres (m, p, 2) and radii (m, p), px."""
        half_width = int(np.ceil(float(radii.max()))) if radii.numel() else 1
        span = torch.arange(-half_width, half_width + 1, device=self._device)
        offsets = torch.stack(torch.meshgrid(span, span, indexing="xy"), -1).reshape(-1, 2)
        near = torch.round(centres)
        distance = (near - centres)[:, :, None] + offsets
        pixels = near.long()[:, :, None] + offsets
        white = (distance.square().sum(-1) < radii.clamp_min(0).square()[:, :, None]) & (
            (pixels >= 0) & (pixels < self._size)
        ).all(-1)
        images = torch.zeros(len(centres), self._size**2, dtype=torch.uint8, device=self._device)
        which = torch.arange(len(centres), device=self._device)[:, None, None] * self._size**2
        images.view(-1)[(which + pixels[..., 1] * self._size + pixels[..., 0])[white]] = 255
        return images.view(-1, self._size, self._size)

    def _rasterize_soft(self, centres: torch.Tensor, radii: torch.Tensor, soft: torch.Tensor) -> torch.Tensor:
        """Render images as `_rasterize` does, with edges that fall off over `soft` (m, 1, 1) px on both sides.

        Two discs closer together than that merge, as in a blurred frame.
        """
        half_width = int(np.ceil(float((radii + soft[..., 0]).max())))
        span = torch.arange(-half_width, half_width + 1, device=self._device)
        offsets = torch.stack(torch.meshgrid(span, span, indexing="xy"), -1).reshape(-1, 2)
        near = torch.round(centres)
        distance = ((near - centres)[:, :, None] + offsets).square().sum(-1).sqrt()
        pixels = near.long()[:, :, None] + offsets
        cover = ((radii[:, :, None] + soft - distance) / (2 * soft)).clamp(0, 1)
        cover *= ((pixels >= 0) & (pixels < self._size)).all(-1)
        pixels = pixels.clamp(0, self._size - 1)
        field = torch.zeros(len(centres), self._size**2, device=self._device)
        which = (pixels[..., 1] * self._size + pixels[..., 0]).reshape(len(centres), -1)
        field.scatter_add_(1, which, cover.reshape(len(centres), -1))
        return ((field > 0.5).to(torch.uint8) * 255).view(-1, self._size, self._size)

    def _fit_radius_correction(self, images: np.ndarray) -> float:
        """Return the radius correction, px, that gives as many white pixels as in the images of the set, by bisection.

        Args:
            images: (m, size, size) uint8, the images of the first samples.
        """
        expected, low, high = int((images > 127).sum()), -1.0, 1.5
        chosen = torch.arange(len(images), device=self._device)
        for _ in range(12):
            self._radius_correction = (low + high) / 2
            too_few = int((self.render_plain(chosen) > 127).sum()) < expected
            low, high = (self._radius_correction, high) if too_few else (low, self._radius_correction)
        return (low + high) / 2


def _read_pins(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Return the pin tips (n, p, 3), m, and directions (n, p, 3) of samples. Raises TactipError if they are damaged."""
    tips, directions = read_pins(samples.folder, samples.dataset.meta)
    count = len(samples.dataset.images)
    if len(tips) != count:
        raise TactipError(
            f"the set in {samples.folder} has pins of {len(tips)} samples for {count} images: generate the set again"
        )
    return tips[samples.rows], directions[samples.rows]


class _Cameras:
    """Cameras at random positions behind the same tip, each with a lens fitted to the same neutral image."""

    def __init__(self, design: Design, height: float, offset: float, size: int, device: str) -> None:
        """Sample the cameras.

        Args:
            design: Design of the sensor.
            height: Half-width of the range of the height, m.
            offset: Half-width of the range of the offsets, m.
            size: Width of the tactile image, px.
            device: Torch device.
        """
        rng, optics = np.random.default_rng(0), design.optics
        left, top, right, bottom = design.image.crop or (0, 0, optics.frame_px, optics.frame_px)
        scale = size / np.array([right - left, bottom - top])
        cameras = []
        for _ in range(_CAMERA_COUNT):
            up, x, y = rng.uniform(-1, 1, 3) * (height, offset, offset)
            moved = replace(
                optics,
                camera_height_m=max(1e-3, optics.camera_height_m + up),
                camera_offset_m=(optics.camera_offset_m[0] + x, optics.camera_offset_m[1] + y),
            )
            cameras.append(Lens(replace(design, optics=moved)))
        base = Lens(design)
        neutral = neutral_pins(design)[0]

        def tensor(values: ArrayLike | list[Any]) -> torch.Tensor:
            """Return values as a float32 tensor on the device."""
            return torch.from_numpy(np.array(values, np.float32)).to(device)

        self._device = device
        self._positions = tensor([lens.position for lens in cameras])[:, None]
        # Table of the image radius by angle to the axis, for each camera.
        self._angles = tensor(_ANGLES)
        self._radii = tensor([lens.radius(_ANGLES) for lens in cameras])
        # Shift each image so the neutral pins stay in place on average.
        shift = [(base.project(neutral) - lens.project(neutral)).mean(0) for lens in cameras]
        self._centres = tensor(
            [(lens.centre + d - (left, top)) * scale - 0.5 for lens, d in zip(cameras, shift, strict=True)]
        )
        self._scale = tensor(scale)

    def project(self, tips: torch.Tensor) -> torch.Tensor:
        """Project pin tips (m, p, 3), m, to positions (m, p, 2), px, each of the m samples with a random camera."""
        which = torch.randint(_CAMERA_COUNT, (len(tips),), device=self._device)
        rays = tips - self._positions[which]
        plan = rays[..., :2].square().sum(-1).sqrt()
        angle = torch.atan2(plan, rays[..., 2])
        step = self._angles[1] - self._angles[0]
        place = (angle / step).clamp(0, len(self._angles) - 1.001)
        low = place.long()
        table = self._radii[which]
        below, above = table.gather(1, low), table.gather(1, low + 1)
        radius = below + (place - low) * (above - below)
        outward = rays[..., :2] / plan.clamp_min(1e-9)[..., None]
        return self._centres[which][:, None] + radius[..., None] * outward * self._scale


_ANGLES = np.linspace(0, np.pi / 2, 400)
"""Angles to the axis, rad, at which a lens is tabulated."""


def _rim_lights(count: int, max_arcs: int, fraction: float, device: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Sample discs along random arcs of light at the rim.

    Args:
        count: Number of images.
        max_arcs: Maximum number of arcs per image.
        fraction: Factor by which that maximum is scaled.
        device: Torch device.

    Returns:
        Positions (count, max_arcs * _ARC_DISCS, 2) from the image centre, and radii (count, max_arcs * _ARC_DISCS), 0 where
        there is no arc; both as fractions of the image width.
    """
    number = (fraction * (max_arcs + 1) * torch.rand(count, 1, device=device)).floor()
    start = 2 * np.pi * torch.rand(count, max_arcs, 1, device=device)
    length = 0.2 + 0.6 * torch.rand(count, max_arcs, 1, device=device)
    distance = 0.46 + 0.03 * torch.rand(count, max_arcs, 1, device=device)
    along = torch.linspace(0, 1, _ARC_DISCS, device=device)
    angle = start + length * along
    # Crescents: thin at both ends.
    thick = (0.004 + 0.008 * torch.rand(count, max_arcs, 1, device=device)) * (4 * along * (1 - along)).clamp_min(0.1)
    positions = torch.stack([distance * torch.cos(angle), distance * torch.sin(angle)], -1)
    shown = torch.arange(max_arcs, device=device) < number
    return positions.reshape(count, -1, 2), torch.where(shown[..., None], thick, 0.0).reshape(count, -1)
