"""A viewer's camera that follows the tip, and that the viewer can turn meanwhile."""

from collections import deque

import numpy as np
import viser

_SENT = 30
"""Number of places that were sent last, which are remembered."""

_ECHO_M = 1e-5
"""Distance below which a place that a browser reports is one that was sent to it, m."""


class FollowCamera:
    """Keeps a camera where it is relative to a point.

    A browser reports its camera with a delay: a report of what was sent is no motion of the viewer's, and a motion of the
    viewer's is relative to what was sent before it.
    """

    def __init__(self, camera: viser.CameraHandle) -> None:
        """Follow with a camera."""
        self._camera = camera
        self._sent: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=_SENT)
        """Places of the eye, and those of the point with them, (3,) m."""
        self._eye, self._target = np.zeros(3), np.zeros(3)
        camera.on_update(lambda _: self._on_report())

    def start(self, eye: np.ndarray, target: np.ndarray, point: np.ndarray) -> None:
        """Follow a point (3,) from where the camera has just been placed, with an eye and a target (3,)."""
        self._eye, self._target = eye - point, target - point
        self._sent.clear()
        self._sent.append((np.array(eye), np.array(point)))

    def follow(self, point: np.ndarray) -> None:
        """Move the camera to where it was, relative to the point (3,)."""
        eye = point + self._eye
        self._sent.append((eye, np.array(point)))
        self._camera.position, self._camera.look_at = tuple(eye), tuple(point + self._target)

    def _on_report(self) -> None:
        """Take over how the viewer has turned the camera."""
        if not self._sent:
            return
        eye = np.array(self._camera.position)
        distances = [np.linalg.norm(eye - sent) for sent, _ in self._sent]
        if min(distances) > _ECHO_M:
            point = self._sent[int(np.argmin(distances))][1]
            self._eye, self._target = eye - point, np.array(self._camera.look_at) - point
