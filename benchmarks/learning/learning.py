"""Benefit of each step of training, of shear in the training set, and error against run time over networks.

`tactip bench learning --task surface` makes missing sets, trains, evaluates on held-out test contacts, and writes
docs/learning.md, learning.json and learning.png. After an interruption it resumes. It takes hours on two cores; a GPU is
used where there is one.
"""

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.options import LearningOptions
from tactip_twin.learning.configuration import Recipe
from tactip_twin.learning.data import Samples, read_samples, read_splits
from tactip_twin.learning.evaluate import evaluate
from tactip_twin.learning.model import load_model, load_network
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_meta
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.labels import Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import load_design

PAPER = {
    "surface": {"pose_z": 0.1, "pose_Rx": 0.3, "pose_Ry": 0.3},
    "edge": {"pose_x": 0.6, "pose_z": 0.2, "pose_Rx": 1.4, "pose_Ry": 1.6, "pose_Rz": 6.4},
}
"""Mean errors of the paper's best networks on its real test sets [P]."""

BARS = {
    "surface": {"pose_z": 0.05, "pose_Rx": 0.15, "pose_Ry": 0.15},
    "edge": {"pose_x": 0.3, "pose_z": 0.1, "pose_Rx": 0.7, "pose_Ry": 0.8, "pose_Rz": 3.2},
}
"""Target mean errors of this project."""

_FURTHER = {"epochs": 16, "learning_rate": 7e-4, "muon_learning_rate": 0.007}
"""Settings of a training with initial weights: half of the rates, and fewer epochs; estimates [?]."""

FILTERS = (4, 8, 16)
"""Numbers of first filters of the other networks on the curve."""

BENT_PER_M = (-28.0, 80.0)
"""Principal curvatures of curved surfaces, 1/m, as on the bust: from hollows of 36 mm radius to ridges of 12.5 mm."""

UNEVEN = 0.5
"""Fraction of them with varying curvature: trained without, a network errs by 2 degrees of tilt about a nose; trained on
these alone, by 0.2 mm of depth on a sphere."""

LOOKS = 20
"""Sequence images of each contact of the row `laptop-looks`."""

BENT_SHEARS = replace(SHEAR_RANGES, x_mm=(-8, 8), y_mm=(-8, 8))
"""Shears on curved surfaces: the paper's are too short for deep contacts to slide, as they always do in servoing."""

DESIGN, FIDELITY = "tactip-127", "standard"


CROSSINGS = (
    (
        "Shear in training",
        {"laptop-plain": "sheared contacts", "laptop-taps": "taps"},
        {"sheared": "sheared contacts", "taps": "taps"},
    ),
    (
        "Bent surfaces in training",
        {"laptop": "flat surfaces", "laptop-bent": "bent surfaces"},
        {"sheared": "flat surfaces", "bent": "bent surfaces"},
    ),
)
"""Tables of networks trained on one kind of contact and tested on another: title, and names of rows and tests."""


@dataclass(frozen=True)
class Row:
    """A training of the benchmark."""

    name: str
    """Name of its row in the tables and of its folder."""
    what: str
    """Description, for the page."""
    kind: str
    """Training set: plain, symmetric, most, looks, taps or bent."""
    recipe: Recipe
    """Network and training."""
    init_from: str = ""
    """Shipped network whose weights are the initial ones; empty for random ones."""


