"""Workers end without a noise, whatever the moment."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor

from sim.crew import _serve


def test_a_worker_whose_last_reply_is_not_read_ends_quietly():
    """As at Ctrl-C: the parent closes its end with the reply still in it, which a socket tells as a reset."""
    ours, theirs = multiprocessing.Pipe()
    done = []
    with ThreadPoolExecutor(1) as pool:
        life = pool.submit(_serve, theirs, lambda: done.append, ())
        ours.send("a task")
        assert ours.poll(20)
        ours.close()
        assert life.result(timeout=20) is None
    assert done == ["a task"]
