"""The learned tip against the simulation: `tactip bench fast-tip`.

Teaches tips by number of contacts, and compares their pins and forces with simulated test contacts that none has seen;
measures rates; and puts predicted and corrected contacts beside the presets of the simulation, as error against time. Writes
fast_tip.json, .md and .png.
"""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning_sets import DESIGN, jobs
from tactip_twin.benchmarks.learning.options import FastTipOptions, LearningOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.fast_tip_settings import FastTipSettings
from tactip_twin.learning.fast_tip_training import FAST_TIP, fast_tip_errors, read_contacts, train_fast_tip
from tactip_twin.sim.contact.fidelity import FIDELITIES, fidelity_named
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import sample_contact
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.fast_tip.corrected_contacts import CorrectedContacts
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import FastTip, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.pose import before_shear, label_of, matrix, sensor_in_contact, shear_between
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import SkinReader, neutral_pins, pin_lever_m
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

_REPEATS = 5
"""Number of measurements of each rate, of which the median counts."""

_IMAGES = 200
"""Number of images of which the rate is measured."""


@dataclass(frozen=True)
class _Motions:
    """Motions of test contacts. (k contacts)"""

    design: Design
    """Their tip."""
    poses: np.ndarray
    """(k, 6) m and rad."""
    shears: np.ndarray
    """(k, 6) m and rad."""


def _test_motions(configuration: Configuration) -> _Motions:
    """Return the motions of a set, without simulating it."""
    samples = [sample_contact(configuration, number) for number in range(configuration.samples)]
    return _Motions(configuration.design, np.array([s.pose for s in samples]), np.array([s.shear for s in samples]))


