"""Workers end without a noise, whatever the moment."""

import multiprocessing
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

from sim.crew import _serve, peak_mib


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


def test_memory_is_the_process_s_own():
    """Of a process whose parent holds 300 MiB: not that."""
    hog = bytearray(300 * 2**20)
    hog[::4096] = b"x" * len(hog[::4096])
    code = "from sim.crew import peak_mib; print(peak_mib())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 5 < float(told.stdout) < 150
    assert peak_mib() > 300
