"""Worker processes that do not outlive a parent that was killed."""

import os
import threading
from multiprocessing import connection, parent_process


def end_with_parent() -> None:
    """End this process as soon as its parent ends, even by a kill. Call it once, in a process of `multiprocessing`.

    A killed parent cannot end its workers. A worker that outlives it would hold locks that the resuming command needs.

    Raises:
        RuntimeError: This process was not started by `multiprocessing`.
    """
    parent = parent_process()
    if parent is None:
        raise RuntimeError("end_with_parent must be called in a process that multiprocessing has started")
    sentinel: int = parent.sentinel  # pyright: ignore[reportAttributeAccessIssue]

    def wait() -> None:
        connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=wait, name="end_with_parent", daemon=True).start()
