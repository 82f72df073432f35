"""How far the tip may press: the image keeps the depth, and the force limits it.

In a hollow narrower than the tip, its flanks touch first. The image then shows a shallow contact, and a servo that trusts it
alone presses on until the arm stops. The estimated force tells better. So the error of the depth, as the controller sees it,
is at most what the force leaves, and so is its motion: override control, in which the smaller of two errors is selected.
"""

import numpy as np

_STIFFNESS_N_PER_M = 1.5e3
"""Assumed rise of the force by a press, N/m: that of a tip pressed 4 mm deep on a flat surface, or between flanks [?]."""

_MAX_BACK_M = 0.7e-3
"""Longest motion back in a step, m [?]."""


class Press:
    """Limits the press of one run."""

    def __init__(self, depth_m: float, ease_force_n: float) -> None:
        """Take the depth to keep, m, and the force, N, above which the tip never moves deeper (Settings.ease_force_n)."""
        self._depth_m, self._limit_n = depth_m, ease_force_n

    def room_m(self, force_n: float | None) -> float:
        """Return by how much deeper the tip may press at a force on it, N; m, negative where it must move back. Without an
        estimate of the force there is no limit."""
        return np.inf if force_n is None else max(-_MAX_BACK_M, (self._limit_n - force_n) / _STIFFNESS_N_PER_M)

    def label(self, label: np.ndarray, force_n: float | None) -> np.ndarray:
        """Return a label (6,), m and rad, whose depth is short of the commanded one by no more than the force leaves."""
        out = label.copy()
        out[2] = min(out[2], self.room_m(force_n) - self._depth_m)
        return out

    def motion(self, motion: np.ndarray, force_n: float | None) -> np.ndarray:
        """Return a motion (4, 4) of the sensor in its own frame, no deeper than the force leaves."""
        out = motion.copy()
        out[2, 3] = min(out[2, 3], self.room_m(force_n))
        return out
