"""Ships the networks of `tactip bench learning`: copies them into assets/models, each with its evaluation and its card.

tactip bench release-models --task surface

With --again, the network that is there is judged anew, on test contacts of the tip as it is fitted now.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import tyro

from tactip_twin.assets import MODELS
from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning import BARS, DESIGN, PAPER, jobs, rows
from tactip_twin.benchmarks.options import LearningOptions
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.evaluate import evaluate, tables
from tactip_twin.learning.model import DESCRIPTION, WEIGHTS, load_model, load_network, net_sha256
from tactip_twin.sim.dataset.format import labels_sha256
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

MOST_BYTES = 5_000_000
"""Weights of a shipped network are smaller."""

_AS_MANY = {"laptop-most": "most", "laptop-further": "most", "laptop-bent": "bent"}
"""Option of `tactip bench learning` that says how many contacts a row has, where it is not `contacts`."""

EVALUATION, CARD = "evaluation.json", "card.md"


@dataclass(frozen=True)
class Options:
    """Which network is shipped, and where things are."""

    task: str = "surface"
    """surface or edge."""
    name: str = "laptop-most"
    """Row of `tactip bench learning`."""
    data: Path = Path("data/learning")
    """Its folder of sets."""
    runs: Path = Path("runs/learning")
    """Its folder of trainings."""
    out: Path = MODELS
    """Folder of the shipped networks."""
    again: bool = False
    """Judge the network that is shipped, and leave its weights as they are."""
    judged: int = 2000
    """Test contacts that it is judged on, then."""
    workers: str = "auto"
    """Worker processes that make them, then; auto is one a core."""


def ship(options):
    """Copy a network, judge it on the test set, write its card. Returns its folder (Path). Raises TactipError."""
    run = options.runs / options.task / options.name
    if options.again:
        run = options.out / f"{options.task}-{'bent-' if options.name == 'laptop-bent' else ''}{DESIGN}"
    size = (run / WEIGHTS).stat().st_size if (run / WEIGHTS).exists() else 0
    model = load_model(run)
    if size >= MOST_BYTES:
        raise TactipError(f"the weights in {run} have {size} bytes: a network is shipped with fewer than {MOST_BYTES}")
    if not model.provenance["outcome"]["finished"]:
        raise TactipError(f"the training in {run} is unfinished: let it come to its end before it is shipped")
    where = options.data / ("bent" if _bent(model) else "plain") / options.task / "test"
    if options.again:
        sets = jobs(LearningOptions(task=options.task, data=options.data, judged=options.judged), ())
        make([job for job in sets if job.folder == where], worker_count(options.workers), print)
    test = read_samples(where)
    evaluation = evaluate(model, test)
    meta = test.dataset.meta
    record = {
        **evaluation.figures,
        **tables(evaluation, test, model.labels),
        "test": {"digest": meta["digest"], "targets_sha256": labels_sha256(meta)},
        "machine": machine(),
    }
    folder = options.out / _name(model)
    folder.mkdir(parents=True, exist_ok=True)
    if not options.again:
        for name in (WEIGHTS, DESCRIPTION):
            shutil.copyfile(run / name, folder / name)
    write_file(folder / EVALUATION, (json.dumps(record, indent=1) + "\n").encode())
    write_file(folder / CARD, card(model, record, options).encode())
    return folder


def _bent(model):
    """Whether a Model has learned from bent surfaces: its set names their curvature (sim/dataset/format.py)."""
    return "curvature_per_m" in model.provenance["train"]["configuration"]


def _name(model):
    return f"{model.labels.task}-{'bent-' if _bent(model) else ''}{DESIGN}"


def _begun(model, options):
    """A line (list of str) on the network that a training began with, if it did."""
    if "begun_from" not in model.provenance:
        return []
    (start,) = (row.start for row in rows(model.labels.task, False) if row.name == options.name)
    same = net_sha256(load_network(start).net) == model.provenance["begun_from"]
    its = "" if same else " as an earlier version shipped it"
    return [f"- Begun from the weights of `{start}`{its} (checksum {model.provenance['begun_from'][:16]})."]


def card(model, record, options):
    """The Markdown (str) of a network's card. model: Model. record: dict, its evaluation.json. options: Options."""
    task, p = model.labels.task, model.provenance
    data, network, settings = p["train"], p["network"], p["settings"]
    made = data["configuration"]
    # Of all of a set, what was asked for: a contact that could not be trusted may be missing among the samples.
    samples = made["samples"] if data.get("chosen") is None else data["samples"]
    contacts = samples // (len(SYMMETRIES[task]) if made["symmetric"] else 1)
    missing = data["samples"] < samples
    ran, asked = p["outcome"]["epochs"], settings["epochs"]
    longer = f", since {asked} would be fewer than {settings['least_steps']} steps" if ran > asked else ""
    what = {"surface": "a flat surface", "edge": "a straight edge"}[task]
    if _bent(model):
        what = "a surface bent by {:g} to {:g} /m, two ways{},".format(
            *made["curvature_per_m"], " and half of the time unevenly" if made.get("uneven") else ""
        )
    # What the paper reached and what is asked is of flat surfaces.
    beside = () if _bent(model) else (("the paper, real sensor", PAPER), ("what we ask", BARS))
    lines = [
        f"# {_name(model)}",
        "",
        f"Reads the pose of {what} from one binary tactile image, {model.size} px wide, of the 127-pin TacTip "
        f"(`{DESIGN}`), however the skin was sheared within the ranges below. Trained in simulation alone; on a real "
        "sensor expect more than these errors. Frames and signs: sim/pose.py.",
        "",
        "| " + " | ".join(["component", "mean error", "rms", "bias", "95 % below", *(title for title, _ in beside)]) + " |",
        "|" + "---|" * (5 + len(beside)),
    ]
    for name, unit in zip(model.labels.names, model.labels.units, strict=True):
        cells = [f"{record[k][name]:.3f} {unit}" for k in ("mae", "rmse", "bias", "p95")]
        cells += [f"{table[task][name]:g} {unit}" for _, table in beside]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    ranges = ", ".join(
        f"{name} {low:g} to {high:g} {unit}"
        for name, low, high, unit in zip(
            model.labels.names, model.labels.low, model.labels.high, model.labels.units, strict=True
        )
    )
    state = machine_text(record["machine"])
    lines += [
        "",
        f"On {record['samples']} test contacts of which it has seen none; {record['parameters']} parameters; "
        f"{record['latency_ms']:.2f} ms an image, one core ({state}).",
        "",
        f"- Labels: {ranges}. Shear: as `shear` in model.json, provenance.",
        f"- Trained on {data['samples']} images of {contacts} contacts{', but for those that failed' * missing} (fidelity "
        f"`{made['fidelity']['name']}`, seed {made['seed']}, `{made['renderer']}`), configuration {data['digest'][:16]}; "
        f"tested on configuration {record['test']['digest'][:16]}. In full, and with checksums of the tables, in model.json "
        "and evaluation.json.",
        *_begun(model, options),
        f"- Network: {json.dumps(network)}",
        f"- Training: {json.dumps(settings)}; best epoch {p['outcome']['best_epoch']} of {p['outcome']['epochs']}"
        f"{longer}; torch {p['torch']}",
        "",
        "To make it again:",
        "",
        "```",
        f"tactip bench learning --task {task} --{_AS_MANY.get(options.name, 'contacts')} {contacts} --only {options.name}",
        f"tactip bench release-models --task {task} --name {options.name}",
        "```",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(ship(tyro.cli(Options)), "written")
