"""Pins in the camera's frame, for many contacts at once in torch: the values of optics.py and raster_renderer.py."""

import numpy as np
import torch

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.optics import LedRing, Lens, pin_radii

_BATCH = 256
"""Number of contacts that are projected at once."""


class PinProjection:
    """Camera and light of a design."""

    def __init__(self, design: Design, device: str = "cpu") -> None:
        """Prepare them on a torch device."""
        self._device, self._image, self._albedo = device, design.image, design.optics.pin_albedo
        self._lens, self._leds = Lens(design), LedRing(design)
        self._radii = torch.from_numpy(pin_radii(design)).to(device)[:, None]

    def discs(self, tips: np.ndarray, directions: np.ndarray, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return centres (n, p, 2) and radii (n, p), px, float32, of the pins in tactile images `size` px wide.

        Args:
            tips: (n, p, 3), m.
            directions: (n, p, 3).
            size: Width of the images, px.
        """
        left, top, right, bottom = self._image.crop or (0, 0, self._lens.width, self._lens.width)
        corner, scale = (
            torch.tensor(values, dtype=torch.float64, device=self._device)
            for values in ((left, top), (size / (right - left), size / (bottom - top)))
        )
        parts = []
        for start in range(0, len(tips), _BATCH):
            pins = (a[start : start + _BATCH].astype(float) for a in (tips, directions))
            middle, axes = self.ellipses(*(torch.from_numpy(a).to(self._device) for a in pins))
            centres = (middle - corner + 0.5) * scale - 0.5
            area = axes[..., 0, 0] * axes[..., 1, 1] - axes[..., 0, 1] * axes[..., 1, 0]
            parts.append((centres.float(), (area.abs() * scale.prod()).sqrt().float()))
        centres, radii = (torch.cat(arrays) for arrays in zip(*parts, strict=True))
        return centres, radii

    def ellipses(self, tips: torch.Tensor, towards: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return centres (n, p, 2) and half-axes (n, p, 2, 2), px of the frame, as Raster.ellipses does."""
        x, y, z = towards.unbind(-1)
        steep, flat = x.abs() >= 0.9, torch.zeros_like(x)
        u = torch.stack([torch.where(steep, -z, flat), torch.where(steep, flat, z), torch.where(steep, x, -y)], -1)
        u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
        v = torch.linalg.cross(towards, u)
        u, v = self._radii * u, self._radii * v
        edge = self._project(tips + torch.stack([u, -u, v, -v]))
        return edge.mean(0), torch.stack([(edge[0] - edge[1]) / 2, (edge[2] - edge[3]) / 2], -1)

    def _project(self, points: torch.Tensor) -> torch.Tensor:
        """Return the pixels (..., 2) of points (..., 3), m; see optics.Lens.project."""
        lens = self._lens
        rays = points - torch.as_tensor(lens.position, device=self._device)
        plan = torch.hypot(rays[..., 0], rays[..., 1])
        angle = torch.arctan2(plan, rays[..., 2])
        near = angle.clamp_max(lens.straight)
        k1, k3, k5 = lens.coefficients
        square = near * near
        radius = lens.scale * (near * (k1 + square * (k3 + square * k5)) + lens.slope * (angle - near))
        centre = torch.as_tensor(lens.centre - 0.5, device=self._device)
        return centre + rays[..., :2] * (radius / plan.clamp_min(1e-12))[..., None]

    def grey(self, tips: torch.Tensor, towards: torch.Tensor) -> torch.Tensor:
        """Return the grey levels (n, p), 0 to 255, of pins; see optics.LedRing.grey."""
        light = torch.as_tensor(self._leds.lamps, device=self._device) - tips[..., None, :]
        distance = torch.linalg.vector_norm(light, dim=-1)
        irradiance = ((light * towards[..., None, :]).sum(-1).clamp_min(0) / distance**3).sum(-1)
        return (self._leds.scale * self._albedo * irradiance).clamp_max(255)
