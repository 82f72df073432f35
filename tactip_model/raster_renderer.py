"""The pins' grey image without OpenGL: discs drawn as ellipses with soft edges, many images at a time."""

import cv2
import numpy as np

from tactip_twin.tactip_model.optics import LedRing, Lens, backdrop, perpendicular_axes, tip_radii


class Raster:
    """Draws the grey frame of a design from pin records, by numpy alone. Held against camera.py in the tests."""

    def __init__(self, design):
        """design: Design."""
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        self._radii = tip_radii(design)
        self._backdrop = backdrop(design, self._lens, self._leds).ravel()
        self._blank = self._backdrop.astype(np.float32)

    def render(self, tips, directions):
        """Grey frames (..., h, w) uint8 of pins with tips (..., p, 3) m and directions (..., p, 3), sensor frame."""
        tips, directions = np.asarray(tips, float), np.asarray(directions, float)
        batch = tips.shape[:-2]
        tips, directions = tips.reshape(-1, *tips.shape[-2:]), directions.reshape(-1, *directions.shape[-2:])
        frames = np.stack([self._one(t, d) for t, d in zip(tips, directions, strict=True)])
        return frames.reshape(*batch, *frames.shape[1:])

    def _one(self, tips, directions):
        centre, axes = self.ellipses(tips, directions)
        grey = self._leds.grey(tips, directions, self._design.optics.pin_albedo)
        # An ellipse of half-axes p and q is as wide as sqrt(px² + qx²) to a side; half a pixel is soft, half is rounding.
        reach = int(np.ceil(np.sqrt((axes**2).sum(2)).max())) + 1
        span, width = np.arange(-reach, reach + 1), self._lens.width
        nearest = np.rint(centre).astype(int)
        x, y = nearest[:, :1] + span, nearest[:, 1:] + span
        # A pixel's place in the unit disc, and its distance to the disc's edge in pixels along the gradient. Entry by entry:
        # these are small matrices and many pixels.
        (p, q), (r, s) = axes.transpose(1, 2, 0)[..., None, None]
        size = p * s - q * r
        a, b, c, d = s / size, -q / size, -r / size, p / size
        right, down = (x - centre[:, :1])[:, None, :], (y - centre[:, 1:])[:, :, None]
        u, v = a * right + b * down, c * right + d * down
        length = np.sqrt(u * u + v * v)
        gradient = np.sqrt((a * u + c * v) ** 2 + (b * u + d * v) ** 2)
        cover = np.clip(0.5 - (length - 1) * length / np.maximum(gradient, 1e-12), 0, 1)
        cover[length < 1e-9] = 1.0
        inside = (cover > 0) & ((x >= 0) & (x < width))[:, None, :] & ((y >= 0) & (y < width))[:, :, None]
        pin, row, column = np.nonzero(inside)
        index, cover = y[pin, row] * width + x[pin, column], cover[inside]
        paint, shade = np.zeros(width * width), np.zeros(width * width)
        np.maximum.at(paint, index, cover)
        np.maximum.at(shade, index, grey[pin])
        # Most of the frame is backdrop. Where two pins meet, a pixel stands here twice, with the same grey.
        frame, paint = self._blank.copy(), paint[index]
        frame[index] = (1 - paint) * self._backdrop[index] + paint * shade[index]
        return blur_and_quantize(frame.reshape(width, width), self._design.optics)

    def ellipses(self, tips, directions):
        """Middles (..., p, 2) and half-axes (..., p, 2, 2), columns, of the pins' discs, px of the frame.

        tips, directions: (..., p, 3), m and -, sensor frame.
        """
        shape = tips.shape[:-1]
        r = np.broadcast_to(self._radii, shape).reshape(-1, 1)
        tips, directions = tips.reshape(-1, 3), directions.reshape(-1, 3)
        u, v = r * perpendicular_axes(directions)
        edge = self._lens.project(tips + np.stack([u, -u, v, -v]))
        axes = np.stack([(edge[0] - edge[1]) / 2, (edge[2] - edge[3]) / 2], -1)
        return edge.mean(0).reshape(*shape, 2), axes.reshape(*shape, 2, 2)


def blur_and_quantize(frame, optics):
    """The lens's blur and the camera's 8 bits: frame (h, w) float, 0 to 255, to uint8."""
    if optics.blur_px > 0:
        frame = cv2.GaussianBlur(frame.astype(np.float32, copy=False), (0, 0), optics.blur_px)
    return cv2.convertScaleAbs(frame)  # rounded to the nearest, and cut at 255