def run(options: FastTipOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure a task, write fast_tip.json and fast_tip.md, and return the results of all tasks. Raises TactipError."""
    if options.times_only and options.release:
        raise TactipError("--times-only trains no tip that --release could copy; leave one of them out")
    task = options.task
    learning = LearningOptions(
        task=task, data=options.data, large_contacts=options.contacts, test_contacts=options.test_contacts
    )
    folders = {name: options.data / kind / task / name for kind, name in _SETS}
    wanted = [job for job in jobs(learning, {"large"}) if job.folder in folders.values()]
    motions = _test_motions(next(job.configuration for job in wanted if job.folder == folders["test"]))
    result = read_results(options.out / "fast_tip.json")
    if options.times_only:
        tip, found = read_fast_tip(shipped_fast_tip(task, DESIGN)), dict(result.get(task, {"rows": []}))
    else:
        make(wanted, worker_count(options.workers), log)
        test, rows, tips = read_contacts([folders["test"]]), [], []
        for count in (*options.counts, 0):
            settings = FastTipSettings(contacts=count, steps=options.steps)
            out = options.runs / task / str(count or options.contacts)
            tips.append(train_fast_tip([folders["train"]], folders["val"], settings, out, log))
            rows.append({"contacts": tips[-1].provenance["contacts"], **fast_tip_errors(tips[-1], test)})
            log(str(rows[-1]))
            if not count and options.release:
                options.release.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(out / FAST_TIP, options.release / f"{task}-{DESIGN}.npz")
        tip = tips[-1]
        found = {"rows": rows, "turned": _turned(tip, motions, options.compared_contacts, log)}
    found["rates"] = _rates(tip, motions)
    found["ways"] = _ways(tip, motions, options.compared_contacts, log)
    found["machine"] = machine()
    result = result | {task: found}
    write_results("fast_tip", result, tables(result), options.out)
    plot(result, options.out / "fast_tip.png")
    return result


_SETS = (("symmetric", "train"), ("plain", "val"), ("plain", "test"))
"""Kinds and splits of the sets of `tactip bench learning` that are used."""


def _rates(tip: FastTip, test: _Motions) -> dict[str, float]:
    """Return contacts per second of one core: in a batch, one by one, and with tactile images."""
    design = test.design
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
        for frame in renderer.render(pins, directions):
            tactile_image(frame, design.image)
        return _IMAGES

    return {work.__name__: _rate(work) for work in (batch, single, images)}


def _ways(tip: FastTip, test: _Motions, count: int, log: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return error and time of the first `count` test contacts, by way to make them, against `standard` and `reference`.

    Contacts of a way that cannot be trusted are left out, and counted.
    """
    design, standard = test.design, fidelity_named("standard")
    predictor, corrector = FastContacts(tip, design), CorrectedContacts(tip, design, standard, QualityLimits())
    simulators = {name: ContactSimulator(design, tip.task, fidelity) for name, fidelity in FIDELITIES.items()}

    def predicted(pose: np.ndarray, shear: np.ndarray) -> Contact | None:
        contacts, trusted = predictor.predict(pose[None], shear[None])
        return contacts[0] if trusted[0] else None

    ways: dict[str, Callable[[np.ndarray, np.ndarray], Contact | None]] = {
        "fast": predicted,
        "corrected": corrector.simulate,
        **{name: simulator.simulate for name, simulator in simulators.items()},
    }
    found: dict[str, list[tuple[Contact | None, float]]] = {name: [] for name in ways}
    for k, (pose, shear) in enumerate(zip(test.poses[:count], test.shears[:count], strict=True)):
        for name, way in ways.items():
            start = time.process_time()
            contact = way(pose, shear)
            found[name].append((contact, time.process_time() - start))
        log(f"{k + 1} of {count} contacts compared")
    seconds = {name: float(np.median([s for _, s in results])) for name, results in found.items()}
    start = time.process_time()
    predictor.pins(test.poses, test.shears)
    found["fast, batch"], seconds["fast, batch"] = found["fast"], (time.process_time() - start) / len(test.poses)
    rows = []
    for name, results in found.items():
        row = {"way": name, "seconds": seconds[name], "cost": seconds[name] / seconds["standard"]}
        row["made"] = sum(contact is not None for contact, _ in results)
        for truth in ("standard", "reference"):
            pairs = [(c, t) for (c, _), (t, _) in zip(results, found[truth], strict=True) if c and t]
            apart = [1e3 * np.linalg.norm(c.pin_tips - t.pin_tips, axis=1).mean() for c, t in pairs]
            forces = np.array([(c.normal_force_n, t.normal_force_n) for c, t in pairs])
            row[truth] = {
                "pins_mm": float(np.mean(apart)),
                "worst_contact_mm": float(np.max(apart)),
                "force": float(np.abs(forces[:, 0] - forces[:, 1]).sum() / forces[:, 1].sum()),
            }
        rows.append(row)
    return rows


def _turned(tip: FastTip, test: _Motions, count: int, log: Callable[[str], None]) -> dict[str, float]:
    """Return how far the pins of the first `count` test contacts at `standard` are from those of the same contacts after the
    tip, but not its pins, was turned about its axis, and from predicted ones.

    The tip is round, but its mesh is not, so the difference is what the mesh adds at random.
    """
    design, predictor = test.design, FastContacts(tip, test.design)
    simulator = ContactSimulator(design, tip.task, fidelity_named("standard"))
    rest, inward = neutral_pins(design)
    turns = [Rotation.from_euler("z", angle, degrees=True) for angle in (0.0, *_TURNS_DEG)]
    readers = [SkinReader(simulator.scene.mesh, turn.inv().apply(-inward)) for turn in turns]
    between, predicted, from_mean = [], [], []
    for k, (pose, shear) in enumerate(zip(test.poses[:count], test.shears[:count], strict=True)):
        found = []
        for turn, reader in zip(turns, readers, strict=True):
            T_sensor_turned = matrix([0, 0, 0], turn)
            end, start = (
                label_of(sensor_in_contact(label) @ T_sensor_turned) for label in (pose, before_shear(pose, shear))
            )
            if simulator.simulate(end, shear_between(start, end)) is None:
                break
            moved, tilted = reader.read(simulator.scene.vertices()[: simulator.scene.mesh.surface_count])
            found.append(rest + turn.apply(moved - pin_lever_m(design) * tilted))
        log(f"{k + 1} of {count} contacts turned")
        if len(found) == len(turns):
            pins, _ = predictor.pins(pose[None], shear[None])
            pairs = [(a, b) for i, a in enumerate(found) for b in found[:i]]
            between.append(np.mean([_apart_mm(a, b) for a, b in pairs]))
            predicted.append(np.mean([_apart_mm(pins[0], one) for one in found]))
            from_mean.append(_apart_mm(pins[0], np.mean(found, 0)))
    values = (float(np.mean(one)) for one in (between, predicted, from_mean))
    return {"contacts": len(between), **dict(zip(("turned_mm", "predicted_mm", "from_mean_mm"), values, strict=True))}


_TURNS_DEG = (17.0, 43.0)
"""Angles by which the tip is turned, degrees: neither is a symmetry of the mesh."""


def _apart_mm(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean distance, mm, of pins (p, 3), m, from others."""
    return float(1e3 * np.linalg.norm(a - b, axis=-1).mean())


def plot(result: dict[str, Any], path: Path) -> None:
    """Plot the mean pin error against `reference` over the CPU time per contact, one panel per task, into a PNG file."""
    compared = {task: found for task, found in result.items() if "ways" in found}
    figure, panels = figure_of(1, len(compared), (4.6 * len(compared), 4.2))
    for axis, (task, found) in zip(panels, compared.items(), strict=True):
        rows = {row["way"]: row for row in found["ways"] if row["way"] != "reference"}
        for names, color in ((("draft", "standard"), "k"), (("fast, batch", "fast", "corrected"), COLORS[0])):
            points = [(rows[name]["seconds"], rows[name]["reference"]["pins_mm"]) for name in names]
            axis.plot(*zip(*points, strict=True), "o-", ms=7, lw=1, color=color)
            for name, point in zip(names, points, strict=True):
                axis.annotate(name, point, (6, 6), textcoords="offset points")
        axis.set_xscale("log")
        axis.set(xlabel="CPU time per contact, s", title=f"{task} contacts", ylim=(0, None))
        axis.margins(x=0.2)
    panels[0].set_ylabel("mean pin error from reference, mm")
    save_figure(figure, path)


def _rate(work: Callable[[], int]) -> float:
    """Return the median number of contacts per second of CPU time."""
    rates = []
    for _ in range(_REPEATS):
        start = time.process_time()
        rates.append(work() / (time.process_time() - start))
    return float(np.median(rates))


def _short(value: float) -> str:
    """Return a number with two significant digits, and all its digits before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


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
    ways = [
        [
            task,
            row["way"],
            _short(1e3 * row["seconds"]),
            _short(row["cost"]),
            f"{row['made']}",
            *(f"{row[truth]['pins_mm']:.3f}" for truth in ("standard", "reference")),
            f"{row['standard']['worst_contact_mm']:.2f}",
            f"{100 * row['standard']['force']:.1f} %",
        ]
        for task, found in result.items()
        for row in found.get("ways", [])
    ]
    way_head = ["task", "method", "CPU time, ms", "relative to standard", "contacts", "pins from standard, mm"]
    way_head += ["pins from reference, mm", "worst contact from standard, mm", "force from standard"]
    turned = [
        [task, f"{row['contacts']:.0f}", *(f"{row[key]:.3f}" for key in ("turned_mm", "predicted_mm", "from_mean_mm"))]
        for task, found in result.items()
        if (row := found.get("turned"))
    ]
    turned_head = ["task", "contacts", "simulated, tip turned, from each other, mm", "predicted from simulated, mm"]
    turned_head += ["predicted from the mean of three turns, mm"]
    machines = sorted({machine_text(found["machine"]) for found in result.values()})
    return {
        "errors": table(head, errors),
        "turned": table(turned_head, turned),
        "ways": table(way_head, ways),
        "rates": table(["task", "contacts in a batch", "contacts one by one", "contacts with images"], rates)
        + "".join(f"\n\nMachine: {one}." for one in machines),
    }
