"""Grey image of the pins without OpenGL: discs become ellipses with soft edges, and many images render in one call."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.tactip_model.design import Design, Optics
from tactip_twin.tactip_model.optics import LedRing, Lens, backdrop, perpendicular_axes, pin_radii

_CHUNK = 4
"""Number of images that are painted at once: more do not fit into a core's cache [M]."""

_TINY = np.float32(1e-12)
"""Lower limit of the squared radius in the unit disc, -, because a quotient has no value at the centre."""


@lru_cache(maxsize=4)
def _blank(design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Return a design's image without pins: its grey levels (frame_px, frame_px) float32, and the frame (frame_px, frame_px)
    uint8. Both are read-only, because its renderers share them."""
    levels = backdrop(design, Lens(design), LedRing(design)).astype(np.float32)
    blank = levels, blur_and_quantize(levels, design.optics)
    for array in blank:
        array.flags.writeable = False
    return blank


class Raster:
    """Renderer of a design's grey frame with numpy and OpenCV. Tests compare it with pyrender_renderer.py."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        self._radii = pin_radii(design)
        self._levels, self._blank = _blank(design)
        self._blur_reach = blur_size(design.optics) // 2

    def render(self, pin_tips: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Return the grey frames (..., h, w) uint8 of pins.

        Args:
            pin_tips: (..., p, 3), m, sensor frame.
            directions: (..., p, 3), unit, sensor frame.
        """
        pin_tips, directions = np.asarray(pin_tips, float), np.asarray(directions, float)
        centres, axes = self.ellipses(pin_tips, directions)
        grey = self._leds.grey(pin_tips, directions, self._design.optics.pin_albedo).astype(np.float32)
        batch, pins = pin_tips.shape[:-2], pin_tips.shape[-2]
        centres, axes, grey = centres.reshape(-1, pins, 2), axes.reshape(-1, pins, 2, 2), grey.reshape(-1, pins)
        frames = np.empty((len(grey), *self._blank.shape), np.uint8)
        for start in range(0, len(frames), _CHUNK):
            part = slice(start, start + _CHUNK)
            self._paint(frames[part], centres[part], axes[part], grey[part])
        return frames.reshape(*batch, *frames.shape[1:])

    def _paint(self, frames: np.ndarray, centres: np.ndarray, axes: np.ndarray, grey: np.ndarray) -> None:
        """Fill grey frames (n, h, w) uint8 with ellipses: centres (n, p, 2) and half-axes (n, p, 2, 2), px, grey (n, p)."""
        # An ellipse with half-axes p and q reaches sqrt(px² + qx²) to a side; the edge and rounding add half a pixel each.
        reach = int(np.ceil(np.sqrt((axes**2).sum(3)).max())) + 1
        span, width = np.arange(-reach, reach + 1), self._lens.width
        nearest = np.rint(centres).astype(int)
        offset = (nearest - centres).reshape(-1, 2).T[:, None] + span[:, None]
        cover = _cover(axes.reshape(-1, 2, 2), *offset)
        low, high = nearest.min((0, 1)) - reach, nearest.max((0, 1)) + reach
        if low.min() < 0 or high.max() >= width:
            places = nearest.reshape(-1, 2).T[:, None] + span[:, None]
            x_in, y_in = (places >= 0) & (places < width)
            cover *= y_in[:, None] & x_in
        entry = np.flatnonzero(cover > 0)
        cover = cover.ravel()[entry]
        place = entry // grey.size
        pin = entry - place * grey.size
        first = (np.arange(len(frames))[:, None] * width + nearest[..., 1]) * width + nearest[..., 0]
        index = first.ravel()[pin] + (span[:, None] * width + span).ravel()[place]
        shade, paint = grey.ravel()[pin], np.empty(frames.size, np.float32)
        paint[index] = cover
        if (paint[index] != cover).any():
            # Where two pins overlap, a pixel is listed twice: both entries get the same paint and grey.
            paint[index], shades = 0, np.zeros_like(paint)
            np.maximum.at(paint, index, cover)
            np.maximum.at(shades, index, shade)
            cover, shade = paint[index], shades[index]
        # Rows without paint stay blank. The blur spreads paint by its own reach, and takes in what is as far around that.
        # Whole rows, because OpenCV rounds in another way next to a row's end.
        rows = _grown(slice(low[1], high[1] + 1), self._blur_reach, width)
        around = _grown(rows, self._blur_reach, width)
        levels = np.empty(frames.shape, np.float32)
        levels[:, around] = self._levels[around]
        flat = levels.reshape(-1)
        flat[index] += cover * (shade - flat[index])
        frames[:] = self._blank
        inside = slice(rows.start - around.start, rows.stop - around.start)
        for frame, painted in zip(frames, levels, strict=True):
            frame[rows] = blur_and_quantize(painted[around], self._design.optics)[inside]

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


def _cover(axes: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return how much of its pixels each of n ellipses covers (h, w, n) float32, 0 to 1, from their distance to its edge in
    pixels along the gradient. The ellipses come last, because numpy is slow where the last axis is short.

    With half-axes as the columns of A, a pixel's position in the unit disc is z = A⁻¹(x, y)ᵀ. The disc's edge is where |z|
    is 1, and |z| has the gradient A⁻ᵀz / |z|. |z|² and |A⁻ᵀz|² are quadratic forms in x and y, with matrices M = A⁻ᵀA⁻¹
    and M².

    Args:
        axes: (n, 2, 2), half-axes as columns, px.
        right: (w, n) and
        down: (h, n), pixels relative to the centre.
    """
    p, q, r, s = axes.reshape(-1, 4).T
    inverse2 = 1 / (p * s - q * r) ** 2
    xx, xy, yy = (r * r + s * s) * inverse2, -(p * r + q * s) * inverse2, (p * p + q * q) * inverse2
    radius2 = _quadratic_form(xx, xy, yy, right, down)
    slope2 = _quadratic_form(xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy, right, down)
    # At the centre both are zero, and rounding may make them negative.
    np.maximum(radius2, _TINY, out=radius2)
    np.sqrt(np.maximum(slope2, _TINY**2, out=slope2), out=slope2)
    cover = np.sqrt(radius2)
    cover -= radius2
    cover /= slope2
    cover += np.float32(0.5)
    return np.clip(cover, 0, 1, out=cover)


def _quadratic_form(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return xx x² + 2 xy x y + yy y², (h, w, n) float32, for n forms at each x (w, n) and y (h, n)."""
    out = (2 * xy * x).astype(np.float32) * y.astype(np.float32)[:, None]
    out += (xx * x * x).astype(np.float32)
    out += (yy * y * y).astype(np.float32)[:, None]
    return out


def _grown(rows: slice, margin: int, height: int) -> slice:
    """Return rows of a frame, grown by a margin to each side; at least one row of the frame."""
    start = min(max(rows.start - margin, 0), height - 1)
    return slice(start, max(min(rows.stop + margin, height), start + 1))


def blur_size(optics: Optics) -> int:
    """Return the width of the blur's kernel, px, as OpenCV chooses it for floats; odd."""
    return round(8 * optics.blur_px + 1) | 1


def blur_and_quantize(frame: np.ndarray, optics: Optics) -> np.ndarray:
    """Apply the lens's blur and the camera's 8 bits: convert a frame (h, w) float, 0 to 255, to uint8."""
    if optics.blur_px > 0:
        size = blur_size(optics)
        frame = cv2.GaussianBlur(frame.astype(np.float32, copy=False), (size, size), optics.blur_px)
    return cv2.convertScaleAbs(frame)  # rounds to the nearest and saturates at 255
