"""Where frames come from: a camera, a folder of images (a film: sim2real/sensor/video_frames.py); one after the other,
as a sensor's
camera gives them."""

import time
from pathlib import Path

import cv2

from tactip_twin.sim2real.sensor.preprocess import IMAGES, load
from tactip_twin.sim2real.sensor.video_frames import quiet
from tactip_twin.tactip_model.errors import TactipError

_PATIENCE_S = 3.0
"""How long a camera may give no frame before it is taken for unplugged, s."""


class CameraFrames:
    """Frames (h, w, 3) uint8 of a camera of this machine, the newest each time."""

    def __init__(self, device, patience_s=_PATIENCE_S):
        """device: int. Raises TactipError where there is no such camera."""
        self._device, self._patience_s = device, patience_s
        with quiet():
            self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise TactipError(f"the camera {device} cannot be opened: is it plugged in, and not in use by another program?")
        # A frame that waited in a queue tells of a touch that is over.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def __iter__(self):
        """Yields frames until it is closed. Raises TactipError where none has come for a while."""
        last = time.monotonic()
        while True:
            good, frame = self._capture.read()
            if good:
                last = time.monotonic()
                yield frame
            elif time.monotonic() - last > self._patience_s:
                raise TactipError(
                    f"the camera {self._device} has given no frame for {self._patience_s:g} s: is it unplugged?"
                )
            else:
                time.sleep(0.01)

    def close(self):
        """Let go of the camera."""
        self._capture.release()


class ImageFrames:
    """The images of a folder, in the order of the numbers in their names."""

    def __init__(self, folder):
        """folder: path. Raises TactipError where there is no image."""
        folder = Path(folder)
        if not folder.is_dir():
            raise TactipError(f"{folder} is no folder of images")
        self._paths = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGES), key=_by_number)
        if not self._paths:
            raise TactipError(f"there is no image in {folder}: {', '.join(IMAGES)} are looked for")

    def __iter__(self):
        """Yields frames (h, w, 3) uint8. Raises TactipError on one that cannot be read."""
        for path in self._paths:
            try:
                yield load(path)
            except TactipError as error:
                raise TactipError(f"{path}: {error}") from error

    def close(self):
        """Nothing is held."""


def _by_number(path):
    digits = "".join(c if c.isdigit() else " " for c in path.stem).split()
    return [int(d) for d in digits], path.name
