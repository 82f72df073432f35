"""A real sensor, live: for each frame its detected pins, its tactile image, and the pose that a network predicts."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tactip_twin.learning.filter_settings import FilterSettings
from tactip_twin.learning.image_check import MAX_APART_PX, design_of, image_check, pins_apart_px
from tactip_twin.learning.pose_filter import PoseFilter
from tactip_twin.sim.labels import COMPONENTS
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.sim2real.sensor.preprocess import MIN_PIN_FRACTION, FrameReader
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import reference_pixels
from tactip_twin.tactip_model.pin_detection import find_blobs

if TYPE_CHECKING:
    from tactip_twin.learning.model import Model

_MIN_CONTACT_PROBABILITY = 0.5
"""Probability of contact below which the filter of poses starts again."""

_MIN_PINS = 20
"""Minimum number of pins in the first frame."""


@dataclass(frozen=True)
class Reading:
    """Result of one frame."""

    number: int
    """Number of the frame, from 0."""
    time_s: float
    """Time since the first frame, s."""
    pins: int
    """Number of detected pins; 0 if the frame is unusable."""
    image: np.ndarray
    """(size, size) uint8, the tactile image."""
    predicted: dict[str, float]
    """Predicted components, mm and degrees, and other quantities that the network estimates; empty without a network, or if
    the frame is unusable."""
    fault: str
    """Why the frame is unusable; empty if it is usable."""

    deviations: dict[str, float] = field(default_factory=dict)
    """Standard deviations of the predicted values; empty if the network has none."""
    pins_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """(n, 2) places of the detected pins on the tactile image, px."""
    rest_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    """(p, 2) those of the undeformed tip."""
    unlike: str = ""
    """In what the image is unlike those that the network learned, in words; empty if in nothing, or without a network."""

    def as_json(self) -> dict[str, Any]:
        """Return the Reading as a dict of JSON types, without its image."""
        row: dict[str, Any] = {"frame": self.number, "time_s": round(self.time_s, 4), "pins": self.pins}
        row |= {name: round(value, 4) for name, value in self.predicted.items()}
        row |= {f"{name}_deviation": round(value, 4) for name, value in self.deviations.items()}
        return row | {name: text for name, text in (("fault", self.fault), ("unlike", self.unlike)) if text}


class LiveSensor:
    """Converts frames to Readings."""

    def __init__(
        self,
        frames: Iterable[np.ndarray],
        options: ImagePreprocessing,
        model: "Model | None" = None,
        neutral: np.ndarray | None = None,
        settings: FilterSettings | None = None,
    ) -> None:
        """Prepare to read frames.

        Args:
            frames: Frames (h, w, 3) uint8.
            options: Preprocessing of the frames.
            model: Network that predicts the pose.
            neutral: (h, w, 3) uint8, image of the undeformed tip; the first frame if None.
            settings: Settings of the filter that fuses the poses of successive frames; None: each frame stands alone.

        Raises:
            TactipError: If the network takes images of another size or kind.
        """
        if model and model.size != options.size_px:
            raise TactipError(f"size_px must be {model.size} for this network, got {options.size_px}")
        if model and model.grey != options.grey:
            raise TactipError(f"grey must be {model.grey} for this network, got {options.grey}")
        self._frames, self._options, self._model, self._neutral = frames, options, model, neutral
        self._filter = None
        if model and settings and settings.enabled and model.config.deviations:
            self._filter = PoseFilter("edge" if model.labels.task == "edge" else "surface", settings)

    def __iter__(self) -> Iterator[Reading]:
        """Yield Readings.

        Raises:
            TactipError: If the first frame shows no tip, or the source of the frames fails.
        """
        reader, rest, start, foreign = None, np.zeros((0, 2)), 0.0, ""
        check = None if self._model is None else image_check(self._model)
        for number, frame in enumerate(self._frames):
            if reader is None:
                neutral = frame if self._neutral is None else self._neutral
                reader, rest, start = self._reader(neutral)
                foreign = self._foreign(rest)
            try:
                binary = reader.masked(frame)
                image = reader.tactile(frame, binary)
            except TactipError as error:
                if number == 0:
                    raise TactipError(f"the first frame cannot be used: {error}") from error
                size = self._options.size_px
                yield Reading(number, time.perf_counter() - start, 0, np.zeros((size, size), np.uint8), {}, str(error))
                continue
            blobs = reader.on_image(find_blobs(binary).centres, binary)
            pins, usual = len(blobs), len(rest)
            fault = "" if pins >= MIN_PIN_FRACTION * usual else f"{pins} pins detected, the undeformed tip has {usual}"
            predicted, deviations = ({}, {}) if fault or self._model is None else self._predicted(self._model, image)
            unlike = (foreign or check.problem(image)) if check and predicted else ""
            yield Reading(
                number, time.perf_counter() - start, pins, image, predicted, fault, deviations, blobs, rest, unlike
            )

    def _reader(self, neutral: np.ndarray) -> tuple[FrameReader, np.ndarray, float]:
        """Return a FrameReader, the places (p, 2) of the undeformed tip's pins on the image, px, and the time now, s."""
        try:
            reader = FrameReader(self._options, neutral)
        except TactipError as error:
            raise TactipError(f"no tip in the first frame: {error}; check light, threshold and crop") from error
        binary = reader.masked(neutral)
        rest = reader.on_image(find_blobs(binary).centres, binary)
        if len(rest) < _MIN_PINS:
            raise TactipError(
                f"the first frame must show at least {_MIN_PINS} pins, got {len(rest)}: check light, threshold and crop"
            )
        return reader, rest, time.perf_counter()

    def _foreign(self, rest: np.ndarray) -> str:
        """Return in what the places (p, 2), px, of the undeformed tip's pins differ from those that the network learned, in
        words; empty if in nothing, or without a network."""
        design = None if self._model is None else design_of(self._model)
        apart = 0.0 if design is None else pins_apart_px(design, reference_pixels(rest, self._options.size_px))
        if apart <= MAX_APART_PX:
            return ""
        return f"the places of the pins at rest, {apart:.1f} px of 256 away"

    def _predicted(self, model: "Model", image: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
        """Return a network's estimates and their standard deviations by column, from a tactile image (size, size)."""
        found = model.estimate(image[None])
        values, deviations = found.means[0], None if found.deviations is None else found.deviations[0]
        if self._filter is not None and deviations is not None:
            values, deviations = _fused(self._filter, model, values, deviations, found.contact)
        predicted = dict(zip(model.columns, map(float, values), strict=True))
        if found.contact is not None:
            predicted["contact"] = float(found.contact[0])
        return predicted, {} if deviations is None else dict(zip(model.columns, map(float, deviations), strict=True))


def _fused(
    pose_filter: PoseFilter, model: "Model", values: np.ndarray, deviations: np.ndarray, contact: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimates and deviations (c,) whose pose is fused with those of earlier frames, while the tip touches.

    The sensor's motion is unknown: the filter takes it for slow (FilterSettings.rest_mm and rest_deg).
    """
    if contact is not None and contact[0] < _MIN_CONTACT_PROBABILITY:
        pose_filter.reset()
        return values, deviations
    rows = [COMPONENTS.index(c) for c in model.labels.components]
    label, spread = np.zeros(6), np.zeros(6)
    label[rows], spread[rows] = values[: len(rows)], deviations[: len(rows)]
    state = pose_filter.step(np.eye(4), from_mm_deg(label), from_mm_deg(spread))
    fused, their = values.copy(), deviations.copy()
    fused[: len(rows)], their[: len(rows)] = to_mm_deg(state.label)[rows], to_mm_deg(state.deviations)[rows]
    return fused, their
