"""What to do where the tip cannot continue: try again on the spot, then farther along the route."""

from dataclasses import dataclass

import numpy as np

from tactip_twin.control.options import Settings

_RECOVERED_STEPS = 3
"""Good steps on the route after which the count of tries restarts at zero."""

_PROGRESS_STEPS = 60
"""Steps on the route without progress after which the tip counts as stuck: six times as many as the shortest steps need."""

_PROGRESS_MM = 2.0
"""Travel along the route that counts as progress, mm."""

_ON_THE_SPOT = ("contact lost", "estimate out of range", "diverged")
"""Kinds of obstacles that another contact on the spot may remove."""

_MAX_EVASIONS = 5
"""Number of stops of the arm and of collisions that are evaded without lifting off, until there is progress [?]."""


class Obstacle(Exception):
    """The tip cannot continue here."""

    def __init__(self, kind: str, what: str) -> None:
        """Take the kind of the obstacle, and a description with values."""
        super().__init__(what)
        self.kind = kind


class FollowingFailed(Exception):
    """A route cannot be followed further; the message says why."""


@dataclass(frozen=True)
class LeftOut:
    """A stretch of the route that the tip did not follow."""

    from_mm: float
    """Start, mm along the route."""
    to_mm: float
    """End, mm along the route."""
    kind: str
    """Kind of the obstacle."""
    places_m: list[list[float]]
    """(n, 3) m, base frame: points along the stretch, as far as the follower knows it."""


@dataclass(frozen=True)
class Try:
    """What to try next."""

    skip_mm: float | None
    """Travel along the route before the next approach, mm: infinite for the rest of its part; None: stay on the spot."""
    turned: bool = False
    """Whether to approach with the sensor along the route's own direction of approach instead of as it was."""


class Tries:
    """Counts the tries since the tip last followed the route, and chooses the next."""

    def __init__(self, settings: Settings, can_turn: bool) -> None:
        """Take the limits, and whether the route has a direction of approach."""
        self._settings, self._can_turn = settings, can_turn
        self._on_the_spot, self._skips, self._good, self._steps, self._at_mm = 0, 0, 0, 0, 0.0
        self._evasions, self._evaded_at_mm = 0, 0.0

    def evades(self, travelled_m: float) -> bool:
        """Count a stop or a collision at a distance along the route, and return whether to evade it without lifting off."""
        travelled_mm = 1e3 * travelled_m
        if travelled_mm >= self._evaded_at_mm + _PROGRESS_MM:
            self._evasions, self._evaded_at_mm = 0, travelled_mm
        self._evasions += 1
        return self._evasions <= _MAX_EVASIONS

    def next(self, kind: str) -> Try:
        """Return what to try next after an obstacle of a kind."""
        s, self._good, self._steps = self._settings, 0, 0
        if kind in _ON_THE_SPOT and self._on_the_spot < s.max_recoveries:
            self._on_the_spot += 1
            return Try(None)
        place, turned = divmod(self._skips, 2) if self._can_turn else (self._skips, 0)
        self._skips += 1
        if turned:
            return Try(0.0, turned=True)
        if place < s.max_skips:
            return Try(s.skip_mm * (1 + place // 2))
        self._skips = 0  # the next part starts afresh
        return Try(np.inf)

    def followed(self, travelled_m: float) -> None:
        """Count a good step on the route, at a distance along it. Raises Obstacle if the tip is stuck."""
        self._good, self._steps = self._good + 1, self._steps + 1
        travelled_mm = 1e3 * travelled_m
        if travelled_mm >= self._at_mm + _PROGRESS_MM:
            self._at_mm, self._steps = travelled_mm, 0
            if self._good >= _RECOVERED_STEPS:
                self._on_the_spot = self._skips = 0
        if self._steps > _PROGRESS_STEPS:
            raise Obstacle("no progress", f"{_PROGRESS_STEPS} steps moved the tip by less than {_PROGRESS_MM:g} mm")

    def skipped_to(self, travelled_m: float) -> None:
        """Note a new place on the route, at a distance along it, m."""
        self._at_mm = self._evaded_at_mm = 1e3 * travelled_m
        self._evasions = 0
