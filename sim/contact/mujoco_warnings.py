"""MuJoCo's warnings, counted by thread instead of printed."""

import contextlib
import threading

import mujoco


class _Warnings:
    """Where MuJoCo's warnings go. A process has one handler of them, and contacts are played in threads, too
    (benchmarks/scale/performance.py): a warning is heard in the thread that steps, and is that thread's."""

    def __init__(self):
        self._lock, self._lists, self._others = threading.Lock(), {}, None

    def hear(self, messages):
        """Let this thread's warnings go into a list or, if None, where they would else. Returns where they went."""
        thread = threading.get_ident()
        with self._lock:
            if not self._lists:
                self._others = mujoco.get_mju_user_warning()
            before = self._lists.pop(thread, None)
            if messages is not None:
                self._lists[thread] = messages
            alone = next(iter(self._lists.values())).append if self._lists else self._others
            # What raises in a handler ends the process, and Ctrl-C may raise in _sort: one thread alone does without it.
            mujoco.set_mju_user_warning(self._sort if len(self._lists) > 1 else alone)
        return before

    def _sort(self, message):
        # That of a thread that counts none, of a pool say, is everybody's: better a record refused than one trusted.
        mine = self._lists.get(threading.get_ident())
        for messages in list(self._lists.values()) if mine is None else [mine]:
            messages.append(message)


_WARNINGS = _Warnings()


@contextlib.contextmanager
def counted_warnings():
    """MuJoCo's warnings of this thread counted in a list instead of shown: they are part of the record. Threads may count at
    a time."""
    messages = []
    before = _WARNINGS.hear(messages)
    try:
        yield messages
    finally:
        _WARNINGS.hear(before)
