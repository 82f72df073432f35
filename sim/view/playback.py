"""Where a replay is: playing or not, at which step, how fast. It knows the time it is told, and nothing of screens."""

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Speeds that are offered, times the rate."""


class Playback:
    """The position in a recording."""

    def __init__(self, steps, events=(), rate=10.0):
        """steps: int, at least 1. events: steps (ints) at which something happened. rate: float, steps a second at speed
        1."""
        self._last, self._events, self._rate = max(0, steps - 1), sorted({min(e, max(0, steps - 1)) for e in events}), rate
        self.playing = False
        self.speed = 1.0
        self._at, self._told = 0.0, None

    @property
    def step(self):
        """The step (int) that is shown."""
        return int(self._at + 1e-6)

    def tick(self, now_s):
        """Let time go on to now_s, s. Returns the step."""
        if self.playing and self._told is not None:
            self._at = min(self._at + max(0.0, now_s - self._told) * self._rate * self.speed, float(self._last))
            if self._at >= self._last:
                self.playing = False
        self._told = now_s
        return self.step

    def toggle(self):
        """Play or pause; at the end, play again from the start."""
        if not self.playing and self.step >= self._last:
            self._at = 0.0
        self.playing = not self.playing

    def go(self, step):
        """Go to a step, or to the end nearest to it, and stay there if paused."""
        self._at = float(min(max(int(step), 0), self._last))

    def forward(self, steps):
        """Pause, and go some steps on (or back)."""
        self.playing = False
        self.go(self.step + steps)

    def jump(self, sense):
        """Pause, and go to the next event (sense 1) or the one before (-1); stays where there is none."""
        self.playing = False
        ahead = [e for e in self._events if (e - self.step) * sense > 0]
        if ahead:
            self.go(min(ahead) if sense > 0 else max(ahead))
