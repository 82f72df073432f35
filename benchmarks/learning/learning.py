"""Benefit of each step of training, of shear and curvature in the training set, and error against run time of networks.

`tactip bench learning --task surface` makes missing data sets, trains, evaluates on held-out test contacts, and writes
learning.json, learning.md and learning.png. Rerun it after an interruption to resume. It takes hours on two cores; a GPU is
used if there is one.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.options import LearningOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.configuration import Recipe
from tactip_twin.learning.data import Samples, read_samples, read_splits
from tactip_twin.learning.evaluate import evaluate
from tactip_twin.learning.model import load_model, load_network
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges, Split
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.labels import Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

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

_DRAWN_SET = 500
"""Number of contacts of the set that names the ranges of drawn ones."""

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
    "epochs": 8,
    "min_steps": 0,
    "learning_rate": 7e-4,
    "muon_learning_rate": 0.007,
    "optics_ranges": "lens-salt",
    "augmented_fraction": 0.5,
    "drawn_contacts": 16384,
}
"""The training after it, with images of a noisy camera [?]."""

WIDE_PX = 256
"""Width of the images of the row `laptop-256px`, whose pins are known to half the noise of 128 px (docs/uncertainty.md)."""

_ANY_TRAINING = {"augmented_fraction": 0.6, "augmentation_strength": 1.0, "optics_ranges": "real"}
"""Settings of networks that know any materials and cameras, as in a transfer [?]."""

_MORE_PINS_EPOCHS, _ANY_EPOCHS = 60, 16
"""Numbers of epochs of such networks: from random weights, on a GPU, and from a shipped network [?]."""

NOISES_GREY = (5, 15, 30)
"""Standard deviations of the noise of frames that networks are tested with, grey levels of 255."""

BETAS = (0.0, 0.5, 1.0)
"""Exponents of the weighted likelihood that are compared; recipes have the middle one."""

_BETA_EPOCHS = 10
"""Number of epochs of these trainings on drawn contacts [?]."""

_CURVED_EPOCHS = 4
"""Number of epochs on curved surfaces [?]."""

CURVED_SNAPSHOTS = 15
"""Number of images per contact on curved surfaces. The learned tip predicts the slides between them, as in a servo run; the
first contact is mostly simulated and takes seconds."""

_FAST_SEED, _FAST_VAL_SEED, _LIGHT_SEED = 11, 12, 13
"""Seeds of predicted contacts, of their validation contacts, and of the test contacts with light ones. The learned tip was
taught on contacts of seed 0."""

_LIGHT_DEPTH_MM = (-5.0, 0.0)
"""Depths of contacts from none at all: the paper's begin at 1 mm, where a servo has long touched."""

FILTERS = (4, 8, 16)
"""Numbers of filters of the first layer of smaller networks."""

CURVATURES_PER_M = (-28.0, 80.0)
"""Principal curvatures of curved surfaces, 1/m, as on the bust: concave with 36 mm radius to convex with 12.5 mm."""

VARYING_FRACTION = 0.5
"""Fraction of curved surfaces with varying curvature: a network trained without them errs by 2 degrees of tilt near a nose,
and one trained on these alone errs by 0.2 mm of depth on a sphere [M]."""

SNAPSHOTS = 20
"""Number of images per contact of the row `laptop-snapshots`."""

_CURVED_DEPTH_MM = (-5.0, -0.5)
"""Depths of contacts on curved surfaces: shallower ones may miss a surface that bends away."""

CURVED_SHEARS = replace(SHEAR_RANGES, x_mm=(-8.0, 8.0), y_mm=(-8.0, 8.0))
"""Shears on curved surfaces. The paper's are too short for deep contacts to slide, as they always do in servoing."""

DESIGN, FIDELITY = "tactip-127", "standard"

MORE_PINS_DESIGN = "tactip-331"
"""Sensor of the row `laptop-331`."""

