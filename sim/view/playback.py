"""The state of a replay: playing or paused, at which step, how fast. It is independent of clocks and screens."""

from collections.abc import Iterable

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Speeds to choose from, times the rate."""


class Playback:
    """The position in a recording."""

    def __init__(self, steps: int, events: Iterable[int] = (), rate: float = 10.0) -> None:
        """Start at the first step, paused.

        Args:
            steps: Number of steps, at least 1.
            events: Steps at which something happened.
            rate: Steps per second at speed 1.
        """
        self._last, self._events, self._rate = max(0, steps - 1), sorted({min(e, max(0, steps - 1)) for e in events}), rate
        self.playing = False
        self.speed = 1.0
        self._position = 0.0
        self._last_tick_s: float | None = None

    @property
    def step(self) -> int:
        """Step that is shown."""
        return int(self._position + 1e-6)

    def tick(self, now_s: float) -> int:
        """Advance to a time, s, and return the step."""
        if self.playing and self._last_tick_s is not None:
            elapsed = max(0.0, now_s - self._last_tick_s)
            self._position = min(self._position + elapsed * self._rate * self.speed, float(self._last))
            if self._position >= self._last:
                self.playing = False
        self._last_tick_s = now_s
        return self.step

    def toggle(self) -> None:
        """Play or pause; at the end, play again from the start."""
        if not self.playing and self.step >= self._last:
            self._position = 0.0
        self.playing = not self.playing

    def go(self, step: float) -> None:
        """Move to the step, or to the first or last one if there is no such step; keep playing or pausing."""
        self._position = float(min(max(int(step), 0), self._last))

    def forward(self, steps: int) -> None:
        """Pause, and move by a number of steps, which may be negative."""
        self.playing = False
        self.go(self.step + steps)

    def jump(self, sense: int) -> None:
        """Pause, and move to the next event (sense 1) or the previous one (-1), if there is one."""
        self.playing = False
        ahead = [e for e in self._events if (e - self.step) * sense > 0]
        if ahead:
            self.go(min(ahead) if sense > 0 else max(ahead))
