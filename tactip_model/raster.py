"""The pins' grey image without OpenGL: discs drawn as ellipses with soft edges, many images at a time."""

import cv2
import numpy as np

from tactip_model.optics import LedRing, Lens, across, backdrop, tip_radii


class Raster:
    """Draws the grey frame of a design from pin records, by numpy alone. Held against camera.py in the tests."""

    def __init__(self, design):
        """design: Design."""
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        self._radii = tip_radii(design)
        self._backdrop = backdrop(design, self._lens, self._leds)

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
        # A pixel's place in the unit disc, and its distance to the disc's edge in pixels along the gradient.
        reach = int(np.ceil(np.sqrt((axes**2).sum((1, 2))).max())) + 1
        span = np.arange(-reach, reach + 1)
        pixels = np.rint(centre).astype(int)[:, None, None, :] + np.stack(np.meshgrid(span, span), -1)
        inverse = np.linalg.inv(axes)
        place = np.einsum("pij,pyxj->pyxi", inverse, pixels - centre[:, None, None, :])
        length = np.linalg.norm(place, axis=-1)
        gradient = np.linalg.norm(np.einsum("pij,pyxi->pyxj", inverse, place), axis=-1)
        outside = (length - 1) * length / np.maximum(gradient, 1e-12)
        cover = np.clip(0.5 - outside, 0, 1)
        cover[length < 1e-9] = 1.0
        width = self._lens.width
        inside = ((pixels >= 0) & (pixels < width)).all(-1) & (cover > 0)
        index = (pixels[..., 1] * width + pixels[..., 0])[inside]
        paint = np.zeros(width * width)
        np.maximum.at(paint, index, cover[inside])
        shade = np.zeros(width * width)
        np.maximum.at(shade, index, np.broadcast_to(grey[:, None, None], cover.shape)[inside])
        frame = (1 - paint) * self._backdrop.ravel() + paint * shade
        return finish(frame.reshape(width, width), self._design.optics)

    def ellipses(self, tips, directions):
        """Middles (..., p, 2) and half-axes (..., p, 2, 2), columns, of the pins' discs, px of the frame.

        tips, directions: (..., p, 3), m and -, sensor frame.
        """
        shape = tips.shape[:-1]
        r = np.broadcast_to(self._radii, shape).reshape(-1, 1)
        tips, directions = tips.reshape(-1, 3), directions.reshape(-1, 3)
        edge = [self._lens.project(tips + s * r * w) for w in across(directions) for s in (1, -1)]
        axes = np.stack([(edge[0] - edge[1]) / 2, (edge[2] - edge[3]) / 2], -1)
        return np.mean(edge, axis=0).reshape(*shape, 2), axes.reshape(*shape, 2, 2)


def finish(frame, optics):
    """The lens's blur and the camera's 8 bits: frame (h, w) float, 0 to 255, to uint8."""
    if optics.blur_px > 0:
        frame = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), optics.blur_px)
    return np.clip(np.rint(frame), 0, 255).astype(np.uint8)