ANY_DESIGNS = {"331": MORE_PINS_DESIGN, "any": DESIGN}
"""Sensors by kind of rows (Row.kind) with any materials."""

_DEEP_MM = (-5.5, -0.2)
"""Depths of their contacts: all that the learned tip of any materials knows."""


_OWN_TESTS = {"256px", *ANY_DESIGNS, "drawn"}
"""Kinds of rows (Row.kind) with test sets of their own."""

CROSS_TESTS = {
    "shear": (("laptop-plain", "laptop-taps"), ("sheared", "taps")),
    "curvature": (("laptop", "laptop-curved"), ("sheared", "curved")),
}
"""Tables of networks trained on one kind of contact and tested on another: names of rows and of tests."""

_KINDS = {"sheared": "flat, sheared", "taps": "flat, not sheared", "curved": "curved, sheared"}


@dataclass(frozen=True)
class Row:
    """A training of the benchmark."""

    name: str
    """Name of its row in the tables and of its folder."""
    what: str
    """Description in the tables."""
    kind: str
    """Training set: plain, symmetric, large, fast, snapshots, taps, curved, 256px, 331, any or drawn."""
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
    wide = Recipe(replace(laptop.network, downsample=4, batch_size=64), drawn)
    what = f"recipe `laptop` on images of {WIDE_PX} px, on contacts that the learned tip draws anew at every epoch"
    out.append(Row("laptop-256px", what, "256px", wide))
    known = "any materials, any camera: a start for other tips"
    many = Recipe(replace(laptop.network, batch_size=64), replace(drawn, epochs=_MORE_PINS_EPOCHS, **_ANY_TRAINING))
    out.append(Row("laptop-331", f"recipe `laptop` on drawn contacts of `{MORE_PINS_DESIGN}`, {known}", "331", many))
    rates = {"learning_rate": 1e-3, "muon_learning_rate": 0.01}
    same = Recipe(many.network, replace(many.settings, epochs=_ANY_EPOCHS, **rates))
    out.append(Row("laptop-any", f"`{start}` fine-tuned on drawn contacts, {known}", "any", same, start))
    what = f"`{start}` fine-tuned on a million contacts that the learned tip draws, on a GPU"
    long = Recipe(replace(laptop.network, batch_size=256), replace(laptop.settings, **_LONG_TRAINING))
    out.append(Row("laptop-long", what, "drawn", long, start))
    noisy = Recipe(replace(laptop.network, batch_size=64), replace(laptop.settings, **_NOISE_TRAINING))
    out.append(Row("laptop-noise", "`laptop-long` fine-tuned with images of a noisy camera", "drawn", noisy, "laptop-long"))
    for beta in BETAS:
        weighted = replace(drawn, epochs=_BETA_EPOCHS, beta=beta)
        what = f"recipe `laptop` on drawn contacts, likelihood weighted by the variance to the power of {beta:g}"
        recipe = Recipe(replace(laptop.network, batch_size=64), weighted)
        out.append(Row(f"laptop-beta-{beta:g}", what, "drawn", recipe))
    if task == "surface":
        curved = replace(tuned, settings=replace(tuned.settings, epochs=_CURVED_EPOCHS, min_steps=0))
        out.append(Row("laptop-curved", f"`{start}` fine-tuned on curved surfaces", "curved", curved, start))
        what = "`laptop-curved` fine-tuned with images of the undeformed tip"
        out.append(Row("laptop-curved-contact", what, "curved", last, "laptop-curved"))
    return out


