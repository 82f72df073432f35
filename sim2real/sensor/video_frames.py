"""Frames of a sensor's video: all of them in order, or one."""

import contextlib
from collections import deque
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.tactip_model.errors import TactipError

VIDEOS = (".mp4", ".avi", ".mov", ".mkv")
"""File endings of videos."""


class VideoFrames:
    """Frames of a video, in order."""

    def __init__(self, path: str | Path) -> None:
        """Open a video. Raises TactipError if the file is not a video."""
        self._path = Path(path)
        if not self._path.is_file():
            raise TactipError(f"the video {path} does not exist")
        with silence_opencv():
            self._capture = cv2.VideoCapture(str(path))
        if not self._capture.isOpened():
            raise TactipError(f"{path} cannot be read as a video")

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield frames (h, w, 3) uint8. Raises TactipError if there is none."""
        count = 0
        while True:
            good, frame = self._capture.read()
            if not good:
                break
            count += 1
            yield frame
        if not count:
            raise TactipError(f"{self._path} cannot be read as a video: it has no frame")

    def close(self) -> None:
        """Close the video."""
        self._capture.release()


def frame_of(path: str | Path, index: int) -> np.ndarray:
    """Return one frame (h, w, 3) uint8 of a video. It is read in order, because seeking is unreliable between key frames.

    Args:
        path: The video.
        index: Frame: 0 is the first and -1 the last.

    Raises:
        TactipError: If the video cannot be read or has no such frame.
    """
    video = VideoFrames(path)
    try:
        found = list(islice(video, index, index + 1)) if index >= 0 else deque(video, -index)
    finally:
        video.close()
    if len(found) < (1 if index >= 0 else -index):
        raise TactipError(f"the video has no frame {index} (0 is the first, -1 the last)")
    return found[0]


@contextlib.contextmanager
def silence_opencv() -> Iterator[None]:
    """Silence OpenCV's log about files and devices that cannot be opened: the error raised afterwards names it."""
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(0)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)
