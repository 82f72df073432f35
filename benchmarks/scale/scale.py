"""Cost of a million contacts on many machines, extrapolated from rates on this one: `tactip bench scale`.

Measured are the time of a contact on a core, the size of a sample on the disk, the driver's time to close a shard and to
hand out a task, and a reader's time. The rest of docs/scale.md is arithmetic on these, and shows which of them is the limit.
"""

import json
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.options import ScaleOptions
from tactip_twin.benchmarks.scale.performance import made_set, set_seconds
from tactip_twin.learning.data import read_samples
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import PARTIAL, checksum, read_configuration, read_meta
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.partial_record import unpack_finished_set
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.parallel.ray_pool import BLOCK_S, RayPool, joined
from tactip_twin.sim.parallel.worker_pool import WorkerPool
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.files import write_file

CONTACTS = 1_000_000
"""Contacts of the extrapolated set."""

MACHINES = (1, 10, 100)
"""Numbers of machines like this one that costs are extrapolated to."""

_MIN = {"contacts": 1, "few": 1, "messages": 10}
"""Minimum of each option. The first tenth of the messages is left out, because workers start up then."""

_PUTS_PER_S = 3500
"""Objects per second that an object store accepts under one prefix (Amazon S3 User Guide, "Best practices design patterns:
optimizing Amazon S3 performance")."""

_DOLLARS_PER_PUT = 0.005 / 1000
"""Price of writing one object, US dollars (Amazon S3 pricing, standard class, us-east-1)."""


