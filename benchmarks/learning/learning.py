"""Benefit of each step of training, of shear and curvature in the training set, and error against run time of networks.

`tactip bench learning --task surface` makes missing data sets, trains, evaluates on held-out test contacts, and writes
learning.json, learning.md and learning.png. Rerun it after an interruption to resume. It takes hours on two cores; a GPU is
used if there is one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning_sets import (
    ANY_DESIGNS,
    DESIGN,
    MORE_PINS_DESIGN,
    NOISES_GREY,
    NOISY,
    SNAPSHOTS,
    WIDE_KINDS,
    WIDE_PX,
    Sets,
    jobs,
)
from tactip_twin.benchmarks.learning.options import LearningOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.configuration import Recipe, TrainSettings
from tactip_twin.learning.evaluate import evaluate
from tactip_twin.learning.model import load_model, load_network
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.labels import TASKS, Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.errors import TactipError, lookup

PAPER = {
    "surface": {"pose_z": 0.1, "pose_Rx": 0.3, "pose_Ry": 0.3},
    "edge": {"pose_x": 0.6, "pose_z": 0.2, "pose_Rx": 1.4, "pose_Ry": 1.6, "pose_Rz": 6.4},
}
"""Mean errors of the paper's best networks on its real test sets [P]."""

TARGETS = {
    "surface": {"pose_z": 0.05, "pose_Rx": 0.15, "pose_Ry": 0.15},
    "edge": {"pose_x": 0.3, "pose_z": 0.1, "pose_Rx": 0.7, "pose_Ry": 0.8, "pose_Rz": 3.2},
}
"""Target mean errors of this project."""

_FINE_TUNING = {"epochs": 16, "learning_rate": 7e-4, "muon_learning_rate": 0.007}
"""Settings of fine-tuning: half of the learning rates, and fewer epochs; estimates [?]."""

_FAST_TRAINING = {"learning_rate": 1e-3, "muon_learning_rate": 0.01}
"""Settings of trainings on predicted contacts, which start from a shipped network but add outputs to it [?]."""

_LAST_TRAINING = {
    "epochs": 2,
    "min_steps": 0,
    "learning_rate": 3e-4,
    "muon_learning_rate": 0.003,
    "optics_ranges": "lens-jitter",
}
"""Settings of the row that adds images of the undeformed tip [?]."""

_FAST_EPOCHS: dict[Task, int] = {"surface": 8, "edge": 14}
"""Number of epochs on predicted contacts; surfaces need fewer [?]."""

_DRAWN_TRAINING = {
    "min_steps": 0,
    "learning_rate": 2e-3,
    "muon_learning_rate": 0.02,
    "drawn_contacts": 16384,
}
"""Training on contacts that are drawn anew at every epoch: rates of twice the batch [?]."""

_DRAWN_EPOCHS: dict[Task, int] = {"surface": 20, "edge": 30}
"""Numbers of epochs on drawn contacts; surfaces need fewer [?]."""

_LONG_TRAINING = {
    "epochs": 64,
    "min_steps": 0,
    "learning_rate": 2e-3,
    "muon_learning_rate": 0.02,
    "optics_ranges": "lens-jitter",
    "drawn_contacts": 65536,
    "drawn_epochs": 4,
}
"""A training for a GPU, of 16,000 steps of 256 images [?]."""

_NOISE_TRAINING = {
    "epochs": 12,
    "min_steps": 0,
    "learning_rate": 7e-4,
    "muon_learning_rate": 0.007,
    "optics_ranges": "lens-salt",
    "augmented_fraction": 0.5,
    "drawn_contacts": 16384,
}
"""The training after it, with images of a noisy camera [?]."""

_LIGHT_EPOCHS: dict[Task, int] = {"surface": 12, "edge": 32}
"""Numbers of epochs of this training once more; edges need more [?]."""

_ANY_TRAINING = {"augmented_fraction": 0.6, "augmentation_strength": 1.0, "optics_ranges": "real"}
"""Settings of networks that know any materials and cameras, as in a transfer [?]."""

_MORE_PINS_EPOCHS, _ANY_EPOCHS, _ANY_YAW_EPOCHS = 60, 16, 40
"""Numbers of epochs of such networks: from random weights, on a GPU, from a shipped network, and from one that knows fewer
yaws [?]."""

BETAS = (0.0, 0.5, 1.0)
"""Exponents of the weighted likelihood that are compared; recipes have the middle one."""

