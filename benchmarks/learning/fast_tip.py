"""The learned tip against the simulation: `tactip bench fast-tip`.

Teaches tips by number of contacts, and compares their pins and forces with simulated test contacts that none has seen;
measures rates. Writes docs/fast_tip.md and docs/fast_tip.json.
"""

import shutil
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning import DESIGN, jobs
from tactip_twin.benchmarks.options import FastTipOptions, LearningOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.fast_tip_settings import FastTipSettings
from tactip_twin.learning.fast_tip_training import FAST_TIP, TipContacts, fast_tip_errors, read_contacts, train_fast_tip
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import FastTip
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

_REPEATS = 5
"""Number of measurements of each rate, of which the median counts."""

_IMAGES = 200
"""Number of images of which the rate is measured."""


def run(options: FastTipOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure a task, write fast_tip.json and fast_tip.md, and return the results of all tasks. Raises TactipError."""
    task = options.task
    learning = LearningOptions(
        task=task, data=options.data, large_contacts=options.contacts, test_contacts=options.test_contacts
    )
    folders = {name: options.data / kind / task / name for kind, name in _SETS}
    make([job for job in jobs(learning, {"large"}) if job.folder in folders.values()], worker_count(options.workers), log)
    test, rows, tips = read_contacts([folders["test"]]), [], []
    for count in (*options.counts, 0):
        settings = FastTipSettings(contacts=count)
        out = options.runs / task / str(count or options.contacts)
        tips.append(train_fast_tip([folders["train"]], folders["val"], settings, out, log))
        rows.append({"contacts": tips[-1].provenance["contacts"], **fast_tip_errors(tips[-1], test)})
        log(str(rows[-1]))
        if not count and options.release:
            options.release.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(out / FAST_TIP, options.release / f"{task}-{DESIGN}.npz")
    result = read_results(options.out / "fast_tip.json") | {
        task: {"rows": rows, "rates": _rates(tips[-1], test), "machine": machine()}
    }
    write_results("fast_tip", result, tables(result), options.out)
    return result


_SETS = (("symmetric", "train"), ("plain", "val"), ("plain", "test"))
"""Kinds and splits of the sets of `tactip bench learning` that are used."""


def _rates(tip: FastTip, test: TipContacts) -> dict[str, float]:
    """Return contacts per second of one core: in a batch, one by one, and with tactile images."""
    design = test.configuration.design
    contacts, renderer = FastContacts(tip, design), Raster(design)
    poses, shears = test.poses, test.shears

    def batch() -> int:
        contacts.pins(poses, shears)
        return len(poses)

    def single() -> int:
        for k in range(_IMAGES):
            contacts.pins(poses[k : k + 1], shears[k : k + 1])
        return _IMAGES

    def images() -> int:
        pins, directions = contacts.pins(poses[:_IMAGES], shears[:_IMAGES])
        for tips, axes in zip(pins, directions, strict=True):
            tactile_image(renderer.render(tips, axes), design.image)
        return _IMAGES

    return {work.__name__: _rate(work) for work in (batch, single, images)}


def _rate(work: Callable[[], int]) -> float:
    """Return the median number of contacts per second of CPU time."""
    rates = []
    for _ in range(_REPEATS):
        start = time.process_time()
        rates.append(work() / (time.process_time() - start))
    return float(np.median(rates))


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of docs/fast_tip.md from fast_tip.json."""
    head = [
        "task",
        "contacts learned from",
        "pins, mean mm",
        "95 %, mm",
        "worst contact, mm",
        "normal force",
        "effective shear, mm",
        "trusted",
        "pins of trusted, mm",
    ]
    errors = [
        [
            task,
            row["contacts"],
            f"{row['pins_mm']:.3f}",
            f"{row['pins_p95_mm']:.3f}",
            f"{row['worst_contact_mm']:.2f}",
            f"{100 * row['force']:.1f} %",
            f"{row['effective_shear_mm']:.3f}",
            f"{100 * row['trusted']:.1f} %",
            f"{row['pins_trusted_mm']:.3f}",
        ]
        for task, found in result.items()
        for row in found["rows"]
    ]
    kinds = "batch", "single", "images"
    rates = [[task, *(f"{found['rates'][kind]:.0f}" for kind in kinds)] for task, found in result.items()]
    machines = sorted({machine_text(found["machine"]) for found in result.values()})
    return {
        "errors": table(head, errors),
        "rates": table(["task", "contacts in a batch", "contacts one by one", "contacts with images"], rates)
        + "".join(f"\n\nMachine: {one}." for one in machines),
    }