def run(options: ScaleOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write scale.json and scale.md, and return the results.

    Progress goes to `log`. Raises TactipError.
    """
    for name, minimum in _MIN.items():
        value = getattr(options, name)
        require(value >= minimum, f"--{name}", value, f"at least {minimum}")
    options.out.mkdir(parents=True, exist_ok=True)
    settings = f"contacts {options.contacts} after {options.few}, messages {options.messages}, one worker, seed 0"
    record: dict[str, Any] = {"machine": machine(), "settings": settings, "tasks": {}, "dispatch": {}}
    for task in SYMMETRIES:
        log(f"sets of the task {task}")
        record["tasks"][task] = _task(task, options)
    log("messages")
    record["dispatch"] = _dispatch(options)
    write_file(options.out / "scale.json", (json.dumps(record, indent=1) + "\n").encode())
    write_file(options.out / "scale.md", markdown(record).encode())
    return record


def _task(task: str, options: ScaleOptions) -> dict[str, float]:
    """Return the rates and sizes of a set of a task."""
    case = {"task": task, "fidelity": "standard", "renderer": "raster", "augment_symmetry": True, "design": "tactip-127"}
    few, _ = set_seconds(options.few, 1, **case)
    many, peak = set_seconds(options.few + options.contacts, 1, **case)
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
            rates["Ray, one task a message"] = _rate(lambda: _Single(ray, *arguments), options)
    return rates


class _Single(RayPool):
    """A pool that gives each worker one task at a time."""

    max_block = 1


def _rate(pool: Callable[[], WorkerPool], options: ScaleOptions) -> float:
    """Return tasks per second, after the workers have started."""
    times, skip = [], options.messages // 10
    pool().work(2, lambda *done: times.append(time.perf_counter()))
    return (len(times) - skip) / (times[-1] - times[skip - 1])


def markdown(record: dict[str, Any]) -> str:
    """Return the Markdown of scale.json."""
    cores = int(record["machine"]["cores"])
    state = machine_text(record["machine"])
    lines = [
        "# A million contacts on many machines",
        "",
        "Written by `tactip bench scale`; do not edit. Rates were measured on one machine, the rest is arithmetic on them: "
        f"{CONTACTS:,} contacts at `standard` fidelity with every turn and mirror as a sample (`--augment-symmetry`, "
        f"raster), on machines of {cores} cores as this one that share a folder (`tactip dataset make --cluster ADDRESS`).",
        "",
        f"Measured on: {state}. Settings: {record['settings']}.",
        "",
        "| measured | " + " | ".join(record["tasks"]) + " |",
        "|" + "---|" * (1 + len(record["tasks"])),
    ]
    for key, what, factor in (
        ("contact_s", "a contact with its samples, s of a core", 1),
        ("worker_mib", "memory of a worker, MiB", 1),
        ("samples_a_contact", "samples of a contact", 1),
        ("bytes_a_sample", "a sample on the disk, kB", 1e-3),
        ("image_bytes", "of it the image, a file of its own, kB", 1e-3),
        ("close_s_a_sample", "a worker's time to close a shard, ms a sample", 1e3),
        ("note_s_a_sample", "the driver's, to take note of it, ms a sample", 1e3),
        ("verify_s_a_sample", "`tactip dataset verify`, ms a sample", 1e3),
        ("read_s_a_sample", "a reader's time, images and labels, ms a sample", 1e3),
    ):
        lines.append(f"| {what} | " + " | ".join(f"{factor * t[key]:.3g}" for t in record["tasks"].values()) + " |")
    lines += ["", "| tasks that a driver hands out | a second |", "|---|---|"]
    lines += [f"| {name} | {rate:,.0f} |" for name, rate in record["dispatch"].items()]
    if "Ray" not in record["dispatch"]:
        lines += ["", "Ray is not installed here: its messages were not measured."]
    for task, figures in record["tasks"].items():
        lines += ["", f"## {task}", "", *_extrapolated(figures, cores)]
    return "\n".join([*lines, "", *_limits(record)]) + "\n"


def _extrapolated(figures: dict[str, Any], cores: int) -> list[str]:
    """Return the lines on the cost of CONTACTS contacts of a task on MACHINES."""
    samples = CONTACTS * figures["samples_a_contact"]
    second = _contact_s(figures)
    core_h = CONTACTS * second / 3600
    out = [
        f"{samples:,} samples, {samples * figures['bytes_a_sample'] / 1e9:.0f} GB in as many image files, "
        f"{core_h:,.0f} core hours.",
        "",
        "| machines | hours | contacts/s | MB/s written | files/s | messages/s | driver busy with shards |",
        "|" + "---|" * 7,
    ]
    for machines in MACHINES:
        workers = machines * cores
        rate = workers / second
        each = figures["samples_a_contact"]
        busy = rate * each * figures["note_s_a_sample"]
        cells = [
            f"{core_h / workers:,.1f}",
            f"{rate:,.0f}",
            f"{rate * each * figures['bytes_a_sample'] / 1e6:,.1f}",
            f"{rate * (each + 1):,.0f}",
            f"{min(rate, workers / BLOCK_S):,.0f}",
            f"{100 * busy:.1f} %",
        ]
        out.append(f"| {machines} | {' | '.join(cells)} |")
    return out


def _contact_s(figures: dict[str, Any]) -> float:
    """Return the time of a contact on a core, with its part of closing its shard, s."""
    return figures["contact_s"] + figures["samples_a_contact"] * figures["close_s_a_sample"]


def _limits(record: dict[str, Any]) -> list[str]:
    """Return the lines on what is the limit, and on object stores."""
    out = ["## What limits it", ""]
    for task, figures in record["tasks"].items():
        each, second = figures["samples_a_contact"], _contact_s(figures)
        limits = {"taking note of shards": second / (each * figures["note_s_a_sample"])}
        if "Ray" in record["dispatch"]:
            limits["handing out tasks"] = record["dispatch"]["Ray"] * second
            limits["messages of a second's work"] = record["dispatch"]["Ray, one task a message"] * BLOCK_S
        workers_by_limit = "; ".join(f"{what} by {workers:,.0f} workers" for what, workers in limits.items())
        out.append(f"- {task}: the driver, which is one process, is kept busy: {workers_by_limit}.")
    samples = CONTACTS * record["tasks"]["surface"]["samples_a_contact"]
    shards = -(-samples // Configuration.shard_samples)
    out += [
        "- The disk that all share gets a file for each image and each contact: the files a second above, not the bytes, "
        "are what a network file system must bear. Records are gone when their shard is closed.",
        "- Memory does not grow with the set: a worker holds one contact, or the records of one shard while it closes it, "
        "the driver a number for each contact. A reader holds all: training on shards one after the other is not built.",
        "- A worker or machine that is lost costs what it held, a second's work; a driver that is lost costs nothing that "
        "is on the disk, and the same command goes on.",
        "",
        "## What an object store changes",
        "",
        f"Not built; reckoned. A store takes about {_PUTS_PER_S} objects a second under one prefix, and is paid by the "
        f"object: {samples:,} images one by one are {samples / _PUTS_PER_S / 60:.0f} minutes of that at best, and "
        f"{samples * _DOLLARS_PER_PUT:.0f} dollars; {shards:,} shards as one object each are a second and nothing. Shards "
        "would be packed by a worker and put whole; what is there would be told by a list of objects, since there is no "
        "renaming and no lock; and the manifest, put last, would be what makes the set.",
    ]
    return out
