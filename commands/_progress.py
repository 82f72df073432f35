"""Status messages on stderr for work that shows nothing yet, such as loading libraries and reading sets."""

import sys
import threading
from types import TracebackType


def to_stderr(line: str) -> None:
    """Print a progress message."""
    print(line, file=sys.stderr, flush=True)


_PATIENCE_S = 1.0
"""Delay of a message, s: a command that fails at once prints its error only."""


class DelayedStatus:
    """A context manager that prints a status message on stderr, unless its block ends soon."""

    def __init__(self, doing: str) -> None:
        """Set the message, such as `reading the sets`."""
        self._timer = threading.Timer(_PATIENCE_S, to_stderr, (f"{doing} …",))
        self._timer.daemon = True

    def __enter__(self) -> "DelayedStatus":
        self._timer.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.cancel()

    def cancel(self) -> None:
        """Cancel the message, because something else is shown now."""
        self._timer.cancel()
