"""Worker processes that do tasks one at a time, outlive each other, and leave nothing behind.

Each worker has a pipe of its own. A worker that dies is seen by its pipe, its task goes to another; a worker whose parent
dies sees its pipe close and ends. Ctrl-C is the parent's to answer: it lets workers finish what they hold.
"""

import contextlib
import os
import resource
import signal
import statistics
import sys
import time
from dataclasses import dataclass
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tactip_twin.tactip_model.errors import Interrupted, TactipError

_TELLING, _TELLING_S = 8, 20.0
"""Tasks, or seconds of a worker's, after which it is told how long all will take."""

RESUME_HINT = "what is done so far is kept, and the same command goes on from there"


def worker_count(asked):
    """Number of workers (int) for `auto` or a number as str or int. Raises TactipError on anything else."""
    if asked == "auto":
        return len(os.sched_getaffinity(0))
    try:
        count = int(asked)
    except ValueError:
        count = 0
    if count < 1:
        raise TactipError(f"{asked!r} workers cannot work: ask for a number of at least 1, or auto")
    return count


@dataclass
class _Worker:
    process: BaseProcess
    task: Any = None
    done: int = 0


class WorkerPool:
    """Does a list of tasks on worker processes."""

    def __init__(self, begin, arguments, tasks, unit, say, named=None):
        """begin: module-level function that a worker calls with `arguments` (tuple) and that returns the function to
        call with each task. tasks: list of picklable things, done in order. unit: str, what a task makes. say: called
        with lines for the user. named: function of a task to what it is called (str); the unit and the task if None.
        """
        self._named = named or (lambda task: f"{unit} {task}")
        self._begin, self._arguments, self._unit, self._say = begin, arguments, unit, say
        self._queue, self._count = list(reversed(tasks)), len(tasks)
        self._workers, self._killed, self._further = {}, {}, set()

    def work(self, workers, done):
        """Do all tasks with `workers` processes; call done(task, seconds, peak memory of the worker in MiB)
        after each, in the order they end. What it returns, if anything, is a list of further tasks, which are done next and
        not counted.

        Raises TactipError where a task cannot be done, and Interrupted at Ctrl-C.
        """
        # On a terminal the bar is redrawn at leisure; a log file gets a line now and then.
        interval = 0.5 if sys.stderr.isatty() else 15
        with tqdm(total=self._count, unit=self._unit, file=sys.stderr, mininterval=interval) as bar:
            try:
                for _ in range(workers):
                    self._hire()
                known, told = [], False
                while self._workers:
                    for task, seconds, peak_mib, repeated in self._replies():
                        further = done(task, seconds, peak_mib) or []
                        self._queue += further
                        self._further.update(further)
                        if task in self._further:
                            continue
                        bar.update()
                        if repeated:  # a worker's first task was slowed by its start
                            known.append(seconds)
                        # One alone may be one that is tried again and again.
                        if not told and (len(known) == _TELLING or sum(known) > _TELLING_S):
                            told = True
                            about = _duration(statistics.fmean(known) * self._count / workers)
                            text = f"{self._count} {self._unit}s on {workers} worker(s): about {about} in all"
                            bar.write(text, file=sys.stderr)
            except KeyboardInterrupt:
                raise Interrupted(f"{bar.n} of {self._count} {self._unit}s made: {RESUME_HINT}") from None
            finally:
                self._dismiss()

    def places(self):
        """Workers (int) that this machine has room for: a core each."""
        return worker_count("auto")

    def _replies(self):
        """Wait for workers; yield (task, seconds, the worker's peak memory in MiB, whether it had done one before)."""
        ready = connection.wait([*self._workers, *(w.process.sentinel for w in self._workers.values())])
        for pipe, worker in list(self._workers.items()):
            if pipe not in ready and worker.process.sentinel not in ready:
                continue
            try:
                reply = pipe.recv()
            except (EOFError, ConnectionResetError):
                self._bury(pipe)
                continue
            if reply["error"]:
                raise TactipError(reply["error"])
            worker.done += 1
            yield worker.task, reply["seconds"], reply["peak_mib"], worker.done > 1
            self._assign(pipe)

    def _hire(self):
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._begin, self._arguments))
        with _for_children():
            process.start()
        theirs.close()  # so that the worker's end is the worker's alone, and its death closes it
        self._workers[ours] = _Worker(process)
        self._assign(ours)

    def _assign(self, pipe):
        """Give a worker the next task, or its notice where there is none."""
        if not self._queue:
            pipe.close()
            self._workers.pop(pipe).process.join()
            return
        self._workers[pipe].task = self._queue.pop()
        with contextlib.suppress(BrokenPipeError):  # then it is dead, and the next wait says so
            pipe.send(self._workers[pipe].task)

    def _bury(self, pipe):
        """A worker died: give its task to a new one, unless that task has ended one before."""
        worker = self._workers.pop(pipe)
        pipe.close()
        worker.process.join()
        code = worker.process.exitcode or 0
        self._lost((worker.task,), f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}")
        self._hire()

    def _lost(self, tasks, how):
        """Put tasks back whose worker ended `how` (str). Raises TactipError where one of them has ended another before."""
        for task in tasks:
            self._killed[task] = self._killed.get(task, 0) + 1
            if self._killed[task] > 1:
                raise TactipError(
                    f"{self._named(task)} has ended two workers (the last {how}): is memory short? {RESUME_HINT}"
                )
        more = f" and {len(tasks) - 1} more" if len(tasks) > 1 else ""
        self._say(f"a worker ended {how} at {self._named(tasks[0])}{more}: another takes over")
        self._queue += reversed(tasks)

    def _dismiss(self):
        """Let workers finish what they hold, then make sure that they are gone."""
        for pipe in self._workers:
            pipe.close()
        for worker in self._workers.values():
            worker.process.join(timeout=10)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
        self._workers.clear()


def disk_error(error):
    """An OSError in writing as a sentence for the user."""
    return f"cannot write {error.filename or 'the set'}: {error.strerror or error}; {RESUME_HINT}"


def _serve(pipe, begin, arguments):
    """A worker's life: tasks in, replies out, until the other end of the pipe is closed."""
    do = begin(*arguments)
    while True:
        try:
            task = pipe.recv()
        except (EOFError, ConnectionError):  # the latter where the last reply was not read any more
            return
        reply = attempt(do, task)
        try:
            pipe.send(reply)
        except ConnectionError:
            return


def attempt(do, task):
    """Do a task; returns a dict: error (str or None), seconds, and peak_mib, the process's greatest memory in MiB."""
    start, error = time.perf_counter(), None
    try:
        do(task)
    except TactipError as wrong:
        error = str(wrong)
    except OSError as wrong:
        error = disk_error(wrong)
    return {"error": error, "seconds": time.perf_counter() - start, "peak_mib": peak_mib()}


def peak_mib():
    """Greatest memory of this process so far, MiB.

    Linux hands `ru_maxrss` down from the process that started this one, whatever its own is: its own is asked for first.
    """
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS", "IGL_NUM_THREADS")
"""Variables that say how many threads numerics and software OpenGL take."""


@contextlib.contextmanager
def _for_children():
    """What processes started here inherit: one thread each for numerics and for software OpenGL, since workers fill the
    cores; and deafness to Ctrl-C from their first instant, while this process hears it a moment later.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    for name in THREADS:
        os.environ.setdefault(name, "1")
    resource_tracker.ensure_running()  # its own start, left to the first process, would lift the mask
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def _duration(seconds):
    """Seconds as text for people."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {seconds} s"
