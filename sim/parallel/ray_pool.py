"""A worker pool on the machines of a Ray cluster.

Needs the extra `cluster`. The folders of the sets must be visible to every machine under the same path, as on a shared disk,
and the package must be installed there. A worker gets about a second of work at a time, so few messages keep many workers
busy, and little is lost if one fails; another worker repeats its tasks.
"""

import contextlib
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from tactip_twin.sim.parallel.worker_pool import THREADS, Reply, Task, WorkerPool, attempt
from tactip_twin.tactip_model.errors import TactipError

BLOCK_S = 1.0
"""Work that a worker gets at a time, s: a driver passes about a thousand messages per second (docs/scale.md)."""

_SHUTDOWN_S = 10
"""Time that workers have to finish their tasks at the end, s."""


def ray_here() -> ModuleType:
    """Return the module ray. Raises TactipError if it is not installed."""
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise TactipError(f"a cluster needs Ray ({error}): in the clone, .venv/bin/pip install -e '.[cluster]'") from error
    return ray


@contextlib.contextmanager
def joined(address: str) -> Iterator[ModuleType]:
    """Join a Ray cluster for a `with` block, which gets the module ray.

    Args:
        address: Address of the cluster; `auto` for that of this machine, `local` for one of this machine alone.

    Raises:
        TactipError: Ray is missing or the cluster cannot be reached.
    """
    ray = ray_here()
    try:
        # Without an address Ray would join whatever cluster this machine last started.
        ray.init(address=address, logging_level="ERROR", log_to_driver=False, include_dashboard=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise TactipError(f"cannot reach a Ray cluster at {address!r}: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


class _Actor:
    """A worker, in a process of the cluster."""

    def __init__(self, begin: Callable[..., Callable[[Any], object]], arguments: tuple[object, ...]) -> None:
        self._do = begin(*arguments)

    def attempt(self, tasks: Sequence[Any]) -> list[Reply]:
        """Do tasks, up to the first that cannot be done; return the outcomes."""
        replies = []
        for task in tasks:
            replies.append(attempt(self._do, task))
            if replies[-1].error:
                break
        return replies


@dataclass
class _RayWorker:
    actor: Any
    tasks: tuple[Any, ...] = ()
    done: int = 0
    seconds: float = BLOCK_S
    """Mean time of its last tasks, s."""


class RayPool(WorkerPool[Task]):
    """A worker pool on a cluster; it writes the same files as a WorkerPool."""

    max_block = 256
    """Maximum number of tasks that a worker gets at a time, however short they are."""

    def __init__(
        self,
        ray: Any,
        begin: Callable[..., Callable[[Task], object]],
        arguments: tuple[object, ...],
        tasks: Iterable[Task],
        unit: str,
        log: Callable[[str], None],
        named: Callable[[Task], str] | None = None,
        count: int | None = None,
    ) -> None:
        """Prepare the pool; no worker starts yet.

        Args:
            ray: The module ray, joined to a cluster.
            begin: As in WorkerPool, like the others.
        """
        super().__init__(begin, arguments, tasks, unit, log, named, count)
        self._ray = ray
        variables = {"env_vars": dict.fromkeys(THREADS, "1")}
        self._actor = ray.remote(num_cpus=1, max_restarts=0, runtime_env=variables)(_Actor)

    def places(self) -> int:
        """Return the number of workers that the cluster has room for. Raises TactipError if it has none."""
        count = int(self._ray.cluster_resources().get("CPU", 0))
        if count < 1:
            raise TactipError("the cluster has no CPU for a worker")
        return count

    def _start_worker(self) -> None:
        if self._queue:
            self._assign_tasks(_RayWorker(self._actor.remote(self._begin, self._arguments)))

    def _assign_tasks(self, worker: _RayWorker) -> None:
        """Give a worker its next tasks: as many as it does in BLOCK_S, but fewer towards the end, so that all end together.

        A task of a lost worker is assigned alone, which shows whether it crashes another worker.
        """
        fair = len(self._queue) // (2 * len(self._workers) + 2)
        count = max(1, min(round(BLOCK_S / max(worker.seconds, 1e-6)), fair, self.max_block))
        tasks = [self._queue.pop()]
        while len(tasks) < count and not (self._deaths and self._deaths.keys() & {tasks[0], self._queue.peek()}):
            tasks.append(self._queue.pop())
        worker.tasks = tuple(tasks)
        self._workers[worker.actor.attempt.remote(worker.tasks)] = worker

    def _replies(self) -> Iterator[tuple[Task, Reply, bool]]:
        self._ray.wait(list(self._workers), num_returns=1)
        ready, _ = self._ray.wait(list(self._workers), num_returns=len(self._workers), timeout=0)
        for reference in ready:
            yield from self._replies_of(self._workers.pop(reference), reference)

    def _replies_of(self, worker: _RayWorker, reference: Any) -> Iterator[tuple[Task, Reply, bool]]:
        """Yield what a worker did, as `_replies` does, and give it its next tasks."""
        try:
            replies: list[Reply] = self._ray.get(reference)
        except self._ray.exceptions.RayActorError:
            self._requeue(worker.tasks, "was lost with its process or its machine")
            self._start_worker()
            return
        for task, reply in zip(worker.tasks, replies, strict=False):
            if reply.error:
                self._ray.kill(worker.actor)
                raise TactipError(reply.error)
            worker.done += 1
            yield task, reply, worker.done > 1
        # Its first task was slowed by its start.
        worker.seconds = statistics.fmean(reply.seconds for reply in replies)
        if self._queue:
            self._assign_tasks(worker)
        else:
            self._ray.kill(worker.actor)

    def _shut_down(self) -> None:
        if self._workers:
            self._ray.wait(list(self._workers), num_returns=len(self._workers), timeout=_SHUTDOWN_S)
        for worker in self._workers.values():
            self._ray.kill(worker.actor)
        self._workers.clear()