def jobs(options: LearningOptions, kinds: Collection[str]) -> list[Job]:
    """Return the sets that are needed, whether they exist or not: the test sets of rows, and the training and validation
    sets of rows of some kinds (Row.kind). Rows on wide images have a test set of their own."""
    task, still = options.task, Ranges()
    each = len(SYMMETRIES[task])
    usual, light = POSE_RANGES[task], replace(POSE_RANGES[task], depth_mm=_LIGHT_DEPTH_MM)
    wanted: list[_Wanted] = []
    shared = not set(kinds) <= _OWN_TESTS
    if shared:
        wanted += [_Wanted("plain", "test", options.test_contacts, usual, SHEAR_RANGES)]
        wanted += [_Wanted("light", "test", options.other_test_contacts, light, SHEAR_RANGES, _LIGHT_SEED)]
        wanted += [_Wanted("taps", "test", options.other_test_contacts, usual, still)]
    if {"plain", "symmetric", "large"} & set(kinds):
        # The other rows use a part of the set of `laptop-large` if it exists.
        large = "large" in kinds or _holds(options.data / "symmetric" / task / "train", options.large_contacts * each)
        contacts = options.large_contacts if large else options.contacts
        wanted += [_Wanted("symmetric", "train", contacts * each, usual, SHEAR_RANGES)]
    if "fast" in kinds:
        wanted += [_Wanted("fast", "train", options.fast_images, light, SHEAR_RANGES, _FAST_SEED)]
        wanted += [_Wanted("fast", "val", options.test_contacts, light, SHEAR_RANGES, _FAST_VAL_SEED)]
    for kind in ("256px", "drawn"):
        if kind in kinds:
            wanted += [_Wanted(kind, "train", _DRAWN_SET, light, SHEAR_RANGES, _FAST_SEED)]
            wanted += [_Wanted(kind, "val", options.test_contacts, light, SHEAR_RANGES, _FAST_VAL_SEED)]
            wanted += [_Wanted(kind, "test", options.test_contacts, usual, SHEAR_RANGES)]
    for kind in ANY_DESIGNS:
        if kind in kinds:
            deep = replace(usual, depth_mm=_DEEP_MM)
            wanted += [_Wanted(kind, "train", _DRAWN_SET, deep, SHEAR_RANGES, _FAST_SEED)]
            wanted += [_Wanted(kind, "val", options.other_test_contacts, deep, SHEAR_RANGES, _FAST_VAL_SEED)]
            wanted += [_Wanted(kind, "test", options.test_contacts, usual, SHEAR_RANGES)]
    if {"plain", "symmetric", "large", "snapshots"} & set(kinds):
        wanted += [_Wanted("plain", "val", options.test_contacts, usual, SHEAR_RANGES)]
    if "snapshots" in kinds:
        wanted += [_Wanted("snapshots", "train", options.snapshot_contacts * SNAPSHOTS, usual, SHEAR_RANGES)]
    if "taps" in kinds:
        wanted += [_Wanted("taps", "train", options.contacts, usual, still)]
        wanted += [_Wanted("taps", "val", options.other_test_contacts, usual, still)]
    if task == "surface" and shared:
        touching, few = replace(usual, depth_mm=_CURVED_DEPTH_MM), options.curved_test_contacts * CURVED_SNAPSHOTS
        wanted += [_Wanted("curved", "test", few, touching, CURVED_SHEARS)]
        if "curved" in kinds:
            images = options.curved_contacts * CURVED_SNAPSHOTS * each
            wanted += [_Wanted("curved", "train", images, touching, CURVED_SHEARS, _FAST_SEED)]
            wanted += [_Wanted("curved", "val", few, touching, CURVED_SHEARS)]
    return [_job(options, one) for one in wanted]


@dataclass(frozen=True)
class _Wanted:
    """A set of the benchmark."""

    kind: str
    """Kind of contacts (Row.kind, or light)."""
    split: Split
    """Its split."""
    samples: int
    """Number of samples."""
    pose: Ranges
    """Ranges of the poses."""
    shear: Ranges
    """Ranges of the shears."""
    seed: int = 0
    """Seed."""