def rows(task: Task, paper: bool) -> list[Row]:
    """Return the trainings of a task, by steps, with or without the paper's own network."""
    laptop, papers = recipe_named("laptop", task), recipe_named("paper", task)

    def papers_with(filters: int) -> Recipe:
        return replace(
            papers, network=replace(papers.network, filters=filters, dense_units=min(papers.network.dense_units, 64))
        )

    def wide(filters: int) -> Recipe:
        return replace(laptop, network=replace(laptop.network, filters=filters))

    plain, varied = (
        replace(laptop, settings=replace(laptop.settings, **changes))
        for changes in ({"augmented_fraction": 0.0}, {"augmentation_strength": 1.0})
    )
    ours = "the network and training of `laptop`"
    out = [Row("paper", "the paper's network and training", "plain", papers)] if paper else []
    out += [
        Row("paper-16", "the paper's network and training with 16 filters and at most 64 units", "plain", papers_with(16)),
        Row("laptop-plain", f"{ours}, on the same images", "plain", laptop),
        Row(
            "laptop-looks", f"the same, on looks at fewer contacts, {LOOKS} each, made in the time of those", "looks", laptop
        ),
        Row("laptop-taps", f"{ours}, on as many contacts without shear", "taps", laptop),
        Row("laptop", f"{ours}, each contact turned and mirrored", "symmetric", laptop),
    ]
    out += [Row(f"laptop-{f}", f"the same with {f} first filters", "symmetric", wide(f)) for f in FILTERS]
    out += [
        Row("laptop-still", "`laptop` on the plain images alone", "symmetric", plain),
        Row("laptop-varied", "`laptop` with five times the variation of optics", "symmetric", varied),
        Row("laptop-most", "`laptop`, on more contacts", "most", laptop),
    ]
    start, further = f"{task}-{DESIGN}", replace(laptop, settings=replace(laptop.settings, **_FURTHER))
    again = f"`{start}` taught further, on contacts of the tip as it is fitted now, those of `laptop-most`"
    out.append(Row("laptop-further", again, "most", further, start))
    if task == "surface":
        bent = f"`{start}` taught further, on surfaces bent by {BENT_PER_M[0]:g} to {BENT_PER_M[1]:g} /m unevenly"
        out.append(Row("laptop-bent", bent, "bent", further, start))
    return out


def jobs(options: LearningOptions, kinds: Collection[str]) -> list[Job]:
    """Return the sets that are needed, whether they exist or not: the test sets of all rows, and the training and
    validation sets of rows of some kinds (Row.kind)."""
    task, still = options.task, Ranges()
    each = len(SYMMETRIES[task])
    wanted = [("plain", "test", options.judged, SHEAR_RANGES)]
    wanted += [("taps", "test", options.judged_taps, still)]
    if {"plain", "symmetric", "most"} & set(kinds):
        # The other rows use a part of the set for the row `most`, if it exists.
        most = "most" in kinds or _holds(options.data / "symmetric" / task / "train", options.most * each)
        contacts = options.most if most else options.contacts
        wanted += [("symmetric", "train", contacts * each, SHEAR_RANGES)]
    if {"plain", "symmetric", "most", "looks"} & set(kinds):
        wanted += [("plain", "val", options.judged, SHEAR_RANGES)]
    if "looks" in kinds:
        wanted += [("looks", "train", options.looked * LOOKS, SHEAR_RANGES)]
    if "taps" in kinds:
        wanted += [("taps", "train", options.contacts, still), ("taps", "val", options.judged_taps, still)]
    if task == "surface":
        wanted += [("bent", "test", options.judged_taps, BENT_SHEARS)]
        if "bent" in kinds:
            wanted += [("bent", "train", options.bent * each, BENT_SHEARS)]
            wanted += [("bent", "val", options.judged_taps, BENT_SHEARS)]
    out = []
    for kind, split, samples, shear in wanted:
        configuration = Configuration(
            task=task,
            split=split,
            samples=samples,
            seed=0,
            # Eight images per contact cost more by OpenGL than the contact; test sets are rendered by it all the same.
            renderer="raster" if (kind, split) == ("bent", "train") else "pyrender",
            design=load_design(DESIGN),
            fidelity=fidelity_named(FIDELITY),
            pose=POSE_RANGES[task],
            shear=shear,
            augment_symmetry=kind == "symmetric" or (kind, split) == ("bent", "train"),
            curvature_per_m=BENT_PER_M if kind == "bent" else (0.0, 0.0),
            varying_curvature_fraction=UNEVEN if kind == "bent" else 0.0,
            snapshots_per_contact=LOOKS if kind == "looks" else 1,
        )
        out.append(Job(configuration, options.data / kind / task / split))
    return out


def _holds(folder: Path, samples: int) -> bool:
    """Return whether a folder holds a finished set of a number of samples."""
    return (folder / "meta.json").exists() and read_meta(folder)["configuration"]["samples"] == samples


