"""MuJoCo's warnings, counted per thread instead of printed."""

import contextlib
import threading
from collections.abc import Callable, Iterator

import mujoco


class _WarningRouter:
    """The process's handler of MuJoCo's warnings, which sends each warning to the list of the thread that caused it.

    A process has one handler, and contacts may be simulated in threads (benchmarks/scale/performance.py).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lists: dict[int, list[str]] = {}
        self._previous: Callable[[str], None] | None = None

    def collect(self, messages: list[str] | None) -> list[str] | None:
        """Send the warnings of this thread to a list or, if None, to the previous handler. Return the list before."""
        thread = threading.get_ident()
        with self._lock:
            if not self._lists:
                self._previous = mujoco.get_mju_user_warning()
            before = self._lists.pop(thread, None)
            if messages is not None:
                self._lists[thread] = messages
            single = next(iter(self._lists.values())).append if self._lists else self._previous
            # An exception in a handler ends the process, and Ctrl-C may raise in _route, so a single thread avoids it.
            mujoco.set_mju_user_warning(self._route if len(self._lists) > 1 else single)
        return before

    def _route(self, message: str) -> None:
        # A warning of a thread without a list goes to all lists, because a needless rejection does less harm.
        own = self._lists.get(threading.get_ident())
        for messages in list(self._lists.values()) if own is None else [own]:
            messages.append(message)


_ROUTER = _WarningRouter()


@contextlib.contextmanager
def counted_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings of this thread in a list instead of printing them. Several threads may do so at a time."""
    messages: list[str] = []
    before = _ROUTER.collect(messages)
    try:
        yield messages
    finally:
        _ROUTER.collect(before)