_BETA_EPOCHS = 10
"""Number of epochs of these trainings on drawn contacts [?]."""

_SLIDE_EPOCHS: dict[Task, int] = {"surface": 20, "edge": 12}
"""Numbers of epochs on drawn slides; those on surfaces are curved, which the initial network does not know [?]."""

_SLIDE_TRAINING = _NOISE_TRAINING | {"learning_rate": 1e-3, "muon_learning_rate": 0.01, "drawn_epochs": 2}
"""Training on slides; drawing them takes as long as an epoch [?]."""

FILTERS = (4, 8, 16)
"""Numbers of filters of the first layer of smaller networks."""

CROSS_TESTS = {
    "Shear in the training set": (("laptop-plain", "laptop-taps"), ("sheared", "taps")),
    "Slides in the training set": (("laptop-noise", "laptop-slides"), ("sheared", "slides")),
}
"""Tables of networks trained on one kind of contact and tested on another, by heading: names of rows and of tests."""

_KINDS = {
    "sheared": "single, sheared",
    "taps": "single, not sheared",
    "slides": "sliding (on surfaces: curved ones)",
}


@dataclass(frozen=True)
class Row:
    """A training of the benchmark."""

    name: str
    """Name of its row in the tables and of its folder."""
    what: str
    """Description in the tables."""
    kind: str
    """Training set: plain, symmetric, large, fast, snapshots, taps, 256px, 331, any, any-yaw, drawn, slides or
    256px-slides."""
    recipe: Recipe
    """Network and training."""
    init_from: str = ""
    """Shipped network, or earlier row, whose weights are the initial weights; empty: random weights."""


def rows(task: Task, paper: bool) -> list[Row]:
    """Return the trainings of a task, with or without the paper's own network."""
    laptop, papers = recipe_named("laptop", task), recipe_named("paper", task)
    small = replace(papers.network, filters=16, dense_units=min(papers.network.dense_units, 64))
    out = [Row("paper", "the paper's recipe", "plain", papers)] if paper else []
    out += [
        Row("paper-16", "the paper's recipe with 16 filters and at most 64 units", "plain", replace(papers, network=small)),
        Row("laptop-plain", "recipe `laptop`, one image per contact", "plain", laptop),
        Row("laptop-snapshots", f"the same, {SNAPSHOTS} images of fewer contacts", "snapshots", laptop),
        Row("laptop-taps", "the same as `laptop-plain`, contacts without shear", "taps", laptop),
        Row("laptop", "recipe `laptop`, with rotated and mirrored copies of each contact", "symmetric", laptop),
    ]
    for filters in FILTERS:
        recipe = replace(laptop, network=replace(laptop.network, filters=filters))
        out.append(Row(f"laptop-{filters}", f"the same, {filters} filters in the first layer", "symmetric", recipe))
    out.append(Row("laptop-large", "`laptop` on more contacts", "large", laptop))
    start, tuned = f"{task}-{DESIGN}", replace(laptop, settings=replace(laptop.settings, **_FINE_TUNING))
    out.append(Row("laptop-fine-tuned", f"`{start}` fine-tuned on the contacts of `laptop-large`", "large", tuned, start))
    predicted = replace(laptop, settings=replace(laptop.settings, epochs=_FAST_EPOCHS[task], **_FAST_TRAINING))
    contacts_only = replace(predicted, settings=replace(predicted.settings, undeformed_fraction=0.0))
    last = replace(predicted, settings=replace(predicted.settings, **_LAST_TRAINING))
    on = "on contacts that the learned tip predicts"
    out.append(Row("laptop-fast", f"`{start}` fine-tuned {on}, light ones among them", "fast", contacts_only, start))
    out.append(
        Row("laptop-contact", "`laptop-fast` fine-tuned with images of the undeformed tip", "fast", last, "laptop-fast")
    )
    drawn = replace(laptop.settings, epochs=_DRAWN_EPOCHS[task], **_DRAWN_TRAINING)
    wide = Recipe(replace(recipe_named("laptop", task, WIDE_PX).network, batch_size=64), drawn)
    what = f"recipe `laptop` on images of {WIDE_PX} px, on contacts that the learned tip draws anew at every epoch"
    out.append(Row("laptop-256px", what, "256px", wide))
    wide_noisy = Recipe(wide.network, replace(laptop.settings, **_NOISE_TRAINING))
    what = "`laptop-256px` fine-tuned with images of a noisy camera, light contacts among them"
    out.append(Row("laptop-256px-noise", what, "256px", wide_noisy, "laptop-256px"))
    known = "any materials, any camera"
    many = Recipe(replace(laptop.network, batch_size=64), replace(drawn, epochs=_MORE_PINS_EPOCHS, **_ANY_TRAINING))
    out.append(Row("laptop-331", f"recipe `laptop` on drawn contacts of `{MORE_PINS_DESIGN}`, {known}", "331", many))
    rates = {"learning_rate": 1e-3, "muon_learning_rate": 0.01}
    same = Recipe(many.network, replace(many.settings, epochs=_ANY_EPOCHS, **rates))
    out.append(Row("laptop-any", f"`{start}` fine-tuned on drawn contacts, {known}", "any", same, start))
    if task == "edge":
        out.append(_any_yaw(same, f"{task}-any-{DESIGN}", known))
    what = f"`{start}` fine-tuned on a million contacts that the learned tip draws, on a GPU"
    long = Recipe(replace(laptop.network, batch_size=256), replace(laptop.settings, **_LONG_TRAINING))
    out.append(Row("laptop-long", what, "drawn", long, start))
    noisy = Recipe(replace(laptop.network, batch_size=64), replace(laptop.settings, **_NOISE_TRAINING))
    out.append(Row("laptop-noise", "`laptop-long` fine-tuned with images of a noisy camera", "drawn", noisy, "laptop-long"))
    how = "light contacts among the drawn ones" if task == "surface" else "for longer"
    light = Recipe(noisy.network, replace(noisy.settings, epochs=_LIGHT_EPOCHS[task]))
    out.append(Row("laptop-light", f"`{start}` fine-tuned in the same way, {how}", "drawn", light, start))
    out += [_weighted(Recipe(noisy.network, drawn), beta) for beta in BETAS]
    settings = replace(laptop.settings, **_SLIDE_TRAINING | {"epochs": _SLIDE_EPOCHS[task]})
    where = "on curved surfaces, " if task == "surface" else ""
    what = f"`laptop-noise` fine-tuned on slides {where}which the learned tip draws anew every second epoch"
    slides = Recipe(replace(laptop.network, batch_size=64), settings)
    out.append(Row("laptop-slides", what, "slides", slides, "laptop-noise"))
    if task == "surface":
        wide_slides = Recipe(wide.network, settings)
        what = "`laptop-256px` fine-tuned on such slides, with images of a noisy camera"
        out.append(Row("laptop-256px-slides", what, "256px-slides", wide_slides, "laptop-256px"))
    return out


