"""Rates that decide what a large data set costs: `tactip bench scale` writes docs/scale.md and scale.json.

They are a contact's time on one core, a sample's size on disk, the driver's time to close a shard and to hand out a task,
and a reader's time.
"""

import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import table, write_results
from tactip_twin.benchmarks.scale.options import ScaleOptions
from tactip_twin.benchmarks.scale.performance import PLAIN, made_set, set_seconds
from tactip_twin.learning.data import read_samples
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import PARTIAL, checksum, read_configuration, read_meta
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.partial_record import unpack_finished_set
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.parallel.ray_pool import RayPool, joined
from tactip_twin.sim.parallel.worker_pool import WorkerPool
from tactip_twin.tactip_model.bounds import require

_MIN = {"contacts": 1, "warm_up_contacts": 1, "messages": 10}
"""Minimum of each option. The first tenth of the messages is left out, because workers start up then."""


def run(options: ScaleOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write scale.json and scale.md, and return the results.

    Progress goes to `log`. Raises TactipError.
    """
    for name, minimum in _MIN.items():
        value = getattr(options, name)
        require(value >= minimum, f"--{name.replace('_', '-')}", value, f"at least {minimum}")
    sizes = f"{options.contacts} contacts after {options.warm_up_contacts}, {options.messages} messages"
    settings = f"{sizes}, one worker, seed 0"
    record: dict[str, Any] = {"machine": machine(), "settings": settings, "tasks": {}, "dispatch": {}}
    for task in SYMMETRIES:
        log(f"sets of the task {task}")
        record["tasks"][task] = _task(task, options)
    log("messages")
    record["dispatch"] = _dispatch(options)
    write_results("scale", record, tables(record), options.out)
    return record


def _task(task: str, options: ScaleOptions) -> dict[str, float]:
    """Return the rates and sizes of a set of a task."""
    case = PLAIN | {"task": task, "augment_symmetry": True}
    few, _ = set_seconds(options.warm_up_contacts, 1, **case)
    many, peak = set_seconds(options.warm_up_contacts + options.contacts, 1, **case)
    with tempfile.TemporaryDirectory() as place:
        samples = options.contacts * len(SYMMETRIES[task])
        folder = made_set(place, samples, 1, **case)
        files = [path for path in folder.rglob("*") if path.is_file()]
        configuration = read_configuration(read_meta(folder), folder)
        close = _closing_s(folder, configuration)
        note = _seconds(lambda: [checksum((folder / "meta.json").read_bytes()), read_meta(folder)])
        return {
            "samples_a_contact": len(SYMMETRIES[task]),
            "contact_s": (many - few) / options.contacts,
            "worker_mib": peak,
            "bytes_a_sample": sum(path.stat().st_size for path in files) / samples,
            "image_bytes": sum(path.stat().st_size for path in files if path.suffix == ".png") / samples,
            "close_s_a_sample": close / samples,
            "note_s_a_sample": note / samples,
            "verify_s_a_sample": _seconds(lambda: verify(folder)) / samples,
            "read_s_a_sample": _seconds(lambda: read_samples(folder)) / samples,
        }


def _closing_s(folder: Path, configuration: Configuration) -> float:
    """Return the time that a worker takes to make a finished set of partial records, s."""
    times = []
    for _ in range(3):
        (folder / PARTIAL).mkdir()
        unpack_finished_set(folder)  # the state after a kill behind the last contact
        times.append(_seconds(lambda: make([Job(configuration, folder)], 1, lambda line: None)))
    return sorted(times)[1]


def _seconds(function: Callable[[], object]) -> float:
    """Return the time of a call, s."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


class _Nothing:
    """Function of a worker that does nothing."""

    def __call__(self, task: int) -> None:
        pass


def _begin() -> _Nothing:
    return _Nothing()


def _dispatch(options: ScaleOptions) -> dict[str, float]:
    """Return how many empty tasks per second a driver hands out, by kind of worker pool."""
    arguments = _begin, (), list(range(options.messages)), "task", lambda line: None
    rates = {"processes of this machine": _rate(lambda: WorkerPool(*arguments), options)}
    if find_spec("ray"):
        with joined("local") as ray:
            rates["Ray"] = _rate(lambda: RayPool(ray, *arguments), options)
            rates["Ray, one task per message"] = _rate(lambda: _Single(ray, *arguments), options)
    return rates


class _Single(RayPool):
    """A pool that gives each worker one task at a time."""

    max_block = 1


def _rate(pool: Callable[[], WorkerPool], options: ScaleOptions) -> float:
    """Return tasks per second, after the workers have started."""
    times, skip = [], options.messages // 10
    pool().work(2, lambda *done: times.append(time.perf_counter()))
    return (len(times) - skip) / (times[-1] - times[skip - 1])


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/scale.md from scale.json."""
    rows = [
        [what, *(f"{factor * t[key]:.3g}" for t in record["tasks"].values())]
        for key, what, factor in (
            ("contact_s", "time per contact with its samples, s of one core", 1),
            ("worker_mib", "memory of a worker, MiB", 1),
            ("samples_a_contact", "samples per contact", 1),
            ("bytes_a_sample", "disk space per sample, kB", 1e-3),
            ("image_bytes", "disk space of its image, kB", 1e-3),
            ("close_s_a_sample", "closing of a shard by a worker, ms per sample", 1e3),
            ("note_s_a_sample", "bookkeeping by the driver, ms per sample", 1e3),
            ("verify_s_a_sample", "`tactip dataset verify`, ms per sample", 1e3),
            ("read_s_a_sample", "reading of images and labels, ms per sample", 1e3),
        )
    ]
    tasks = [[name, f"{rate:,.0f}"] for name, rate in record["dispatch"].items()]
    state = f"Machine: {machine_text(record['machine'])}. Settings: {record['settings']}."
    return {
        "rates": f"{table(['measured', *record['tasks']], rows)}\n\n{state}",
        "dispatch": table(["worker pool", "tasks per second"], tasks),
    }
