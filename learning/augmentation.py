"""Training images drawn as training runs, from the pins of simulated contacts, under varied cameras and lights.

Physics once, optics many: what differs between two sensors of a kind, and between today and tomorrow, is where the camera
sits, how large its pins appear and where the threshold falls. And a pin of two or three pixels falls among them by chance: a
network that always sees the same image of a contact learns that chance by heart.

A pin is a disc here, and a pixel is white if its middle lies on one; the discs grow by what makes as many pixels white as
the set's own images have. That is 50 times faster than a frame and its pipeline, and nine of ten white pixels are the same.
"""

from dataclasses import replace

import numpy as np
import torch

from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.tactip_model.design_file import design_from
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.raster_renderer import Raster

_BLOCK = 256
"""Images whose pins are projected, and compared, at a time."""


_CAMERAS = 64
"""Cameras of other heights and places that are drawn once, where these vary: each has its own fit of the lens."""

_ARC = 24
"""Discs that make an arc of light."""


class OpticsAugmentation:
    """The images of a set's samples, drawn anew whenever they are asked for."""

    def __init__(self, samples, share=1.0, ranges=OPTICS["lens"], device="cpu"):
        """samples: Samples of a simulated set. share: float, of the ranges (varied.OpticsRanges) that is used. device: str.

        Raises TactipError where the set has no pins.
        """
        tips, directions = _pins_of(samples)
        design = design_from(samples.dataset.meta["configuration"]["design"], f"{samples.folder}: design")
        centres, radii = _discs(tips, directions, design, samples.size)
        self._size, self._device = samples.size, device
        self._centres, self._radii = torch.from_numpy(centres).to(device), torch.from_numpy(radii).to(device)
        r = ranges
        widths = share * np.array([r.zoom, r.turn_deg * np.pi / 180, r.drift * self._size, r.pin_size])
        self._zoom, self._turn, self._drift, self._pin_size = widths.tolist()
        self._share, self._ranges, self._px = share, ranges, samples.size / 128
        self._cameras = None
        if share * max(r.camera_height_m, r.camera_offset_m) > 0:
            self._cameras = _Cameras(design, share * r.camera_height_m, share * r.camera_offset_m, samples.size, device)
            self._tips = torch.from_numpy(tips.astype(np.float32)).to(device)
        self._growth = self._fit_growth(samples.images[:_BLOCK])

    def draw(self, chosen):
        """Images (m, size, size) uint8 of samples `chosen` (m,) int, under optics that torch's generator draws."""
        zoom, turn, right, down, size = self._either_way(5, len(chosen), 1)
        middle = (self._size - 1) / 2
        places = self._centres[chosen] if self._cameras is None else self._cameras.seen(self._tips[chosen])
        x, y = self._distorted(places - middle).unbind(-1)
        zoom, turn = 1 + self._zoom * zoom, self._turn * turn
        cos, sin = zoom * torch.cos(turn), zoom * torch.sin(turn)
        x, y = cos * x - sin * y + self._drift * right, sin * x + cos * y + self._drift * down
        radii = (self._radii[chosen] + self._growth) * (1 + self._pin_size * size)
        places, radii, soft = self._noisy(torch.stack([x, y], -1) + middle, radii)
        return self._paint(places, radii) if soft is None else self._paint_soft(places, radii, soft)

    def _either_way(self, *shape):
        """Numbers (shape) from -1 to 1, unpacked along the first axis."""
        return (2 * torch.rand(*shape, device=self._device) - 1).unbind()

    def _distorted(self, places):
        """Places (m, p, 2), px from the middle, stretched and distorted."""
        r, share = self._ranges, self._share
        if r.distortion:
            (bend,) = self._either_way(1, len(places), 1, 1)
            places = places * (1 + share * r.distortion * bend * (places / (self._size / 2)).square().sum(-1, keepdim=True))
        if r.stretch:
            (wide,) = self._either_way(1, len(places), 1)
            wide = 0.5 * share * r.stretch * wide
            places = places * torch.stack([1 + wide, 1 - wide], -1)
        return places

    def _noisy(self, places, radii):
        """Places and radii with what is not the lens's: pins that are off, of another size, missing; light that is no pin.

        The third is how far the discs' edges are softened (m, 1, 1), px, or None.
        """
        r, share, soft = self._ranges, self._share, None
        count = len(places)

        def upto(most, *shape):
            return share * most * torch.rand(count, *shape, device=self._device)

        if r.pin_each:
            (each,) = self._either_way(1, *radii.shape)
            radii = radii * (1 + share * r.pin_each * each)
        if r.jitter_px:
            places = places + share * r.jitter_px * self._px * torch.randn(places.shape, device=self._device)
        if r.missing:
            radii = torch.where(torch.rand(radii.shape, device=self._device) < upto(r.missing, 1), -9.0, radii)
        if r.speckles:
            most = int(np.ceil(r.speckles))
            there = torch.arange(most, device=self._device) < upto(most + 1, 1).floor()
            sizes = self._px * (0.5 + torch.rand(count, most, device=self._device))
            places = torch.cat([places, self._size * torch.rand(count, most, 2, device=self._device)], 1)
            radii = torch.cat([radii, torch.where(there, sizes, -9.0)], 1)
        if r.rim_lights:
            rim = _rim_lights(count, int(np.ceil(r.rim_lights)), share, self._device)
            places = torch.cat([places, self._size * (0.5 + rim[0])], 1)
            radii = torch.cat([radii, torch.where(rim[1] > 0, self._size * rim[1], -9.0)], 1)
        if r.merged_px:
            soft = upto(r.merged_px * self._px, 1, 1) + 1e-3
        return places, radii, soft

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
        white = (away.square().sum(-1) < radii.clamp_min(0).square()[:, :, None]) & (
            (pixels >= 0) & (pixels < self._size)
        ).all(-1)
        images = torch.zeros(len(centres), self._size**2, dtype=torch.uint8, device=self._device)
        which = torch.arange(len(centres), device=self._device)[:, None, None] * self._size**2
        images.view(-1)[(which + pixels[..., 1] * self._size + pixels[..., 0])[white]] = 255
        return images.view(-1, self._size, self._size)

    def _paint_soft(self, centres, radii, soft):
        """As _paint, with edges that fall off over `soft` (m, 1, 1) px to both sides: two discs nearer to each other than
        that are one, as a blurred frame has it."""
        reach = int(np.ceil(float((radii + soft[..., 0]).max())))
        span = torch.arange(-reach, reach + 1, device=self._device)
        offsets = torch.stack(torch.meshgrid(span, span, indexing="xy"), -1).reshape(-1, 2)
        near = torch.round(centres)
        away = ((near - centres)[:, :, None] + offsets).square().sum(-1).sqrt()
        pixels = near.long()[:, :, None] + offsets
        cover = ((radii[:, :, None] + soft - away) / (2 * soft)).clamp(0, 1)
        cover *= ((pixels >= 0) & (pixels < self._size)).all(-1)
        pixels = pixels.clamp(0, self._size - 1)
        field = torch.zeros(len(centres), self._size**2, device=self._device)
        which = (pixels[..., 1] * self._size + pixels[..., 0]).reshape(len(centres), -1)
        field.scatter_add_(1, which, cover.reshape(len(centres), -1))
        return ((field > 0.5).to(torch.uint8) * 255).view(-1, self._size, self._size)

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
    tips, directions = read_pins(samples.folder, samples.dataset.meta)
    count = len(samples.dataset.images)
    if len(tips) != count:
        raise TactipError(
            f"the pins of the set in {samples.folder} are damaged: it has {len(tips)} records for {count} images"
        )
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


