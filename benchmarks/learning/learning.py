"""What each step of learning buys, what shear in training is worth, and error against run time over networks.

`tactip bench learning --task surface`: makes the sets that it lacks, trains, evaluates on test contacts that none has seen,
and writes docs/learning.md, .json and .png. Stopped, it goes on where it was. Hours on two cores; a GPU is used if there is
one.
"""

import json
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.options import LearningOptions
from tactip_twin.learning.configuration import Recipe
from tactip_twin.learning.data import read_samples, read_splits
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
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.view.plot import pyplot
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
"""What this project asks of itself."""

_FURTHER = {"epochs": 16, "rate": 7e-4, "muon": 0.007}
"""What a training that begins with a network has of its own: half of the rates, and fewer epochs; estimates [?]."""

FILTERS = (4, 8, 16)
"""First filters of the other networks on the curve."""

BENT_PER_M = (-28.0, 80.0)
"""Principal curvatures of bent surfaces, 1/m: as those of the bust: from hollows of 36 mm radius to ridges of 12.5 mm."""

UNEVEN = 0.5
"""Share of them that are bent unevenly: a network of gently bent ones alone felt tilts about a nose wrong by 2 degrees, one
of uneven ones alone the depth on a sphere by 0.2 mm."""

LOOKS = 20
"""Looks at each contact of the row `laptop-looks`."""

BENT_SHEARS = replace(SHEAR_RANGES, x_mm=(-8, 8), y_mm=(-8, 8))
"""Shears on bent surfaces: those of the paper are too short for deep contacts to slide, as in a servo they always do."""

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
"""Tables of what is trained on one kind of contact and tested on another: title, rows and tests by what they are called."""


@dataclass(frozen=True)
class Row:
    """A training and what it is there to show."""

    name: str
    """Of its row in the tables and of its folder."""
    what: str
    """The same in words, for the page."""
    kind: str
    """What it is trained on: plain, symmetric, most, looks, taps or bent."""
    recipe: Recipe
    """Network and training."""
    start: str = ""
    """Shipped network that it begins with."""


def rows(task, paper):
    """The trainings (list of Row) of a task, by steps. paper: bool, with the paper's own network."""
    laptop, papers = recipe_named("laptop", task), recipe_named("paper", task)

    def papers_with(filters):
        return replace(papers, network=replace(papers.network, filters=filters, units=min(papers.network.units, 64)))

    def wide(filters):
        return replace(laptop, network=replace(laptop.network, filters=filters))

    plain, varied = (
        replace(laptop, settings=replace(laptop.settings, **changes)) for changes in ({"drawn": 0.0}, {"optics": 1.0})
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


def jobs(options, kinds):
    """The sets (list of Job) that are needed, made already or not: what all rows are tested on, and what rows of some kinds
    (Row.kind) are trained on."""
    task, still = options.task, Ranges()
    each = len(SYMMETRIES[task])
    wanted = [("plain", "test", options.judged, SHEAR_RANGES)]
    wanted += [("taps", "test", options.judged_taps, still)]
    if {"plain", "symmetric", "most"} & set(kinds):
        # Of a set that is there for the row `most`, the others take as much as they ask for.
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
            # Of eight images a contact, OpenGL's cost more than their contact; what is judged on is drawn by it.
            renderer="raster" if (kind, split) == ("bent", "train") else "pyrender",
            design=load_design(DESIGN),
            fidelity=fidelity_named(FIDELITY),
            pose=POSE_RANGES[task],
            shear=shear,
            symmetric=kind == "symmetric" or (kind, split) == ("bent", "train"),
            curvature_per_m=BENT_PER_M if kind == "bent" else (0.0, 0.0),
            uneven=UNEVEN if kind == "bent" else 0.0,
            looks=LOOKS if kind == "looks" else 1,
        )
        out.append(Job(configuration, options.data / kind / task / split))
    return out


def _holds(folder, samples):
    """Whether a folder (Path) holds a finished set of so many samples (bool)."""
    return (folder / "meta.json").exists() and read_meta(folder)["configuration"]["samples"] == samples


class Sets:
    """The sets of a task, read as they are asked for."""

    def __init__(self, options):
        """options: LearningOptions."""
        self._options, self._each = options, len(SYMMETRIES[options.task])
        self._most = None

    def training(self, kind):
        """Training and validation Samples of a kind (Row.kind). Raises TactipError where one is missing or damaged."""
        if kind in ("taps", "bent"):
            return read_splits(self._folder(kind))
        if kind == "looks":
            return read_samples(self._folder(kind) / "train"), read_samples(self._folder("plain") / "val")
        if self._most is None:
            self._most = read_samples(self._folder("symmetric") / "train")
        chosen = {
            # The first of a contact's samples is the contact as it was played, in the place of the others.
            "plain": slice(0, self._options.contacts * self._each, self._each),
            "symmetric": slice(0, self._options.contacts * self._each),
            "most": slice(None),
        }[kind]
        return self._most.take(chosen), read_samples(self._folder("plain") / "val")

    def tests(self):
        """Test Samples (dict) by kind of contact. Raises TactipError where one is missing or damaged."""
        kinds = {"sheared": "plain", "taps": "taps"} | ({"bent": "bent"} if self._options.task == "surface" else {})
        return {name: read_samples(self._folder(kind) / "test") for name, kind in kinds.items()}

    def _folder(self, kind):
        return self._options.data / kind / self._options.task


