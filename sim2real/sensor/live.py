"""A real sensor, live: frame by frame the pins that are seen, the tactile image, and the pose that a network feels."""

import time
from dataclasses import dataclass

import numpy as np

from tactip_twin.sim2real.importing.import_set import FEW
from tactip_twin.sim2real.sensor.preprocess import FrameReader
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pin_detection import find_blobs

_LEAST_PINS = 20
"""Pins that the first frame must show."""


@dataclass(frozen=True)
class Reading:
    """What one frame gives."""

    number: int
    """Of the frame, from 0."""
    time_s: float
    """Since the first frame."""
    pins: int
    """Pins that are seen; 0 where the frame does not fit."""
    image: np.ndarray
    """(size, size) uint8, the tactile image."""
    felt: dict
    """Component to value, mm and degrees; empty without a network, and where the frame has a fault."""
    fault: str
    """What is wrong with it; empty if nothing is."""

    def as_json(self):
        """The Reading as a dict of JSON types, without its image."""
        row = {"frame": self.number, "time_s": round(self.time_s, 4), "pins": self.pins}
        row |= {name: round(value, 4) for name, value in self.felt.items()}
        return row | ({"fault": self.fault} if self.fault else {})


class LiveSensor:
    """Turns frames into Readings."""

    def __init__(self, frames, options: ImagePreprocessing, model=None, neutral=None):
        """frames: iterable of (h, w, 3) uint8. model: Model or None.
        neutral: (h, w, 3) uint8, the undeformed tip; the first frame if None.

        Raises TactipError where the network takes images of another size.
        """
        if model and model.size != options.size_px:
            raise TactipError(f"the images are {options.size_px} px wide, the network takes {model.size} px")
        self._frames, self._options, self._model, self._neutral = frames, options, model, neutral

    def __iter__(self):
        """Yields Readings. Raises TactipError where the first frame shows no tip, and where frames end in a fault of their
        source."""
        reader, usual, start = None, 0, 0.0
        for number, frame in enumerate(self._frames):
            if reader is None:
                neutral = frame if self._neutral is None else self._neutral
                reader, usual, start = self._reader(neutral)
            try:
                binary = reader.masked(frame)
                image = reader.shrunk(binary)
            except TactipError as error:
                if number == 0:
                    raise TactipError(f"the frames do not fit: {error}") from error
                size = self._options.size_px
                yield Reading(number, time.perf_counter() - start, 0, np.zeros((size, size), np.uint8), {}, str(error))
                continue
            pins = len(find_blobs(binary).centres)
            fault = "" if pins >= FEW * usual else f"{pins} pins are seen, {usual} were in the undeformed tip"
            felt = {} if fault or self._model is None else _felt(self._model, image)
            yield Reading(number, time.perf_counter() - start, pins, image, felt, fault)

    def _reader(self, neutral):
        """A FrameReader, the pins of the undeformed tip, and the time now."""
        try:
            reader = FrameReader(self._options, neutral)
        except TactipError as error:
            raise TactipError(f"the first frame shows no tip: {error}; are light, threshold and crop right?") from error
        usual = len(find_blobs(reader.masked(neutral)).centres)
        if usual < _LEAST_PINS:
            raise TactipError(f"the first frame shows {usual} pins: are light, threshold and crop right?")
        return reader, usual, time.perf_counter()


def _felt(model, image):
    """What a Model feels in a tactile image: a dict of component to value."""
    return dict(zip(model.labels.names, (float(v) for v in model.predict(image[None])[0]), strict=True))
