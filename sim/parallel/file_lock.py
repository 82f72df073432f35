"""A folder is one command's at a time."""

import contextlib
import fcntl

from tactip_twin.tactip_model.errors import TactipError


@contextlib.contextmanager
def locked(path, doing):
    """Hold the lock file `path` (Path) for a `with` block. doing: str, what another command that holds it is doing.

    Raises TactipError where one does, and OSError. The kernel lets go when the process ends, however it ends.
    """
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TactipError(f"another command is {doing}: wait for it, or stop it") from None
        yield
