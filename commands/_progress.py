"""A word where nothing is to be seen yet: libraries are loaded, sets are read."""

import sys
import threading


def to_stderr(line):
    """Say a line (str) where it is not taken for a result."""
    print(line, file=sys.stderr, flush=True)


_PATIENCE_S = 1.0
"""How long nothing is said, s: what fails at once is one line, the error's."""


class Waiting:
    """Says on stderr what is being done, unless it is over in a moment; for a `with` block."""

    def __init__(self, doing):
        """doing: str, as `reading the sets`."""
        self._timer = threading.Timer(_PATIENCE_S, self._say, (doing,))
        self._timer.daemon = True

    def __enter__(self):
        self._timer.start()
        return self

    def __exit__(self, *_):
        self.over()

    def over(self):
        """There is something else to be seen now."""
        self._timer.cancel()

    @staticmethod
    def _say(doing):
        to_stderr(f"{doing} …")
