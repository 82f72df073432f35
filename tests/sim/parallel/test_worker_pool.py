"""Worker processes: how they end, their memory, and the names of tasks in messages."""

import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from helpers.set_commands import configuration
from tactip_twin.sim.dataset import generate as generation
from tactip_twin.sim.dataset.generate import Job
from tactip_twin.sim.dataset.shards import ShardFinalizer
from tactip_twin.sim.parallel.worker_pool import WorkerPool, _serve, peak_mib
from tactip_twin.tactip_model.errors import TactipError


def test_serve_last_reply_unread_ends_without_error():
    """As on Ctrl-C: the parent closes its end with the reply unread, which a socket reports as a reset."""
    ours, theirs = multiprocessing.Pipe()
    done = []
    with ThreadPoolExecutor(1) as pool:
        worker = pool.submit(_serve, theirs, lambda: done.append, ())
        ours.send("a task")
        assert ours.poll(20)
        ours.close()
        assert worker.result(timeout=20) is None
    assert done == ["a task"]


def test_peak_mib_is_of_the_process_alone():
    """A process does not report the 300 MiB of its parent."""
    hog = bytearray(300 * 2**20)
    hog[::4096] = b"x" * len(hog[::4096])
    code = "from tactip_twin.sim.parallel.worker_pool import peak_mib; print(peak_mib())"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 5 < float(result.stdout) < 150
    assert peak_mib() > 300


def _deadly():
    return lambda task: os.kill(os.getpid(), signal.SIGKILL)


def test_worker_pool_task_that_kills_two_workers_is_named():
    messages = []
    pool = WorkerPool(_deadly, (), [(0, 17)], "sample", messages.append, lambda task: f"sample {task[1]} of set {task[0]}")
    with pytest.raises(TactipError, match=r"^sample 17 of set 0 crashed two workers \(the last was killed by SIGKILL\)"):
        pool.work(1, lambda *done: None)
    assert messages == ["a worker was killed by SIGKILL during sample 17 of set 0: another worker takes over"]


def test_make_names_samples_and_shards_with_their_set(design, tmp_path, monkeypatch):
    class Named(WorkerPool):
        def work(self, workers, done):
            names.extend(map(self._named, [(1, 17), (0, ShardFinalizer(1, b""))]))
            raise TactipError("it is enough to be named")

    names = []
    monkeypatch.setattr(generation, "WorkerPool", Named)
    jobs = [Job(configuration(design), tmp_path / name) for name in ("train", "val")]
    with pytest.raises(TactipError, match="enough to be named"):
        generation.make(jobs, 1, log=lambda line: None)
    assert names == [f"sample 17 of {tmp_path / 'val'}", f"the completion of shard-00001 of {tmp_path / 'train'}"]
