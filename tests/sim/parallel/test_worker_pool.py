"""Workers end without a noise, whatever the moment."""

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
    code = "from tactip_twin.sim.parallel.worker_pool import peak_mib; print(peak_mib())"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 5 < float(told.stdout) < 150
    assert peak_mib() > 300


def _deadly():
    return lambda task: os.kill(os.getpid(), signal.SIGKILL)


def test_a_task_that_ends_workers_is_told_by_its_name():
    said = []
    crew = WorkerPool(_deadly, (), [(0, 17)], "sample", said.append, lambda task: f"sample {task[1]} of set {task[0]}")
    with pytest.raises(TactipError, match=r"^sample 17 of set 0 has ended two workers \(the last by signal SIGKILL\)"):
        crew.work(1, lambda *done: None)
    assert said == ["a worker ended by signal SIGKILL at sample 17 of set 0: another takes over"]


def test_samples_and_ends_of_shards_are_told_with_their_set(design, tmp_path, monkeypatch):
    class Named(WorkerPool):
        def work(self, workers, done):
            told.extend(map(self._named, [(1, 17), (0, ShardFinalizer("shard-00001", b""))]))
            raise TactipError("it is enough to be named")

    told = []
    monkeypatch.setattr(generation, "WorkerPool", Named)
    jobs = [Job(configuration(design), tmp_path / name) for name in ("train", "val")]
    with pytest.raises(TactipError, match="enough to be named"):
        generation.make(jobs, 1, say=lambda line: None)
    assert told == [f"sample 17 of {tmp_path / 'val'}", f"the end of shard-00001 of {tmp_path / 'train'}"]
