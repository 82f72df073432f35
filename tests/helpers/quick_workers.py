"""Worker processes of commands that run in the process of the tests."""

import contextlib
import multiprocessing
import os
import sys
from collections.abc import Iterator
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from typing import Any

import pytest

from tactip_twin.sim.parallel import worker_pool


@contextlib.contextmanager
def forked_workers() -> Iterator[None]:
    """Let workers start as copies of a server that has loaded the libraries, in a `with` block.

    Users' workers load them anew, which takes longer than the few contacts of a test. Workers of commands in processes of
    their own still do.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["helpers.worker_libraries"])
    start = context.Process

    def served(**settings: Any) -> ForkServerProcess:
        with pytest.MonkeyPatch.context() as path:
            path.setenv("PYTHONPATH", os.pathsep.join(sys.path))
            forkserver.ensure_running()
        return start(**settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker_pool, "get_context", lambda method: context)
        patch.setattr(context, "Process", served)
        # A search has such a server, too: it is the same one.
        patch.setattr(context, "set_forkserver_preload", lambda modules: None)
        yield