def _job(options: LearningOptions, wanted: _Wanted) -> Job:
    """Return the set of a task, with the learned tip that predicts its contacts if one does."""
    task, kind, split = options.task, wanted.kind, wanted.split
    augmented = (kind, split) in (("symmetric", "train"), ("fast", "train"), ("curved", "train"))
    tip: Path | None = None
    digest = ""
    if split == "train" and (kind == "fast" or kind in _OWN_TESTS):
        tip = shipped_fast_tip(task, ANY_DESIGNS.get(kind, DESIGN), randomized=kind in ANY_DESIGNS)
        digest = read_fast_tip(tip).digest
    elif (kind, split) == ("curved", "train"):
        tip = shipped_sliding_tip(task, DESIGN)
        digest = read_sliding_tip(tip).digest
    design = load_design(ANY_DESIGNS.get(kind, DESIGN))
    if kind == "256px":
        design = replace(design, image=replace(design.image, size_px=WIDE_PX))
    configuration = Configuration(
        task=task,
        split=split,
        samples=wanted.samples,
        seed=wanted.seed,
        # OpenGL takes longer for eight images than the contact itself. Test sets are rendered by it nevertheless.
        renderer="raster" if augmented or (kind in _OWN_TESTS and split != "test") else "pyrender",
        design=design,
        fidelity=fidelity_named(FIDELITY),
        pose=wanted.pose,
        shear=wanted.shear,
        augment_symmetry=augmented,
        curvature_per_m=CURVATURES_PER_M if kind == "curved" else (0.0, 0.0),
        varying_curvature_fraction=VARYING_FRACTION if kind == "curved" else 0.0,
        snapshots_per_contact={"snapshots": SNAPSHOTS, "curved": CURVED_SNAPSHOTS}.get(kind, 1),
        # The sets of the networks also teach and test the learned tip.
        keep_mesh=kind in ("symmetric", "plain"),
        mechanics_randomization=MECHANICS_RANDOMIZATIONS["real" if kind in ANY_DESIGNS and split != "test" else "none"],
        fast_tip=digest,
    )
    return Job(configuration, options.data / kind / task / split, tip)


def _holds(folder: Path, samples: int) -> bool:
    """Return whether a folder has a finished set of this number of samples."""
    return (folder / "meta.json").exists() and read_meta(folder)["configuration"]["samples"] == samples


class Sets:
    """The sets of a task, read on demand."""

    def __init__(self, options: LearningOptions) -> None:
        self._options, self._each = options, len(SYMMETRIES[options.task])
        self._large: Samples | None = None

    def training(self, kind: str) -> tuple[Samples, Samples]:
        """Return training and validation samples of a kind (Row.kind).

        Raises:
            TactipError: A set is missing or damaged.
        """
        if kind in ("taps", "curved", "fast", *_OWN_TESTS):
            return read_splits(self._folder(kind))
        if kind == "snapshots":
            return read_samples(self._folder(kind) / "train"), read_samples(self._folder("plain") / "val")
        if self._large is None:
            self._large = read_samples(self._folder("symmetric") / "train")
        chosen = {
            # The first sample of a contact is the contact as simulated, before its symmetric copies.
            "plain": slice(0, self._options.contacts * self._each, self._each),
            "symmetric": slice(0, self._options.contacts * self._each),
            "large": slice(None),
        }[kind]
        return self._large.take(chosen), read_samples(self._folder("plain") / "val")

    def tests(self, kind: str) -> dict[str, Samples]:
        """Return test samples by kind of contact, for a row of a kind. Raises TactipError if a set is missing or damaged."""
        if kind in _OWN_TESTS:
            test = read_samples(self._folder(kind) / "test")
            noisy = {_NOISY.format(grey): with_noise(test, grey) for grey in NOISES_GREY} if kind == "drawn" else {}
            return {"sheared": test} | noisy
        kinds = {"sheared": "plain", "light": "light", "taps": "taps"} | (
            {"curved": "curved"} if self._options.task == "surface" else {}
        )
        return {name: read_samples(self._folder(kind) / "test") for name, kind in kinds.items()}

    def _folder(self, kind: str) -> Path:
        return self._options.data / kind / self._options.task


_NOISY = "noise {:g}"
"""Name of the test with noise of a standard deviation."""


