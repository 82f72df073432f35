"""Sources of live frames: a camera, or a folder of images one after the other (videos: sim2real/sensor/video_frames.py)."""

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim2real.sensor.preprocess import IMAGES, load
from tactip_twin.sim2real.sensor.video_frames import silence_opencv
from tactip_twin.tactip_model.errors import TactipError

_MAX_SILENCE_S = 3.0
"""Time without a frame after which a camera counts as unplugged, s."""


class CameraFrames:
    """Frames (h, w, 3) uint8 of a camera of this machine, always the newest."""

    def __init__(self, device: int, max_silence_s: float = _MAX_SILENCE_S) -> None:
        """Open a camera by its number. Raises TactipError if there is none."""
        self._device, self._max_silence_s = device, max_silence_s
        with silence_opencv():
            self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise TactipError(
                f"camera {device} cannot be opened: check that it is plugged in and not used by another program"
            )
        # A queued frame would be out of date.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield frames until it is closed. Raises TactipError if no frame arrives for a while."""
        last = time.monotonic()
        while True:
            good, frame = self._capture.read()
            if good:
                last = time.monotonic()
                yield frame
            elif time.monotonic() - last > self._max_silence_s:
                raise TactipError(
                    f"no frame from camera {self._device} for {self._max_silence_s:g} s: check that it is plugged in"
                )
            else:
                time.sleep(0.01)

    def close(self) -> None:
        """Close the camera."""
        self._capture.release()


class ImageFrames:
    """The images of a folder, in the order of the numbers in their names."""

    def __init__(self, folder: str | Path) -> None:
        """List the images of a folder. Raises TactipError if there is none."""
        folder = Path(folder)
        if not folder.is_dir():
            raise TactipError(f"{folder} is not a folder of images")
        self._paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGES), key=_by_number)
        if not self._paths:
            raise TactipError(f"no image in {folder}: supported file types are {', '.join(IMAGES)}")

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield frames (h, w, 3) uint8. Raises TactipError on one that cannot be read."""
        for path in self._paths:
            try:
                yield load(path)
            except TactipError as error:
                raise TactipError(f"{path}: {error}") from error

    def close(self) -> None:
        """Do nothing: no file stays open."""


def _by_number(path: Path) -> tuple[list[int], str]:
    digits = "".join(c if c.isdigit() else " " for c in path.stem).split()
    return [int(d) for d in digits], path.name
