"""Estimators of the sensor's pose on the object: a network or any function of the tactile image, and the ground truth.

Any object with the method `estimate` of Estimator can take the network's place in a servo run, and so can a plain function
from the tactile image to the label in mm and degrees.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.learning.model import Model
from tactip_twin.learning.quantities import forces_of
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.ground_truth import EdgeGroundTruth, SurfaceGroundTruth
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.renderer import RendererName, renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image

LabelFunction = Callable[[np.ndarray], ArrayLike]
"""A function from a tactile image (size, size) uint8 to a label, mm and degrees: all six components (sim/pose.py), or those
that the task's networks predict (labels.LEARNED), in their order."""

_MIN_CONTACT_FORCE_N = 0.02
"""Force above which the ground truth counts as contact, N."""


@dataclass(frozen=True)
class Estimate:
    """The estimate for one state of the tip."""

    label: np.ndarray
    """(6,), m and rad (sim/pose.py); components that the task does not have are 0."""
    touching: float
    """Difference of the image from that of an undeformed tip, 0 to 1."""
    image: np.ndarray | None = None
    """(size, size) uint8; None if no image was used."""
    image_s: float = 0.0
    """Time for the image, s."""
    network_s: float = 0.0
    """Time for the network, s."""
    deviations: np.ndarray | None = None
    """(6,) standard deviations of the label, m and rad; None if the estimator has none."""
    force_n: float | None = None
    """Estimated upper limit of the force on the tip, N: two standard deviations above its mean. None if the estimator has
    none."""


@runtime_checkable
class Estimator(Protocol):
    """Anything that estimates the label from the state of the tip."""

    def estimate(self, touch: TipState, T_base_tcp: np.ndarray) -> Estimate:
        """Return the estimate for the present state of the tip.

        Args:
            touch: Pins, skin and force of the tip.
            T_base_tcp: (4, 4), the sensor's true pose, for estimators that return the ground truth.
        """
        ...


class ImageEstimator:
    """A function of the tactile image, with contact detected by the image's difference from the neutral one."""

    def __init__(
        self,
        predict: LabelFunction,
        components: Sequence[str],
        design: Design,
        renderer: RendererName = "pyrender",
        noise_grey: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Prepare the renderer and the neutral image.

        Args:
            predict: Function from image to label.
            components: Components, of COMPONENTS, that the function may return instead of all six.
            design: Design of the sensor.
            renderer: Renderer of the pins.
            noise_grey: Standard deviation of the camera's noise, of 255.
            seed: Seed of the noise.

        Raises:
            TactipError: The function does not return a label.
        """
        # Contact is detected in binary images, also if the network takes grey ones.
        self._predict, self._settings = predict, replace(design.image, grey=False)
        self._render = renderer_named(renderer, design)
        self._noise, self._rng = noise_grey, np.random.default_rng(seed)
        self._rows = [COMPONENTS.index(c) for c in components]
        neutral = tactile_image(self._frame(*neutral_pins(design)), self._settings)
        self._neutral = neutral > 127
        self._label(neutral)  # an unsuitable function fails before anything is written

    def _frame(self, pin_tips: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the camera's grey frame (h, w) uint8, with noise."""
        frame = self._render(pin_tips, directions)
        if self._noise:
            frame = np.clip(frame + self._rng.normal(0, self._noise, frame.shape), 0, 255).round().astype(np.uint8)
        return frame

    def _label(self, image: np.ndarray) -> np.ndarray:
        """Return the label (6,), mm and degrees, of an image."""
        predicted, label = np.asarray(self._predict(image), float), np.zeros(6)
        sizes = (len(self._rows), 6)
        allowed = f"{sizes[0]} or {sizes[1]} numbers"
        require(predicted.ndim == 1 and len(predicted) in sizes, "the label", predicted.tolist(), allowed)
        label[self._rows if len(predicted) == len(self._rows) else slice(None)] = predicted
        return label

    def estimate(self, touch: TipState, T_base_tcp: np.ndarray) -> Estimate:
        """Return the function's estimate; the true pose is not used."""
        start = time.perf_counter()
        frame = self._frame(touch.pin_tips, touch.directions)
        image = tactile_image(frame, self._settings)
        rendered = time.perf_counter()
        label, deviations, force_n = self._estimate(frame, image)
        end = time.perf_counter()
        white = image > 127
        union = int((white | self._neutral).sum())
        difference = 1 - int((white & self._neutral).sum()) / union if union else 0.0
        found = None if deviations is None else from_mm_deg(deviations)
        return Estimate(from_mm_deg(label), difference, image, rendered - start, end - rendered, found, force_n)

    def _estimate(self, frame: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, float | None]:
        """Return label (6,), standard deviations (6,) or None, mm and degrees, and Estimate.force_n.

        Args:
            frame: (h, w) uint8, the camera's grey frame.
            image: (size, size) uint8, its binary tactile image.
        """
        return self._label(image), None, None


class NetworkEstimator(ImageEstimator):
    """A network that predicts the label from the tactile image."""

    def __init__(
        self, model: Model, design: Design, renderer: RendererName = "pyrender", noise_grey: float = 0.0, seed: int = 0
    ) -> None:
        """Prepare the network. The parameters are those of ImageEstimator.

        Raises:
            TactipError: The design's images do not have the size of the network's.
        """
        if design.image.size_px != model.size:
            raise TactipError(
                f"the images of the design must be {model.size} px wide, as the network's, got {design.image.size_px} px"
            )
        self._model, self._grey = model, replace(design.image, grey=True)
        super().__init__(model.predict, model.labels.components, design, renderer, noise_grey, seed)

    def _estimate(self, frame: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, float | None]:
        """Return what the network estimates; see ImageEstimator."""
        estimates, label = self._model.estimate(self._seen(frame, image)[None]), np.zeros(6)
        components = len(self._rows)
        label[self._rows] = estimates.means[0, :components]
        if estimates.deviations is None:
            return label, None, None
        deviations, force_n = np.zeros(6), None
        deviations[self._rows] = estimates.deviations[0, :components]
        if self._model.columns[components:]:
            force, sigma = (forces_of(a[:, components:])[0] for a in (estimates.means, estimates.deviations))
            force_n = float(force + 2 * sigma)
        return label, deviations, force_n

    def _seen(self, frame: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Return the image of the kind that the network learned, grey or binary."""
        return tactile_image(frame, self._grey) if self._model.grey else image


class Oracle:
    """The ground truth, for tests and to separate errors of control from those of perception."""

    def __init__(self, truth: SurfaceGroundTruth | EdgeGroundTruth, T_base_object: np.ndarray) -> None:
        """Use the ground truth of an object at the pose T_base_object (4, 4)."""
        self._truth, self._to_object = truth, np.linalg.inv(T_base_object)

    def estimate(self, touch: TipState, T_base_tcp: np.ndarray) -> Estimate:
        """Return the true label."""
        in_contact = float(np.linalg.norm(touch.force) > _MIN_CONTACT_FORCE_N)
        return Estimate(self._truth.label(self._to_object @ T_base_tcp), in_contact)
