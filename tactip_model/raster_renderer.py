"""Grey image of the pins without OpenGL: discs become ellipses with soft edges, and many images render in one call."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.tactip_model.design import Design, Optics
from tactip_twin.tactip_model.optics import LedRing, Lens, backdrop, perpendicular_axes, pin_radii


@lru_cache(maxsize=4)
def _blank(design: Design) -> np.ndarray:
    """Return the grey levels (frame_px²,) of a design's image without pins: read-only, because its renderers share them."""
    levels = backdrop(design, Lens(design), LedRing(design)).ravel().astype(np.float32)
    levels.flags.writeable = False
    return levels


class Raster:
    """Renderer of a design's grey frame with numpy and OpenCV. Tests compare it with pyrender_renderer.py."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        self._radii = pin_radii(design)
        self._blank = _blank(design)

    def render(self, pin_tips: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Return the grey frames (..., h, w) uint8 of pins.

        Args:
            pin_tips: (..., p, 3), m, sensor frame.
            directions: (..., p, 3), unit, sensor frame.
        """
        pin_tips, directions = np.asarray(pin_tips, float), np.asarray(directions, float)
        batch = pin_tips.shape[:-2]
        pin_tips, directions = pin_tips.reshape(-1, *pin_tips.shape[-2:]), directions.reshape(-1, *directions.shape[-2:])
        frames = np.stack([self._render_one(t, d) for t, d in zip(pin_tips, directions, strict=True)])
        return frames.reshape(*batch, *frames.shape[1:])

    def _render_one(self, pin_tips: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the grey frame (h, w) uint8 of pins with tips (p, 3) and directions (p, 3)."""
        centre, axes = self.ellipses(pin_tips, directions)
        grey = self._leds.grey(pin_tips, directions, self._design.optics.pin_albedo)
        # An ellipse with half-axes p and q reaches sqrt(px² + qx²) to a side; the edge and rounding add half a pixel each.
        reach = int(np.ceil(np.sqrt((axes**2).sum(2)).max())) + 1
        span, width = np.arange(-reach, reach + 1), self._lens.width
        nearest = np.rint(centre).astype(int)
        # A pixel's position in the unit disc. Single precision and entry by entry, because the matrices are small.
        p, q, r, s = axes.reshape(-1, 4).T
        size = p * s - q * r
        to_disc = (np.stack([s, -q, -r, p]) / size).astype(np.float32)
        a, b, c, d = to_disc[:, :, None, None]
        right, down = ((nearest - centre).T[:, :, None] + span).astype(np.float32)
        right, down = right[:, None, :], down[:, :, None]
        u, v = a * right + b * down, c * right + d * down
        square = u * u + v * v
        # No pixel farther than one from the edge along the shorter half-axis, for which this is a lower bound, has paint.
        shorter = np.abs(size) / np.sqrt((axes**2).sum((1, 2)))
        near = square < ((1 + 1 / shorter) ** 2).astype(np.float32)[:, None, None]
        x, y = nearest[:, :1] + span, nearest[:, 1:] + span
        if min(x.min(), y.min()) < 0 or max(x.max(), y.max()) >= width:
            near &= ((x >= 0) & (x < width))[:, None, :] & ((y >= 0) & (y < width))[:, :, None]
        entry = np.flatnonzero(near)
        pin, place = np.divmod(entry, len(span) ** 2)
        index = (nearest[:, 1] * width + nearest[:, 0])[pin] + (span[:, None] * width + span).ravel()[place]
        cover = _cover(u.ravel()[entry], v.ravel()[entry], to_disc[:, pin])
        paint, shade, frame = np.zeros(width * width, np.float32), grey.astype(np.float32)[pin], self._blank.copy()
        paint[index] = cover
        if (paint[index] != cover).any():
            # Where two pins overlap, a pixel is listed twice: both entries get the same paint and grey.
            shades = np.zeros_like(paint)
            np.maximum.at(paint, index, cover)
            np.maximum.at(shades, index, np.where(cover > 0, shade, 0))
            cover, shade = paint[index], shades[index]
        frame[index] += cover * (shade - frame[index])
        return blur_and_quantize(frame.reshape(width, width), self._design.optics)

    def ellipses(self, pin_tips: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the image of the pins' discs.

        Args:
            pin_tips: (..., p, 3), m, sensor frame.
            directions: (..., p, 3), unit, sensor frame.

        Returns:
            Centres (..., p, 2) and half-axes (..., p, 2, 2), as columns, px of the frame.
        """
        shape = pin_tips.shape[:-1]
        r = np.broadcast_to(self._radii, shape).reshape(-1, 1)
        pin_tips, directions = pin_tips.reshape(-1, 3), directions.reshape(-1, 3)
        u, v = r * perpendicular_axes(directions)
        edge = self._lens.project(pin_tips + np.stack([u, -u, v, -v]))
        axes = np.stack([(edge[0] - edge[1]) / 2, (edge[2] - edge[3]) / 2], -1)
        return edge.mean(0).reshape(*shape, 2), axes.reshape(*shape, 2, 2)


def _cover(u: np.ndarray, v: np.ndarray, to_disc: np.ndarray) -> np.ndarray:
    """Return how much of pixels a disc covers (n,), 0 to 1, from their distance to its edge in pixels along the gradient.

    Args:
        u: (n,) and
        v: (n,), positions of the pixels in the unit disc.
        to_disc: (4, n), rows of the matrix from pixels to the disc.
    """
    a, b, c, d = to_disc
    length = np.sqrt(u * u + v * v)
    gradient = np.sqrt((a * u + c * v) ** 2 + (b * u + d * v) ** 2)
    cover = np.clip(0.5 - (length - 1) * length / np.maximum(gradient, np.float32(1e-12)), 0, 1)
    cover[length < 1e-6] = 1.0
    return cover


def blur_and_quantize(frame: np.ndarray, optics: Optics) -> np.ndarray:
    """Apply the lens's blur and the camera's 8 bits: convert a frame (h, w) float, 0 to 255, to uint8."""
    if optics.blur_px > 0:
        frame = cv2.GaussianBlur(frame.astype(np.float32, copy=False), (0, 0), optics.blur_px)
    return cv2.convertScaleAbs(frame)  # rounds to the nearest and saturates at 255