class _Cameras:
    """Cameras at other heights and places behind the same tip, whose lens is such that the neutral image stays the same."""

    def __init__(self, design, height, offset, size, device):
        """design: Design. height, offset: float, m, ranges either way. size: int, px of the tactile image. device: str."""
        draw, optics = np.random.default_rng(0), design.optics
        left, top, right, bottom = design.image.crop or (0, 0, optics.frame_px, optics.frame_px)
        scale = size / np.array([right - left, bottom - top])
        cameras = []
        for _ in range(_CAMERAS):
            up, x, y = draw.uniform(-1, 1, 3) * (height, offset, offset)
            moved = replace(
                optics,
                camera_height_m=max(1e-3, optics.camera_height_m + up),
                camera_offset_m=(optics.camera_offset_m[0] + x, optics.camera_offset_m[1] + y),
            )
            cameras.append(Lens(replace(design, optics=moved)))
        base = Lens(design)
        neutral = neutral_pins(design)[0]

        def tensor(values):
            return torch.from_numpy(np.array(values, np.float32)).to(device)

        self._device = device
        self._positions = tensor([lens.position for lens in cameras])[:, None]
        # A polynomial a camera, of the tangent's angle: the lens's own, sampled and fitted where the pins are.
        self._angles = tensor(_ANGLES)
        self._radii = tensor([lens.radius(_ANGLES) for lens in cameras])
        # The middle of the image moves so that the neutral pins stay where they were, in the mean.
        shift = [(base.project(neutral) - lens.project(neutral)).mean(0) for lens in cameras]
        self._centres = tensor(
            [(lens.centre + d - (left, top)) * scale - 0.5 for lens, d in zip(cameras, shift, strict=True)]
        )
        self._scale = tensor(scale)

    def seen(self, tips):
        """Places (m, p, 2), px, of tips (m, p, 3), m, by a camera drawn for each."""
        which = torch.randint(_CAMERAS, (len(tips),), device=self._device)
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
"""Angles to the axis, rad, at which a lens is tabled."""


def _rim_lights(count, most, share, device):
    """Discs along arcs of light at the rim: places (count, most * _ARC, 2), of the image's width from its middle, and radii
    (count, most * _ARC), of its width, 0 where there is none."""
    number = (share * (most + 1) * torch.rand(count, 1, device=device)).floor()
    start = 2 * np.pi * torch.rand(count, most, 1, device=device)
    length = 0.2 + 0.6 * torch.rand(count, most, 1, device=device)
    away = 0.46 + 0.03 * torch.rand(count, most, 1, device=device)
    along = torch.linspace(0, 1, _ARC, device=device)
    angle = start + length * along
    # Crescents: thin at both ends.
    thick = (0.004 + 0.008 * torch.rand(count, most, 1, device=device)) * (4 * along * (1 - along)).clamp_min(0.1)
    places = torch.stack([away * torch.cos(angle), away * torch.sin(angle)], -1)
    there = torch.arange(most, device=device) < number
    return places.reshape(count, -1, 2), torch.where(there[..., None], thick, 0.0).reshape(count, -1)
