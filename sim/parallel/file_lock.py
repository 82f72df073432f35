"""Lock files, by which only one command at a time works in a folder."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from tactip_twin.tactip_model.errors import TactipError


@contextlib.contextmanager
def locked(path: Path, doing: str) -> Iterator[None]:
    """Hold a lock file for a `with` block. The kernel releases it when the process ends, however it ends.

    Args:
        path: The lock file.
        doing: What another command that holds the lock is doing, for the message: "making the set in out".

    Raises:
        TactipError: Another command holds it.
        OSError: The file cannot be written.
    """
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TactipError(f"another command is {doing}: wait for it, or stop it") from None
        yield