class Sets:
    """The sets of a task, read on demand."""

    def __init__(self, options: LearningOptions) -> None:
        self._options, self._each = options, len(SYMMETRIES[options.task])
        self._most: Samples | None = None

    def training(self, kind: str) -> tuple[Samples, Samples]:
        """Return training and validation samples of a kind (Row.kind).

        Raises:
            TactipError: A set is missing or damaged.
        """
        if kind in ("taps", "bent"):
            return read_splits(self._folder(kind))
        if kind == "looks":
            return read_samples(self._folder(kind) / "train"), read_samples(self._folder("plain") / "val")
        if self._most is None:
            self._most = read_samples(self._folder("symmetric") / "train")
        chosen = {
            # The first sample of a contact is the contact as simulated, before its symmetric copies.
            "plain": slice(0, self._options.contacts * self._each, self._each),
            "symmetric": slice(0, self._options.contacts * self._each),
            "most": slice(None),
        }[kind]
        return self._most.take(chosen), read_samples(self._folder("plain") / "val")

    def tests(self) -> dict[str, Samples]:
        """Return test samples by kind of contact. Raises TactipError where a set is missing or damaged."""
        kinds = {"sheared": "plain", "taps": "taps"} | ({"bent": "bent"} if self._options.task == "surface" else {})
        return {name: read_samples(self._folder(kind) / "test") for name, kind in kinds.items()}

    def _folder(self, kind: str) -> Path:
        return self._options.data / kind / self._options.task


