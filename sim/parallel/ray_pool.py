"""A crew whose workers live on the machines of a Ray cluster.

Needs the extra `cluster`. The folders of the sets must be visible to every machine under the same path, as on a shared disk,
and the package must be installed there. A worker holds a second's work at a time, so that nothing piles up and few messages
keep many workers busy; the tasks of one that is lost with its machine are played again by another.
"""

import contextlib
import statistics
from dataclasses import dataclass
from typing import Any

from tactip_twin.sim.parallel.worker_pool import THREADS, WorkerPool, attempt
from tactip_twin.tactip_model.errors import TactipError

HELD_S = 1.0
"""Work that a worker holds, s: a driver passes about a thousand messages a second (docs/scale.md)."""

_LEAVE_S = 10
"""How long workers may take to finish what they hold, s."""


def ray_here():
    """The module ray. Raises TactipError where it is not installed."""
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise TactipError(f"a cluster needs Ray ({error}): pip install 'tactip-twin[cluster]'") from error
    return ray


@contextlib.contextmanager
def joined(address):
    """The module ray, joined to the cluster at `address` (str; auto: that of this machine; local: one of this machine
    alone), and left at the end. Raises TactipError where Ray is missing or cannot be reached."""
    ray = ray_here()
    try:
        # Without an address Ray would join whatever cluster this machine last started.
        ray.init(address=address, logging_level="ERROR", log_to_driver=False, include_dashboard=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise TactipError(f"there is no Ray cluster at {address!r}: {error}") from error
    try:
        yield ray
    finally:
        ray.shutdown()


class _Remote:
    """A worker, in a process of the cluster."""

    def __init__(self, begin, arguments):
        self._do = begin(*arguments)

    def attempt(self, tasks):
        """Do tasks, up to the first that cannot be done: a list of replies as of crew.attempt."""
        replies = []
        for task in tasks:
            replies.append(attempt(self._do, task))
            if replies[-1]["error"]:
                break
        return replies


@dataclass
class _Hand:
    actor: Any
    tasks: tuple = ()
    done: int = 0
    seconds: float = HELD_S
    """What a task of the last ones took."""


class RayPool(WorkerPool):
    """Does a list of tasks on a cluster: as a WorkerPool does, to the same files."""

    most_held = 256
    """Tasks that a worker holds at most, however short they are."""

    def __init__(self, ray, begin, arguments, tasks, unit, say, named=None):
        """ray: the module, joined. The rest: as of WorkerPool."""
        super().__init__(begin, arguments, tasks, unit, say, named)
        self._ray = ray
        variables = {"env_vars": dict.fromkeys(THREADS, "1")}
        self._actor = ray.remote(num_cpus=1, max_restarts=0, runtime_env=variables)(_Remote)

    def places(self):
        """Workers (int) that the cluster has room for. Raises TactipError where it has none."""
        count = int(self._ray.cluster_resources().get("CPU", 0))
        if count < 1:
            raise TactipError("the cluster has no processor to work on")
        return count

    def _hire(self):
        if self._queue:
            self._give(_Hand(self._actor.remote(self._begin, self._arguments)))

    def _give(self, hand):
        """Give a worker its next tasks: as many as it does in HELD_S, but towards the end no more than its share.

        One that a worker was lost with goes alone, so that it is known if it ends another.
        """
        share = len(self._queue) // (2 * len(self._workers) + 2)
        many = max(1, min(round(HELD_S / max(hand.seconds, 1e-6)), share, self.most_held))
        tasks = [self._queue.pop()]
        while len(tasks) < many and not self._killed.keys() & {tasks[0], self._queue[-1]}:
            tasks.append(self._queue.pop())
        hand.tasks = tuple(tasks)
        self._workers[hand.actor.attempt.remote(hand.tasks)] = hand

    def _replies(self):
        self._ray.wait(list(self._workers), num_returns=1)
        ready, _ = self._ray.wait(list(self._workers), num_returns=len(self._workers), timeout=0)
        for reference in ready:
            yield from self._answered(self._workers.pop(reference), reference)

    def _answered(self, hand, reference):
        """What a worker did, as of _replies."""
        try:
            replies = self._ray.get(reference)
        except self._ray.exceptions.RayActorError:
            self._lost(hand.tasks, "with its process or its machine")
            self._hire()
            return
        for task, reply in zip(hand.tasks, replies, strict=False):
            if reply["error"]:
                self._ray.kill(hand.actor)
                raise TactipError(reply["error"])
            hand.done += 1
            yield task, reply["seconds"], reply["peak_mib"], hand.done > 1
        # The first task was slowed by its worker's start.
        hand.seconds = statistics.fmean(reply["seconds"] for reply in replies)
        if self._queue:
            self._give(hand)
        else:
            self._ray.kill(hand.actor)

    def _dismiss(self):
        if self._workers:
            self._ray.wait(list(self._workers), num_returns=len(self._workers), timeout=_LEAVE_S)
        for hand in self._workers.values():
            self._ray.kill(hand.actor)
        self._workers.clear()
