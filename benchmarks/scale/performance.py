"""Rates, memory and scaling on one machine: `tactip bench performance` writes docs/performance.md and performance.json.

Each group is measured alone and kept, so the page shows the last measurement of each. Rates of sets are marginal: the
difference in time between a larger and a smaller set, over the difference in contacts; fixed costs are listed separately.
"""

import contextlib
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.benchmarks.scale import shared_cores
from tactip_twin.benchmarks.scale.options import PerformanceOptions
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.labels import Task
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import RendererName

_SNAPSHOTS = 20
"""Number of images per contact in sets with a sliding path."""

_FEW = 4
"""Contacts per worker of the smaller of two sets."""

_REPEATS = 5
"""Repetitions of short measurements, of which the median is taken."""

_MIN_STEPS = 4
"""Minimum number of steps of a servo run."""

PLAIN: dict[str, Any] = {
    "task": "surface", "fidelity": "standard", "renderer": "raster", "augment_symmetry": False, "design": "tactip-127",
}  # fmt: skip
QUICK = PLAIN | {"fidelity": "draft", "augment_symmetry": True}
"""Options of made_set: a data set as usual, and one that is made quickly."""

_TRIES = 3
"""Maximum number of measurements of a rate while its result is impossible."""

_BATCH = 64
"""Images of a batch, in rendering, training and evaluation."""