def run(options: LearningOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure a task, write learning.json, learning.md and learning.png, and return the results of the task.

    Progress goes to `log`. Raises TactipError, and Interrupted at Ctrl-C.
    """
    lookup("task", options.task, dict.fromkeys(PAPER))
    if not 1 <= options.contacts <= options.most:
        raise TactipError(f"--contacts is {options.contacts}: it must be 1 to --most, {options.most}")
    chosen = {row.name: row for row in rows(options.task, options.paper)}
    order = list(chosen)
    if options.only:
        chosen = {name: lookup("row", name, chosen) for name in options.only}
    make(jobs(options, {row.kind for row in chosen.values()}), worker_count(options.workers), log)
    sets = Sets(options)
    tests = sets.tests()
    counts = {name: getattr(options, name) for name in ("contacts", "most", "judged", "judged_taps")}
    record = {**counts, "rows": _kept(options, counts)}
    for row in chosen.values():
        folder = options.runs / options.task / row.name
        log(f"{row.name}: {row.what}")
        training, validation = sets.training(row.kind)
        initial = load_network(row.init_from) if row.init_from else None
        history = train(training, validation, row.recipe.network, row.recipe.settings, folder, log=log, init_from=initial)
        model = load_model(folder)
        figures = {name: evaluate(model, samples).figures for name, samples in tests.items()}
        measured = {
            "name": row.name,
            "what": row.what,
            "set": row.kind,
            **_own_count(options, row.kind),
            "version": version("tactip-twin"),
            "machine": machine(),
            "images": len(training),
            "epochs": len(history),
            "seconds": sum(h["seconds"] for h in history),
            "parameters": figures["sheared"]["parameters"],
            "latency_ms": figures["sheared"]["latency_ms"],
            "mae": {name: f["mae"] for name, f in figures.items()},
        }
        others = [r for r in record["rows"] if r["name"] != row.name and r["name"] in order]
        record["rows"] = sorted([*others, measured], key=lambda r: order.index(r["name"]))
        _write(options, record)
    return record


def _own_count(options: LearningOptions, kind: str) -> dict[str, int]:
    """Return `contacts` of a kind of set (Row.kind) that has a number of its own; empty for the others."""
    own = {"bent": "bent", "looks": "looked"}
    return {"contacts": getattr(options, own[kind])} if kind in own else {}


def _kept(options: LearningOptions, counts: Mapping[str, int]) -> list[dict[str, Any]]:
    """Return the rows of learning.json that were measured on as many contacts, each with its machine."""
    path = options.out / "learning.json"
    before = json.loads(path.read_text()).get(options.task, {}) if path.exists() else {}
    if {name: before.get(name) for name in counts} != counts:
        return []
    kept = []
    for row in before["rows"]:
        # Older rows do not have their own count: the default is assumed.
        count = {name: row.get(name, own) for name, own in _own_count(LearningOptions(), row["set"]).items()}
        if count == _own_count(options, row["set"]):
            kept.append({**row, "machine": _machine(row, before)})
    return kept


def _machine(row: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, str]:
    """Return the machine of a row; for older rows it is that of the record."""
    return row["machine"] if "machine" in row else record["machine"]


def _write(options: LearningOptions, record: dict[str, Any]) -> None:
    """Put a task's results into learning.json, and write page and figure."""
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "learning.json"
    whole = json.loads(path.read_text()) if path.exists() else {}
    whole[options.task] = record
    whole = {task: whole[task] for task in PAPER if task in whole}
    write_file(path, (json.dumps(whole, indent=1) + "\n").encode())
    write_file(options.out / "learning.md", markdown(whole).encode())
    plot(whole, options.out / "learning.png")


def markdown(whole: Mapping[str, Any]) -> str:
    """Return the Markdown of learning.json."""
    lines = [
        "# What is learned, and what each step buys",
        "",
        "Written by `tactip bench learning`; do not edit. Mean absolute errors on test contacts that no network has seen, "
        f"sheared as the paper's; the twin is `{DESIGN}` at `{FIDELITY}`, as it was fitted in the version that trained and "
        "tested. The paper's figures are of a real sensor.",
        "",
        "![error against run time](learning.png)",
    ]
    for task, record in whole.items():
        names = list(PAPER[task])
        by_machine: dict[str, list[str]] = {}
        for row in record["rows"]:
            by_machine.setdefault(machine_text(_machine(row, record)), []).append(f"`{row['name']}`")
        alike = [f" On: {state}." for state in by_machine if len(by_machine) == 1]
        lines += [
            "",
            f"## {task}",
            "",
            f"{record['contacts']} contacts to train on, {record['most']} in `laptop-most`; {record['judged']} each to "
            f"validate and to test, of those without shear {record['judged_taps']}.{''.join(alike)}",
            "",
            "| network | version | images | epochs | minutes | parameters | ms an image | " + " | ".join(names) + " |",
            "|" + "---|" * (7 + len(names)),
            "| the paper, real sensor | | 2000 | | | | | " + " | ".join(f"{PAPER[task][n]:g}" for n in names) + " |",
            "| what we ask | | | | | | 5 | " + " | ".join(f"{BARS[task][n]:g}" for n in names) + " |",
        ]
        for row in record["rows"]:
            cells = [
                f"{row['name']}: {row['what']}",
                row.get("version", "0.1.0"),
                row["images"],
                row["epochs"],
                f"{row['seconds'] / 60:.0f}",
                row["parameters"],
            ]
            cells += [f"{row['latency_ms']:.2f}", *(f"{row['mae']['sheared'][n]:.3f}" for n in names)]
            lines.append("| " + " | ".join(map(str, cells)) + " |")
        if len(by_machine) > 1:
            lines += [line for state, names in by_machine.items() for line in ("", f"{', '.join(names)} on: {state}.")]
        by_name = {row["name"]: row for row in record["rows"]}
        for title, trained, tested in CROSSINGS:
            found = [by_name[name] for name in trained if name in by_name]
            if len(found) == len(trained) and all(kind in row["mae"] for row in found for kind in tested):
                lines += ["", f"{title}:", "", "| trained on | tested on | " + " | ".join(names) + " |"]
                lines.append("|" + "---|" * (2 + len(names)))
                for name, training in trained.items():
                    for kind, what in tested.items():
                        cells = " | ".join(f"{by_name[name]['mae'][kind][n]:.3f}" for n in names)
                        lines.append(f"| {training} | {what} | {cells} |")
    return "\n".join(lines) + "\n"


def relative_error(row: Mapping[str, Any], task: str) -> float:
    """Return a row's mean error over its target, averaged over components."""
    return float(np.mean([row["mae"]["sheared"][n] / BARS[task][n] for n in BARS[task]]))


def plot(whole: Mapping[str, Any], path: Path) -> None:
    """Plot error against latency of the networks, one panel per task, into a PNG file."""
    figure, axes = figure_of(1, len(whole), (6 * len(whole), 4.2))
    colors = dict(zip(("symmetric", "most", "bent"), COLORS, strict=False))
    box = {"fc": "white", "ec": "none", "pad": 0.5}
    for axis, (task, record) in zip(axes, whole.items(), strict=True):
        for row in record["rows"]:
            x, y = row["latency_ms"], relative_error(row, task)
            axis.plot(x, y, "o", color=colors.get(row["set"], "0.6"))
            axis.annotate(row["name"], (x, y), xytext=(0, 5), textcoords="offset points", ha="center", fontsize=8, bbox=box)
        axis.axhline(1, color="0.4", lw=0.8)
        for name in "xy":
            log_axis(axis, name)
        axis.margins(0.15)
        axis.set(xlabel="time per image on one core, ms", ylabel="mean error / target", title=task)
    save_figure(figure, path)
