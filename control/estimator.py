"""What tells the servo the pose of what it feels: a network that sees the image; and, to hold it to, the truth."""

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image


@dataclass(frozen=True)
class Estimate:
    """What is told of one touch."""

    label: np.ndarray
    """(6,), m and rad (sim/pose.py); what is not learned of the task is 0."""
    touching: float
    """How far the image is from that of a tip in the air, 0 to 1; a half is far."""
    image: np.ndarray | None
    """(size, size) uint8; None where nothing is seen."""
    image_s: float = 0.0
    """Time for the image, s."""
    network_s: float = 0.0
    """Time for the network, s."""


class Estimator(ABC):
    """Tells a Estimate of a touch."""

    @abstractmethod
    def look(self, touch, T_base_tcp) -> Estimate:
        """touch: sim.touch.TipState. T_base_tcp: (4, 4), where the sensor truly is: for the oracle alone."""


class NetworkEstimator(Estimator):
    """A network that sees the tactile image, and nothing else."""

    def __init__(self, model, design, renderer="pyrender", noise_grey=0.0, seed=0):
        """model: learning.model.Model. design: Design. renderer: `pyrender` or `raster`. noise_grey: float, standard
        deviation of the camera's noise, of 255. seed: int, of the noise.

        Raises TactipError where the design's images are not those that the network takes.
        """
        if design.image.size_px != model.size:
            raise TactipError(f"the network takes images of {model.size} px and the design makes {design.image.size_px}")
        self._model, self._settings = model, design.image
        self._render = renderer_named(renderer, design)
        self._noise, self._draw = noise_grey, np.random.default_rng(seed)
        self._rows = [COMPONENTS.index(c) for c in model.labels.components]
        self._neutral = self._image(*neutral_pins(design)) > 127

    def _image(self, tips, directions):
        frame = self._render(tips, directions)
        if self._noise:
            frame = np.clip(frame + self._draw.normal(0, self._noise, frame.shape), 0, 255).round().astype(np.uint8)
        return tactile_image(frame, self._settings)

    def look(self, touch, T_base_tcp):
        """See Estimator."""
        start = time.perf_counter()
        image = self._image(touch.tips, touch.directions)
        seen = time.perf_counter()
        told = np.zeros(6)
        told[self._rows] = self._model.predict(image[None])[0]
        end = time.perf_counter()
        white = image > 127
        union = int((white | self._neutral).sum())
        apart = 1 - int((white & self._neutral).sum()) / union if union else 0.0
        return Estimate(from_mm_deg(told), apart, image, seen - start, end - seen)


class Oracle(Estimator):
    """The truth: for tests, and to tell errors of control from those of perception."""

    def __init__(self, truth, T_base_object):
        """truth: SurfaceGroundTruth or EdgeGroundTruth. T_base_object: (4, 4)."""
        self._truth, self._to_object = truth, np.linalg.inv(T_base_object)

    def look(self, touch, T_base_tcp):
        """See Estimator."""
        return Estimate(self._truth.label(self._to_object @ T_base_tcp), float(np.linalg.norm(touch.force) > _LEAST_N), None)


_LEAST_N = 0.02
"""Force from which the oracle says that there is contact, N."""
