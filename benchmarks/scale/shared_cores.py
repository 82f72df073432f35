"""Speed of training, evaluation and servo alone and beside a second job of the same kind, by how threads wait."""

import contextlib
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier
from typing import Any

from tactip_twin.tactip_model.threads import SPIN_COUNT

_SECONDS = 4.0
"""Time that a rate is measured for, s."""

_REPEATS = 3
"""Number of measurements of each row, of which medians are taken."""

_WAITING = {
    "threads spin, as OpenMP's default": {"GOMP_SPINCOUNT": "30000000000"},
    "threads sleep soon, the default here": {"GOMP_SPINCOUNT": SPIN_COUNT},
    "threads sleep at once": {"OMP_WAIT_POLICY": "PASSIVE"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}
"""Environment variables of each way to wait."""


def rows() -> list[dict[str, Any]]:
    """Return a row for each job and way to wait: its rate alone, and the lower of two rates side by side."""
    from tactip_twin.benchmarks.scale.performance import QUICK, made_set

    found = []
    with tempfile.TemporaryDirectory() as folder:
        data = made_set(folder, 64, 2, **QUICK)
        for job, unit in (("train", "images/s"), ("evaluate", "images/s"), ("servo", "steps/s")):
            for words, variables in _WAITING.items():
                if job == "servo" and not words.endswith("here"):
                    continue  # a step's single image takes one thread
                alone, beside = [], []
                for _ in range(_REPEATS):
                    alone += _rates(job, data, variables, 1)
                    beside.append(min(_rates(job, data, variables, 2)))
                a, b = statistics.median(alone), statistics.median(beside)
                found.append({"what": f"{job}, {words}", "unit": unit, "alone": a, "beside another": b, "ratio": b / a})
    return found


def _rates(job: str, data: Path, variables: dict[str, str], count: int) -> list[float]:
    """Return the rates of a number of equal jobs that start together, each in its own process."""
    context = get_context("spawn")
    with _environment(variables), context.Manager() as manager:
        barrier = manager.Barrier(count)
        with ProcessPoolExecutor(count, context) as pool:
            return list(pool.map(_rate, [job] * count, [data] * count, [barrier] * count))


@contextlib.contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set OpenMP's variables for processes that start in a `with` block; all others of OpenMP are removed."""
    before = dict(os.environ)
    for name in before:
        if name.startswith(("OMP_", "GOMP_")):
            del os.environ[name]
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            del os.environ[name]
        os.environ.update(before)


def _rate(job: str, data: Path, barrier: Barrier) -> float:
    """Return the rate of a job in this process, measured from when all jobs have reached the barrier."""
    from tactip_twin.control.options import RouteOptions, ServoOptions
    from tactip_twin.control.servo_run import run_servo
    from tactip_twin.learning.data import read_samples
    from tactip_twin.learning.model import load_network
    from tactip_twin.learning.recipes import recipe_named
    from tactip_twin.learning.training import Training

    if job == "servo":
        barrier.wait()
        with tempfile.TemporaryDirectory() as folder:
            route = RouteOptions(kind="straight", length_mm=20)
            options = ServoOptions(Path(folder) / "run", "surface", "bust", route=route)
            return run_servo(options, log=lambda line: None)["steps_per_s"]
    samples = read_samples(data)
    recipe = recipe_named("laptop", "surface")
    training, network = Training(samples, samples, recipe.network, recipe.settings), load_network("surface-tactip-127")
    once = training.train_epoch if job == "train" else partial(network.predict, samples.images)
    once()
    barrier.wait()
    start, count = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < _SECONDS:
        once()
        count += len(samples)
    return count / elapsed