def _weighted(recipe: Recipe, beta: float) -> Row:
    """Return a training with another exponent of the weighted likelihood."""
    settings = replace(recipe.settings, epochs=_BETA_EPOCHS, beta=beta)
    what = f"recipe `laptop` on drawn contacts, likelihood weighted by the variance to the power of {beta:g}"
    return Row(f"laptop-beta-{beta:g}", what, "drawn", replace(recipe, settings=settings))


def _any_yaw(recipe: Recipe, start: str, known: str) -> Row:
    """Return the training on edges that are met from every side."""
    longer = replace(recipe, settings=replace(recipe.settings, epochs=_ANY_YAW_EPOCHS))
    return Row(
        "laptop-any-yaw", f"`{start}` fine-tuned on drawn contacts at yaws all round, {known}", "any-yaw", longer, start
    )


def run(options: LearningOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Measure a task, write learning.json, learning.md and learning.png, and return the results of this task.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    lookup("task", options.task, dict.fromkeys(PAPER))
    if not 1 <= options.contacts <= options.large_contacts:
        raise TactipError(
            f"--contacts must be between 1 and --large-contacts, {options.large_contacts}, got {options.contacts}"
        )
    chosen = {row.name: row for row in rows(options.task, options.paper)}
    order = list(chosen)
    if options.only:
        chosen = {name: lookup("row", name, chosen) for name in options.only}
    make(jobs(options, {row.kind for row in chosen.values()}), worker_count(options.workers), log)
    sets = Sets(options)
    record = {"test_contacts": options.test_contacts, "rows": _other_rows(options)}
    for row in chosen.values():
        folder = options.runs / options.task / row.name
        log(f"{row.name}: {row.what}")
        training, validation = sets.training(row.kind)
        earlier = options.runs / options.task / row.init_from
        initial = load_network(earlier if row.init_from in order else row.init_from) if row.init_from else None
        history = train(training, validation, row.recipe.network, row.recipe.settings, folder, log=log, init_from=initial)
        model = load_model(folder)
        figures = {name: evaluate(model, samples).figures for name, samples in sets.tests(row.kind).items()}
        measured = {
            "name": row.name,
            "what": row.what,
            "set": row.kind,
            "version": version("tactip-twin"),
            "machine": machine(),
            "images": len(training),
            "epochs": len(history),
            "seconds": sum(h["seconds"] for h in history),
            "parameters": figures["sheared"]["parameters"],
            "latency_ms": figures["sheared"]["latency_ms"],
            "mae": {name: f["mae"] for name, f in figures.items()},
            # The paper's networks estimate no deviations.
            "nll": figures["sheared"].get("nll", {}),
            "reliability": figures["sheared"].get("reliability", []),
        }
        others = [r for r in record["rows"] if r["name"] != row.name and r["name"] in order]
        record["rows"] = sorted([*others, measured], key=lambda r: order.index(r["name"]))
        _write(options, record)
    return record


def _other_rows(options: LearningOptions) -> list[dict[str, Any]]:
    """Return the rows of learning.json that this version measured on as many test contacts."""
    record = read_results(options.out / "learning.json").get(options.task, {})
    if record.get("test_contacts") != options.test_contacts:
        return []
    return [row for row in record["rows"] if row["version"] == version("tactip-twin")]


def _write(options: LearningOptions, record: dict[str, Any]) -> None:
    """Put the results of a task into learning.json, and write page and figure."""
    whole = read_results(options.out / "learning.json") | {options.task: record}
    whole = {task: _known(task, whole[task]) for task in TASKS if task in whole}
    write_results("learning", whole, tables(whole), options.out)
    plot(whole, options.out / "learning.png")


def _known(task: Task, record: dict[str, Any]) -> dict[str, Any]:
    """Return the results of a task without rows that this version does not have."""
    names = {row.name for row in rows(task, True)}
    return record | {"rows": [row for row in record["rows"] if row["name"] in names]}


def tables(whole: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/learning.md from learning.json."""
    networks = {task: _networks(task, whole[task]["rows"]) if task in whole else "Not measured." for task in TASKS}
    out: dict[str, str] = {**networks}
    texts = []
    for heading, (trained, tested) in CROSS_TESTS.items():
        found = [_cross_test(task, whole[task]["rows"], trained, tested) for task in PAPER if task in whole]
        texts += [f"## {heading}", *(text for text in found if text)] if any(found) else []
    out["cross-tests"] = "\n\n".join(texts)
    betas = [_betas(task, whole[task]["rows"]) for task in PAPER if task in whole]
    noises = [_noises(task, whole[task]["rows"]) for task in PAPER if task in whole]
    out["noise"] = "\n\n".join(text for text in noises if text) or "Not measured in this version."
    out["beta"] = "\n\n".join(text for text in betas if text) or "Not measured in this version."
    return out


def _betas(task: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of networks by the exponent of the weighted likelihood; empty if none was measured."""
    names, chosen = list(PAPER[task]), [row for row in rows if row["name"].startswith("laptop-beta-")]
    if not chosen:
        return ""
    lines = []
    for row in chosen:
        coverage = {r["level"]: np.mean([r["coverage"][name] for name in names]) for r in row["reliability"]}
        errors = [f"{row['mae']['sheared'][name]:.3f}" for name in names]
        nll = f"{np.mean([row['nll'][name] for name in names]):.3f}"
        lines.append([row["name"].removeprefix("laptop-beta-"), *errors, nll, *(f"{coverage[p]:.0%}" for p in (0.68, 0.95))])
    head = [f"β, {task}", *names, "negative log likelihood", "inside 68 %", "inside 95 %"]
    return table(head, lines)


def _noises(task: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of errors by the noise of frames, with components separated by spaces; empty if none was measured."""
    names, tests = list(PAPER[task]), ["sheared", *(NOISY.format(grey) for grey in NOISES_GREY)]
    lines = [
        [f"`{row['name']}`", *(" ".join(f"{row['mae'][test][name]:.2f}" for name in names) for test in tests)]
        for row in rows
        if not row["name"].startswith("laptop-beta-") and set(tests) <= set(row["mae"])
    ]
    head = [f"{task}: {', '.join(names)}", "no noise", *(f"{grey:g} grey levels" for grey in NOISES_GREY)]
    return table(head, lines) if lines else ""


def _drawn(settings: TrainSettings, epochs: int) -> int:
    """Return the number of contacts that a training has drawn anew over its epochs."""
    return settings.drawn_contacts * -(-epochs // settings.drawn_epochs)


def _networks(task: Task, measured: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of networks."""
    names, machines = list(PAPER[task]), dict.fromkeys(machine_text(row["machine"]) for row in measured)
    head = ["network", "images seen", "epochs", "minutes", "parameters", "ms per image", *names]
    settings = {row.name: row.recipe.settings for row in rows(task, True)}
    lines = [["*the paper, real sensor*", 2000, "", "", "", "", *(f"{PAPER[task][n]:g}" for n in names)]]
    lines += [["*target*", "", "", "", "", 5, *(f"{TARGETS[task][n]:g}" for n in names)]]
    for row in measured:
        images = row["images"] + _drawn(settings[row["name"]], row["epochs"])
        cells = [f"`{row['name']}`: {row['what']}", images, row["epochs"], f"{row['seconds'] / 60:.0f}"]
        cells += [row["parameters"], f"{row['latency_ms']:.2f}"]
        lines.append([*cells, *(f"{row['mae']['sheared'][n]:.3f}" for n in names)])
    return "\n".join([table(head, lines), "", *(f"Machine: {text}." for text in machines)])


def _cross_test(task: str, rows: Sequence[Mapping[str, Any]], trained: Sequence[str], tested: Sequence[str]) -> str:
    """Return a table of errors by training and test contacts; empty if a row is missing."""
    names, by_name = list(PAPER[task]), {row["name"]: row for row in rows}
    if not all(name in by_name and set(tested) <= set(by_name[name]["mae"]) for name in trained):
        return ""
    cells = [
        [
            f"{task} contacts, {_KINDS[kind]} (`{name}`)",
            _KINDS[test],
            *(f"{by_name[name]['mae'][test][n]:.3f}" for n in names),
        ]
        for name, kind in zip(trained, tested, strict=True)
        for test in tested
    ]
    return table(["trained on", "tested on", *names], cells)


def relative_error(row: Mapping[str, Any], task: str) -> float:
    """Return a row's mean error over its target, averaged over components."""
    return float(np.mean([row["mae"]["sheared"][n] / TARGETS[task][n] for n in TARGETS[task]]))


def plot(whole: Mapping[str, Any], path: Path) -> None:
    """Plot error against latency of the networks, one panel per task, into a PNG file."""
    figure, axes = figure_of(1, len(whole), (6 * len(whole), 5.5))
    kinds = ("plain", "taps", "symmetric", "large", "slides", "snapshots", "fast", *WIDE_KINDS, *ANY_DESIGNS, "drawn")
    colors = dict(zip(kinds, (*COLORS, "0.5", "0.7", "0.8", "0.2", "0.3", "0.4"), strict=True))
    box = {"fc": "white", "ec": "none", "pad": 0.5}
    for axis, (task, record) in zip(axes, whole.items(), strict=True):
        rows = [row for row in record["rows"] if not row["name"].startswith("laptop-beta-")]
        # Equal networks take the same time; differences in their measured times come from other work on the machine.
        fastest = {row["parameters"] // 10_000: row["latency_ms"] for row in sorted(rows, key=lambda r: -r["latency_ms"])}
        for k, row in enumerate(sorted(rows, key=lambda r: relative_error(r, task))):
            x, y = fastest[row["parameters"] // 10_000], relative_error(row, task)
            axis.plot(x, y, "o", color=colors[row["set"]])
            # Names beside each other: networks that take as long err alike.
            side, where = (7, "left") if k % 2 else (-7, "right")
            axis.annotate(
                row["name"],
                (x, y),
                xytext=(side, 0),
                textcoords="offset points",
                va="center",
                ha=where,
                fontsize=8,
                bbox=box,
                zorder=3,
            )
        axis.axhline(1, color="0.4", lw=0.8)
        for name in "xy":
            log_axis(axis, name)
        axis.margins(0.15)
        (low, high), (fast, slow) = axis.get_ylim(), axis.get_xlim()
        axis.set(ylim=(min(low, 0.7), max(high, 2)), xlim=(min(fast, 1), max(slow, 10)))
        axis.set(xlabel="time per image on one core, ms", ylabel="mean error / target", title=task)
    save_figure(figure, path)
