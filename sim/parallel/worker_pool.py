"""A pool of worker processes: each does one task at a time, and is replaced when it dies.

Each worker has its own pipe. If a worker dies, its pipe closes and another worker gets its task; if the parent dies,
the other end closes and the worker ends. Only the parent answers Ctrl-C: it lets workers finish their tasks.
"""

import contextlib
import os
import resource
import signal
import statistics
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from multiprocessing import connection, get_context, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

from tqdm import tqdm

from tactip_twin.tactip_model.errors import Interrupted, TactipError

Task = TypeVar("Task", bound=Hashable)
"""A task: anything that can be hashed and pickled."""

_ESTIMATE_TASKS, _ESTIMATE_S = 8, 20.0
"""Number of tasks, or seconds of work, after which the total time is estimated."""

_SHUTDOWN_S = 10
"""Time that a worker has to finish its task at the end, s."""

RESUME_HINT = "finished work is kept, and the same command resumes it"
"""End of messages about interrupted work."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS", "IGL_NUM_THREADS")
"""Environment variables that set the number of threads of numerical libraries and software OpenGL."""


def worker_count(requested: str | int) -> int:
    """Return the number of workers for `auto` or a number. Raises TactipError on anything else."""
    if requested == "auto":
        return len(os.sched_getaffinity(0))
    try:
        count = int(requested)
    except ValueError:
        count = 0
    if count < 1:
        raise TactipError(f"workers must be auto or at least 1, got {requested}")
    return count


@dataclass(frozen=True)
class Reply:
    """Outcome of a task."""

    error: str | None
    """Error message; None if the task succeeded."""
    seconds: float
    """Time that the task took, s."""
    peak_mib: float
    """Peak memory of the process so far, MiB."""


@dataclass
class _Worker:
    process: BaseProcess
    task: Any = None
    done: int = 0


class TaskQueue(Generic[Task]):
    """Tasks in order, taken from an iterable when they are needed, and those that were put back."""

    def __init__(self, tasks: Iterable[Task], count: int) -> None:
        """Take the tasks and their number."""
        self._rest, self._left = iter(tasks), count
        self._next: list[Task] = []

    def __len__(self) -> int:
        return self._left + len(self._next)

    def peek(self) -> Task:
        """Return the next task, which stays in the queue."""
        self.put_back([self.pop()])
        return self._next[-1]

    def pop(self) -> Task:
        """Take the next task. Raises IndexError where there is none."""
        if not self._next and self._left:
            self._left -= 1
            return next(self._rest)
        return self._next.pop()

    def put_back(self, tasks: Sequence[Task]) -> None:
        """Let tasks be the next, in this order."""
        self._next += reversed(tasks)


class WorkerPool(Generic[Task]):
    """A pool of worker processes for tasks."""

    def __init__(
        self,
        begin: Callable[..., Callable[[Task], object]],
        arguments: tuple[object, ...],
        tasks: Iterable[Task],
        unit: str,
        log: Callable[[str], None],
        named: Callable[[Task], str] | None = None,
        count: int | None = None,
    ) -> None:
        """Prepare the pool; no process starts yet.

        Args:
            begin: Module-level function; each worker calls it once, with `arguments`, for the function that does a task.
            arguments: Arguments of `begin`, which can be pickled.
            tasks: Tasks, done in this order, each taken when a worker is free.
            unit: What a task makes, as a singular noun.
            log: Function that takes messages for the user.
            named: Function from a task to its name in messages; the unit and the task if None.
            count: Number of tasks; None for the length of `tasks`.

        Raises:
            TypeError: `tasks` has no length, and no count is given.
        """
        if count is None:
            if not isinstance(tasks, Sized):
                raise TypeError("tasks without a length need a count")
            count = len(tasks)
        self._named = named or (lambda task: f"{unit} {task}")
        self._begin, self._arguments, self._unit, self._log = begin, arguments, unit, log
        self._queue, self._count = TaskQueue(tasks, count), count
        self._workers: dict[Any, Any] = {}
        """Workers by what is waited for: pipes here, references of Ray in RayPool."""
        self._deaths: dict[Task, int] = {}
        """Number of workers that died during a task, by task."""
        self._extra: set[Task] = set()
        """Tasks that were added by `done`; they are not counted."""

    def work(self, workers: int, done: Callable[[Task, float, float], Iterable[Task] | None]) -> None:
        """Do all tasks with a number of worker processes.

        Args:
            workers: Number of processes.
            done: Function called after each task, in the order they end, with the task, the seconds it took and the peak
                memory of the worker in MiB. It may return further tasks, which are done next and not counted.

        Raises:
            TactipError: A task cannot be done.
            Interrupted: Ctrl-C.
        """
        # A terminal's bar is redrawn often; a log file gets an occasional line.
        interval = 0.5 if sys.stderr.isatty() else 15
        with tqdm(total=self._count, unit=self._unit, file=sys.stderr, mininterval=interval) as bar:
            try:
                for _ in range(workers):
                    self._start_worker()
                timings, estimated = [], False
                while self._workers:
                    for task, reply, warm in self._replies():
                        extra = list(done(task, reply.seconds, reply.peak_mib) or [])
                        self._queue.put_back(extra)
                        self._extra.update(extra)
                        if task in self._extra:
                            self._extra.remove(task)
                            continue
                        bar.update()
                        if warm and not estimated:  # the first task of a worker is slowed by its start
                            timings.append(reply.seconds)
                        # A single task may be one that takes many tries.
                        if not estimated and (len(timings) == _ESTIMATE_TASKS or sum(timings) > _ESTIMATE_S):
                            estimated = True
                            about = _duration(statistics.fmean(timings) * self._count / workers)
                            text = f"{self._count} {self._unit}s on {workers} worker(s): about {about} in total"
                            bar.write(text, file=sys.stderr)
            except KeyboardInterrupt:
                raise Interrupted(f"{bar.n} of {self._count} {self._unit}s made: {RESUME_HINT}") from None
            finally:
                self._shut_down()

    def places(self) -> int:
        """Return the number of workers that this machine has room for: one per core."""
        return worker_count("auto")

    def _replies(self) -> Iterator[tuple[Task, Reply, bool]]:
        """Wait for workers; yield each task done, its reply, and whether its worker had done one before."""
        ready = connection.wait([*self._workers, *(w.process.sentinel for w in self._workers.values())])
        for pipe, worker in list(self._workers.items()):
            if pipe not in ready and worker.process.sentinel not in ready:
                continue
            try:
                reply = pipe.recv()
            except (EOFError, ConnectionResetError):
                self._replace_dead_worker(pipe)
                continue
            if reply.error:
                raise TactipError(reply.error)
            worker.done += 1
            yield worker.task, reply, worker.done > 1
            self._assign(pipe)

    def _start_worker(self) -> None:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._begin, self._arguments))
        with _child_environment():
            process.start()
        theirs.close()  # only the worker has its end then, so its death closes it
        self._workers[ours] = _Worker(process)
        self._assign(ours)

    def _assign(self, pipe: connection.Connection) -> None:
        """Give a worker the next task; end it if there is none."""
        if not self._queue:
            pipe.close()
            self._workers.pop(pipe).process.join()
            return
        self._workers[pipe].task = self._queue.pop()
        with contextlib.suppress(BrokenPipeError):  # the worker is dead, and the next wait finds out
            pipe.send(self._workers[pipe].task)

    def _replace_dead_worker(self, pipe: connection.Connection) -> None:
        """Give the task of a dead worker to a new one, unless a worker died of that task before."""
        worker = self._workers.pop(pipe)
        pipe.close()
        worker.process.join()
        code = worker.process.exitcode or 0
        self._requeue(
            (worker.task,), f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with code {code}"
        )
        self._start_worker()

    def _requeue(self, tasks: Sequence[Task], how: str) -> None:
        """Put back the tasks of a worker that died.

        Args:
            tasks: The tasks that the worker had.
            how: How it ended, for the message: "was killed by SIGKILL".

        Raises:
            TactipError: A worker died of one of the tasks before.
        """
        for task in tasks:
            self._deaths[task] = self._deaths.get(task, 0) + 1
            if self._deaths[task] > 1:
                raise TactipError(
                    f"{self._named(task)} crashed two workers (the last {how}); the machine may be out of memory; "
                    f"{RESUME_HINT}"
                )
        more = f" and {len(tasks) - 1} more" if len(tasks) > 1 else ""
        self._log(f"a worker {how} during {self._named(tasks[0])}{more}: another worker takes over")
        self._queue.put_back(tasks)

    def _shut_down(self) -> None:
        """Let workers finish their tasks, then kill those that are left."""
        for pipe in self._workers:
            pipe.close()
        for worker in self._workers.values():
            worker.process.join(timeout=_SHUTDOWN_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
        self._workers.clear()


def disk_error(error: OSError) -> str:
    """Return an error in writing as a sentence for the user."""
    return f"cannot write {error.filename or 'the set'}: {error.strerror or error}; {RESUME_HINT}"


def _serve(
    pipe: connection.Connection, begin: Callable[..., Callable[[Task], object]], arguments: tuple[object, ...]
) -> None:
    """Do tasks from a pipe and send replies, until its other end is closed: the main function of a worker."""
    do = begin(*arguments)
    while True:
        try:
            task = pipe.recv()
        except (EOFError, ConnectionError):  # the latter if the last reply was never read
            return
        reply = attempt(do, task)
        try:
            pipe.send(reply)
        except ConnectionError:
            return


def attempt(do: Callable[[Task], object], task: Task) -> Reply:
    """Do a task; return its outcome."""
    start, error = time.perf_counter(), None
    try:
        do(task)
    except TactipError as failure:
        error = str(failure)
    except OSError as failure:
        error = disk_error(failure)
    return Reply(error, time.perf_counter() - start, peak_mib())


def peak_mib() -> float:
    """Return the peak memory of this process so far, MiB.

    Linux passes `ru_maxrss` from a process to those it starts, so the process's own peak is read first.
    """
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@contextlib.contextmanager
def _child_environment() -> Iterator[None]:
    """Set what processes started in a `with` block inherit.

    Numerics and software OpenGL take one thread each, since workers fill the cores. Ctrl-C is blocked from their first
    instant; this process receives it after the block.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    for name in THREADS:
        os.environ.setdefault(name, "1")
    resource_tracker.ensure_running()  # the first process would start it otherwise, and that lifts the mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def _duration(seconds: float) -> str:
    """Return a duration as readable text."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s"