def with_noise(samples: Samples, grey: float) -> Samples:
    """Return samples of a simulated set with the images that a camera with normal noise takes, whose standard deviation is in
    grey levels of 255."""
    design = read_configuration(samples.dataset.meta, samples.folder).design
    raster, rng = Raster(design), np.random.default_rng(0)
    tips, directions = (array[samples.rows] for array in read_pins(samples.folder, samples.dataset.meta))
    images = []
    for pins in zip(tips, directions, strict=True):
        frame = raster.render(*pins)
        noisy = np.clip(np.rint(frame + rng.normal(0, grey, frame.shape)), 0, 255).astype(np.uint8)
        images.append(tactile_image(noisy, design.image))
    return replace(samples, images=np.stack(images))


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
    whole = {task: whole[task] for task in PAPER if task in whole}
    write_results("learning", whole, tables(whole), options.out)
    plot(whole, options.out / "learning.png")


def tables(whole: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/learning.md from learning.json."""
    out = {task: _networks(task, whole[task]["rows"]) if task in whole else "Not measured." for task in PAPER}
    for name, (trained, tested) in CROSS_TESTS.items():
        found = [_cross_test(task, whole[task]["rows"], trained, tested) for task in PAPER if task in whole]
        out[name] = "\n\n".join(text for text in found if text) or "Not measured in this version."
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
    names, tests = list(PAPER[task]), ["sheared", *(_NOISY.format(grey) for grey in NOISES_GREY)]
    lines = [
        [f"`{row['name']}`", *(" ".join(f"{row['mae'][test][name]:.2f}" for name in names) for test in tests)]
        for row in rows
        if not row["name"].startswith("laptop-beta-") and set(tests) <= set(row["mae"])
    ]
    head = [f"{task}: {', '.join(names)}", "no noise", *(f"{grey:g} grey levels" for grey in NOISES_GREY)]
    return table(head, lines) if lines else ""


def _networks(task: str, rows: Sequence[Mapping[str, Any]]) -> str:
    names, machines = list(PAPER[task]), dict.fromkeys(machine_text(row["machine"]) for row in rows)
    head = ["network", "images", "epochs", "minutes", "parameters", "ms per image", *names]
    lines = [["*the paper, real sensor*", 2000, "", "", "", "", *(f"{PAPER[task][n]:g}" for n in names)]]
    lines += [["*target*", "", "", "", "", 5, *(f"{TARGETS[task][n]:g}" for n in names)]]
    for row in rows:
        cells = [f"`{row['name']}`: {row['what']}", row["images"], row["epochs"], f"{row['seconds'] / 60:.0f}"]
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
    figure, axes = figure_of(1, len(whole), (6 * len(whole), 4.2))
    kinds = ("plain", "taps", "symmetric", "large", "curved", "snapshots", "fast", "256px", *ANY_DESIGNS, "drawn")
    colors = dict(zip(kinds, (*COLORS, "0.5", "0.7", "0.8", "0.2"), strict=True))
    box = {"fc": "white", "ec": "none", "pad": 0.5}
    for axis, (task, record) in zip(axes, whole.items(), strict=True):
        for row in record["rows"]:
            x, y = row["latency_ms"], relative_error(row, task)
            axis.plot(x, y, "o", color=colors[row["set"]])
            axis.annotate(
                row["name"], (x, y), xytext=(7, 0), textcoords="offset points", va="center", fontsize=8, bbox=box, zorder=3
            )
        axis.axhline(1, color="0.4", lw=0.8)
        for name in "xy":
            log_axis(axis, name)
        axis.margins(0.15)
        (low, high), (fast, slow) = axis.get_ylim(), axis.get_xlim()
        axis.set(ylim=(min(low, 0.5), max(high, 5)), xlim=(min(fast, 1), max(slow, 10)))
        axis.set(xlabel="time per image on one core, ms", ylabel="mean error / target", title=task)
    save_figure(figure, path)
