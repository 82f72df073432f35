"""Workers end with a parent that is killed."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tactip_twin.sim.parallel.parent_watch import end_with_parent

CODE = """
import multiprocessing, os, sys, time
from tactip_twin.sim.parallel.parent_watch import end_with_parent

def work():
    end_with_parent()
    os.write(1, b"%d\\n" % os.getpid())  # in one piece: both workers write to the same pipe
    time.sleep(600)

if __name__ == "__main__":
    context = multiprocessing.get_context(sys.argv[1])
    for process in [context.Process(target=work) for _ in range(2)]:
        process.start()
    time.sleep(600)
"""


def _runs(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{process}/stat") as file:  # a dead child that nobody has waited for is still listed
        return file.read().rsplit(")", 1)[1].split()[0] != "Z"


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_end_with_parent_killed_parent_leaves_no_worker(tmp_path, method):
    (tmp_path / "parent.py").write_text(CODE)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py"), method], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout is not None
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    try:
        assert all(map(_runs, workers))
        parent.kill()
        parent.wait()
        end = time.monotonic() + 20
        while any(map(_runs, workers)):
            assert time.monotonic() < end, "a worker outlives its parent"
            time.sleep(0.02)
    finally:
        parent.stdout.close()
        for worker in filter(_runs, workers):
            os.kill(worker, signal.SIGKILL)


def test_end_with_parent_in_a_first_process_raises():
    with pytest.raises(RuntimeError, match="in a process that multiprocessing has started"):
        end_with_parent()