def run(options: PerformanceOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure, write performance.json and performance.md, and return the results.

    Progress goes to `log`. Raises TactipError.
    """
    names = [lookup("group", name, dict(zip(GROUPS, GROUPS, strict=True))) for name in options.groups or GROUPS]
    for name, value, minimum in (("contacts", options.contacts, 1), ("steps", options.steps, _MIN_STEPS)):
        require(value >= minimum, f"--{name}", value, f"at least {minimum}")
    record: dict[str, Any] = read_results(options.out / "performance.json") or {"groups": {}}
    groups = record["groups"]
    for name in names:
        log(f"{name}: {GROUPS[name][0]}")
        groups[name] = {"machine": machine(), "rows": GROUPS[name][1](options)}
        record = {"groups": {g: groups[g] for g in GROUPS if g in groups}}
        write_results("performance", record, tables(record), options.out)
    return record


def _median(function: Callable[[], object], repeats: int = _REPEATS) -> float:
    """Return the median time of a function's calls, s; the first call is left out."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Suppress progress bars."""
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stderr(nowhere):
        yield


def made_set(
    folder: str | PathLike[str],
    samples: int,
    workers: int,
    task: str,
    fidelity: str,
    renderer: RendererName,
    augment_symmetry: bool,
    design: str,
    snapshots_per_contact: int = 1,
) -> Path:
    """Make a training set in a subfolder, and return its folder."""
    configuration = Configuration(
        task=task,
        split="train",
        samples=samples,
        seed=0,
        renderer=renderer,
        design=load_design(design),
        fidelity=fidelity_named(fidelity),
        pose=POSE_RANGES[task],
        shear=SHEAR_RANGES,
        augment_symmetry=augment_symmetry,
        snapshots_per_contact=snapshots_per_contact,
    )
    with _quietly():
        make([Job(configuration, Path(folder) / "set")], workers, lambda line: None)
    return Path(folder) / "set"


def set_seconds(contacts: int, workers: int, **case: Any) -> tuple[float, float]:
    """Return the time of making a set, s, and the peak memory of a worker, MiB. The set is deleted."""
    samples = contacts * _samples_per_contact(case)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        made = made_set(folder, samples, workers, **case)
        seconds = time.perf_counter() - start
        run = json.loads((made / "run.json").read_text())
    return seconds, run["peak_memory_of_a_worker_MiB"]


def _samples_per_contact(case: dict[str, Any]) -> int:
    """Return the number of samples of a contact."""
    return (len(SYMMETRIES[case["task"]]) if case["augment_symmetry"] else 1) * case.get("snapshots_per_contact", 1)


def _samples(options: PerformanceOptions) -> list[dict[str, Any]]:
    """Return contacts and samples per second of whole sets: contact, image, record and file."""
    cores = int(machine()["cores"])
    cases = [(PLAIN, workers) for workers in sorted({1, cores})]
    changes: tuple[dict[str, Any], ...] = (
        {"augment_symmetry": True},
        {"renderer": "pyrender"},
        {"fidelity": "draft"},
        {"fidelity": "reference"},
    )
    cases += [(PLAIN | change, cores) for change in (*changes, {"design": "nominal-331"}, {"task": "edge"})]
    cases += [(PLAIN | {"task": "edge", "augment_symmetry": True}, cores)]
    cases += [(PLAIN | {"task": task, "snapshots_per_contact": _SNAPSHOTS}, cores) for task in ("surface", "edge")]
    rows = []
    for case, workers in cases:
        more = max(cores, options.contacts // case.get("snapshots_per_contact", 1))
        rate, once, peak = _rate(_FEW * workers, more, workers, **case)
        rows.append({
            "what": _name(case), "workers": workers, "contacts/s": rate,
            "samples/s": rate * _samples_per_contact(case), "fixed cost, s": once, "memory per worker, MiB": peak,
        })  # fmt: skip
    return rows


def _rate(few: int, more: int, workers: int, **case: Any) -> tuple[float, float, float]:
    """Return contacts per second, the fixed cost (s) and a worker's peak memory (MiB), from two sets.

    Args:
        few: Contacts of the smaller set.
        more: Contacts that the larger set has in addition.
        workers: Number of worker processes.
        case: Options of made_set.

    Raises:
        TactipError: _TRIES times, the larger set took no longer, or so much longer that the fixed cost was negative.
    """
    base = whole = 0.0
    for _ in range(_TRIES):
        base, _ = set_seconds(few, workers, **case)
        whole, peak = set_seconds(few + more, workers, **case)
        once = base - few * (whole - base) / more
        if whole > base and once >= 0:
            return more / (whole - base), once, peak
    raise TactipError(
        f"the machine is too busy to measure: sets of {few} and of {few + more} contacts took {base:.1f} and {whole:.1f} s, "
        f"after {_TRIES - 1} other tries; the larger must take longer, by less than in proportion to its contacts"
    )


def _name(case: dict[str, Any]) -> str:
    """Return the description of a set in the table."""
    words = [case["task"], case["fidelity"], case["renderer"], case["design"]]
    words += ["with symmetries"] * case["augment_symmetry"]
    return ", ".join(
        words + [f"{count} snapshots per contact" for count in [case.get("snapshots_per_contact", 1)] if count > 1]
    )


def _images(options: PerformanceOptions) -> list[dict[str, Any]]:
    """Return images per second of each renderer, of `raster` in batches, and of augmentation in training, in batches."""
    import torch

    from tactip_twin.learning.augmentation import OpticsAugmentation
    from tactip_twin.learning.data import read_samples
    from tactip_twin.learning.device import one_thread
    from tactip_twin.learning.optics_ranges import OPTICS
    from tactip_twin.tactip_model.pins import neutral_pins
    from tactip_twin.tactip_model.renderer import renderer_named
    from tactip_twin.tactip_model.tactile_image import tactile_image

    rows: list[dict[str, Any]] = []
    for name in ("tactip-127", "nominal-331"):
        design = load_design(name)
        pins = neutral_pins(design)
        for renderer in ("pyrender", "raster"):
            render = renderer_named(renderer, design)
            frame = render(*pins)
            rows.append({
                "design": name, "what": f"{renderer}, single images",
                "frames/s": 1 / _median(lambda render=render, pins=pins: render(*pins), 20),
                "tactile images/s": 1 / _median(lambda f=frame, d=design: tactile_image(f, d.image), 20),
            })  # fmt: skip
        batch = [np.broadcast_to(values, (_BATCH, *values.shape)) for values in pins]
        seconds = _median(lambda render=render, batch=batch: render(*batch))
        rows.append({"design": name, "what": f"raster, batches of {_BATCH}", "frames/s": _BATCH / seconds})
        with tempfile.TemporaryDirectory() as folder:
            case: dict[str, Any] = QUICK | {"design": name}
            samples = read_samples(made_set(folder, _BATCH, 1, **case))
            chosen = torch.arange(len(samples))
            for varied in ("lens", "real"):
                drawn = OpticsAugmentation(samples, 1.0, OPTICS[varied])
                with one_thread():
                    seconds = _median(lambda d=drawn, c=chosen: d.render(c))
                what = f"augmentation in training, `{varied}`, batches of {_BATCH}"
                rows.append({"design": name, "what": what, "frames/s": len(samples) / seconds})
    return rows


def _learning(options: PerformanceOptions) -> list[dict[str, Any]]:
    """Return images per second in training, validated on as many images as trained on, and the time of an estimate."""
    import torch

    from tactip_twin.learning.data import read_samples
    from tactip_twin.learning.device import one_thread
    from tactip_twin.learning.model import load_network
    from tactip_twin.learning.recipes import recipe_named
    from tactip_twin.learning.training import Training

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        samples = read_samples(made_set(folder, _BATCH, 1, **QUICK))
        for recipe in ("laptop", "paper"):
            its = recipe_named(recipe, "surface")
            settings = replace(its.settings, augmented_fraction=0.0)
            for drawn in (0.0, its.settings.augmented_fraction) if its.settings.augmented_fraction else (0.0,):
                training = Training(samples, samples, its.network, replace(settings, augmented_fraction=drawn))
                seconds = _median(lambda t=training: t.train_epoch(), 3 if recipe == "laptop" else 1)
                rows.append({
                    "what": f"epoch of `{recipe}`, {drawn:.0%} of the images augmented",
                    "images/s": len(samples) / seconds,
                    "threads": torch.get_num_threads(),
                })  # fmt: skip
        for name in ("surface-tactip-127", "edge-tactip-127"):
            model = load_network(name)
            image = samples.images[:1]
            one = _median(lambda m=model, i=image: m.predict(i), 50)
            with one_thread():
                many = _median(lambda m=model: m.predict(samples.images)) / len(samples)
            rows.append(
                {"what": f"prediction by `{name}`", "ms, single image": 1e3 * one, "ms per image, batch of 64": 1e3 * many}
            )
    return rows


def _servo(options: PerformanceOptions) -> list[dict[str, Any]]:
    """Return servo steps per second, and the time of each part of a step."""
    from tactip_twin.control.options import RouteOptions, ServoOptions, Settings
    from tactip_twin.control.servo_run import run_servo

    rows: list[dict[str, Any]] = []
    objects: tuple[tuple[Task, str], ...] = (("surface", "bust"), ("edge", "rim-round"))
    for task, thing in objects:
        for arm in ("none", "dynamic"):
            for fidelity in ("draft", "standard"):
                with tempfile.TemporaryDirectory() as folder:
                    run_options = ServoOptions(
                        Path(folder) / "run", task, thing, arm=arm, fidelity=fidelity, route=RouteOptions(),
                        settings=Settings(max_steps=options.steps),
                    )  # fmt: skip
                    score = run_servo(run_options, log=lambda line: None)
                what = f"{thing}, arm {arm}, {fidelity}"
                parts = {f"ms, {part}": value for part, value in score["ms_a_step"].items()}
                rows.append({"what": what, "steps/s": score["steps_per_s"], **parts})
    return rows


GROUPS: dict[str, tuple[str, Callable[[PerformanceOptions], list[dict[str, Any]]]]] = {
    "samples": ("rates of data sets", _samples),
    "images": ("rates of rendering", _images),
    "learning": ("training and prediction", _learning),
    "servo": ("rates of servo steps", _servo),
    "shared-cores": ("two jobs side by side", lambda options: shared_cores.rows()),
}
"""Description and function of each group."""


def tables(record: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/performance.md from performance.json: one of each group."""
    out = {}
    for name in GROUPS:
        if name not in record["groups"]:
            out[name] = "Not measured."
            continue
        group = record["groups"][name]
        columns = list(dict.fromkeys(key for row in group["rows"] for key in row))
        rows = table(columns, [[_cell(row.get(key)) for key in columns] for row in group["rows"]])
        out[name] = f"{rows}\n\nMachine: {machine_text(group['machine'])}."
    return out


def _cell(value: object) -> str:
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"