def run(options, say=print):
    """Measure a task; returns its record (dict). say: called with lines for the user.

    Raises TactipError, and Interrupted at Ctrl-C.
    """
    lookup("task", options.task, dict.fromkeys(PAPER))
    if not 1 <= options.contacts <= options.most:
        raise TactipError(f"--contacts is {options.contacts}: it must be 1 to --most, {options.most}")
    chosen = {row.name: row for row in rows(options.task, options.paper)}
    order = list(chosen)
    if options.only:
        chosen = {name: lookup("row", name, chosen) for name in options.only}
    make(jobs(options, {row.kind for row in chosen.values()}), worker_count(options.workers), say)
    sets = Sets(options)
    tests = sets.tests()
    counts = {name: getattr(options, name) for name in ("contacts", "most", "judged", "judged_taps")}
    record = {**counts, "rows": _kept(options, counts)}
    for row in chosen.values():
        folder = options.runs / options.task / row.name
        say(f"{row.name}: {row.what}")
        training, validation = sets.training(row.kind)
        start = load_network(row.start) if row.start else None
        history = train(training, validation, row.recipe.network, row.recipe.settings, folder, say=say, start=start)
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


def _own_count(options, kind):
    """Contacts (dict, of `contacts`) of a kind of set (Row.kind) that has a number of its own; empty for the others."""
    own = {"bent": "bent", "looks": "looked"}
    return {"contacts": getattr(options, own[kind])} if kind in own else {}


def _kept(options, counts):
    """The rows (list of dict) of learning.json that were measured on as many contacts, each with its machine."""
    path = options.out / "learning.json"
    before = json.loads(path.read_text()).get(options.task, {}) if path.exists() else {}
    if {name: before.get(name) for name in counts} != counts:
        return []
    kept = []
    for row in before["rows"]:
        # Rows of before do not say their own count: they are taken for those of what is made where nothing is asked for.
        told = {name: row.get(name, own) for name, own in _own_count(LearningOptions(), row["set"]).items()}
        if told == _own_count(options, row["set"]):
            kept.append({**row, "machine": _machine(row, before)})
    return kept


def _machine(row, record):
    """The machine (dict of str) of a row. Rows of before do not say it: the record does for all."""
    return row["machine"] if "machine" in row else record["machine"]


def _write(options, record):
    """Put a task's record into learning.json, and write page and figure anew."""
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "learning.json"
    whole = json.loads(path.read_text()) if path.exists() else {}
    whole[options.task] = record
    whole = {task: whole[task] for task in PAPER if task in whole}
    write_file(path, (json.dumps(whole, indent=1) + "\n").encode())
    write_file(options.out / "learning.md", page(whole).encode())
    draw(whole, options.out / "learning.png")


def page(whole):
    """The Markdown (str) of learning.json."""
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
        by_machine = {}
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
                for name, told in trained.items():
                    for kind, what in tested.items():
                        cells = " | ".join(f"{by_name[name]['mae'][kind][n]:.3f}" for n in names)
                        lines.append(f"| {told} | {what} | {cells} |")
    return "\n".join(lines) + "\n"


def relative(row, task):
    """A row's mean error over what is asked, averaged over components (float)."""
    return float(np.mean([row["mae"]["sheared"][n] / BARS[task][n] for n in BARS[task]]))


def draw(whole, path):
    """Error against latency of the networks, a panel a task. path: Path, .png."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(whole), figsize=(6 * len(whole), 4.2), squeeze=False)
    for axis, (task, record) in zip(axes[0], whole.items(), strict=True):
        for row in record["rows"]:
            x, y = row["latency_ms"], relative(row, task)
            axis.plot(x, y, "o", color={"symmetric": "C0", "most": "C3", "bent": "C2"}.get(row["set"], "0.6"))
            axis.annotate(row["name"], (x, y), xytext=(4, 4), textcoords="offset points", fontsize=8)
        axis.axhline(1, color="C3", lw=0.8)
        axis.set(xscale="log", yscale="log", xlabel="ms an image, one core", ylabel="error over what is asked", title=task)
    figure.tight_layout()
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
