"""How far the tip may press: the image keeps the depth, and the force limits it.

In a hollow narrower than the tip, its flanks touch first. The image then shows a shallow contact, and a servo that trusts it
alone presses on until the arm stops. The estimated force tells better. So the error of the depth in the controller is at
most what the force leaves, and so is its motion: override control, in which the smaller of two errors is selected.
"""

import numpy as np

_STIFFNESS_N_PER_M = 1.5e3
"""Assumed rise of the force by a press, N/m: that of a tip pressed 4 mm deep on a flat surface, or between flanks [?]."""

_MAX_BACK_M = 0.7e-3
"""Longest motion back in a step, m [?]."""


def press_room_m(force_n: float | None, ease_force_n: float) -> float:
    """Return how far the tip may move along its axis, m; negative where it must move back.

    Args:
        force_n: Estimated force on the tip, N; without one there is no limit.
        ease_force_n: Force above which the tip moves back, N (Settings.ease_force_n).
    """
    return np.inf if force_n is None else max(-_MAX_BACK_M, (ease_force_n - force_n) / _STIFFNESS_N_PER_M)
