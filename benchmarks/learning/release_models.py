"""Release of networks of `tactip bench learning`: copied into assets/models, each with its evaluation and its card.

`tactip bench release-models --task surface` releases one network. With --again, the released network is evaluated again, on
test contacts of the tip as it is fitted now.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning import BARS, DESIGN, PAPER, jobs, rows
from tactip_twin.benchmarks.options import LearningOptions, ReleaseModelsOptions
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.evaluate import evaluate, tables
from tactip_twin.learning.model import DESCRIPTION, WEIGHTS, Model, load_model, load_network, net_sha256
from tactip_twin.sim.dataset.format import labels_sha256
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

MAX_BYTES = 5_000_000
"""Size that the weights of a released network must stay below, bytes."""

_COUNT_OPTIONS = {"laptop-most": "most", "laptop-further": "most", "laptop-bent": "bent"}
"""Option of `tactip bench learning` for the number of contacts of a row, where it is not `contacts`."""

EVALUATION, CARD = "evaluation.json", "card.md"


def run(options: ReleaseModelsOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Release a network, log its folder, and return its evaluation. Raises TactipError."""
    folder, evaluation = release_model(options, log)
    log(f"{folder} written")
    return evaluation


def release_model(options: ReleaseModelsOptions, log: Callable[[str], None] = print) -> tuple[Path, dict[str, Any]]:
    """Copy a network, evaluate it on the test set and write its card; return its folder and its evaluation.

    Raises:
        TactipError: There is no such network, it is too large, or its training is unfinished.
    """
    source = options.runs / options.task / options.name
    if options.again:
        source = options.out / f"{options.task}-{'bent-' if options.name == 'laptop-bent' else ''}{DESIGN}"
    size = (source / WEIGHTS).stat().st_size if (source / WEIGHTS).exists() else 0
    model = load_model(source)
    if size >= MAX_BYTES:
        raise TactipError(f"the weights in {source} have {size} bytes: a network is shipped with fewer than {MAX_BYTES}")
    if not model.provenance["outcome"]["finished"]:
        raise TactipError(f"the training in {source} is unfinished: let it come to its end before it is shipped")
    where = options.data / ("bent" if _is_curved(model) else "plain") / options.task / "test"
    if options.again:
        sets = jobs(LearningOptions(task=options.task, data=options.data, judged=options.judged), ())
        make([job for job in sets if job.folder == where], worker_count(options.workers), log)
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
            shutil.copyfile(source / name, folder / name)
    write_file(folder / EVALUATION, (json.dumps(record, indent=1) + "\n").encode())
    write_file(folder / CARD, card(model, record, options).encode())
    return folder, record


def _is_curved(model: Model) -> bool:
    """Return whether a model was trained on curved surfaces: its set has a curvature (sim/dataset/configuration.py)."""
    return any(model.provenance["train"]["configuration"].get("curvature_per_m", ()))  # 0.3.0 left it out for flat sets


def _name(model: Model) -> str:
    """Return the name of a released model."""
    return f"{model.labels.task}-{'bent-' if _is_curved(model) else ''}{DESIGN}"


def _initial_weights(model: Model, options: ReleaseModelsOptions) -> list[str]:
    """Return a line on the initial weights of a training; none if they were random."""
    if "initial_weights" not in model.provenance:
        return []
    (start,) = (row.init_from for row in rows(options.task, False) if row.name == options.name)
    same = net_sha256(load_network(start).net) == model.provenance["initial_weights"]
    its = "" if same else " as an earlier version shipped it"
    return [f"- Begun from the weights of `{start}`{its} (checksum {model.provenance['initial_weights'][:16]})."]


def card(model: Model, record: Mapping[str, Any], options: ReleaseModelsOptions) -> str:
    """Return the Markdown of a network's card, from its evaluation."""
    task, p = model.labels.task, model.provenance
    data, network, settings = p["train"], p["network"], p["settings"]
    made = data["configuration"]
    # Of all of a set, what was asked for: a contact that could not be trusted may be missing among the samples.
    samples = made["samples"] if data.get("chosen") is None else data["samples"]
    contacts = samples // (len(SYMMETRIES[task]) if made["augment_symmetry"] else 1)
    missing = data["samples"] < samples
    ran, asked = p["outcome"]["epochs"], settings["epochs"]
    longer = f", since {asked} would be fewer than {settings['min_steps']} steps" if ran > asked else ""
    what = {"surface": "a flat surface", "edge": "a straight edge"}[task]
    if _is_curved(model):
        what = "a surface bent by {:g} to {:g} /m, two ways{},".format(
            *made["curvature_per_m"], " and half of the time unevenly" if made.get("varying_curvature_fraction") else ""
        )
    # What the paper reached and what is asked is of flat surfaces.
    beside = () if _is_curved(model) else (("the paper, real sensor", PAPER), ("what we ask", BARS))
    count = _COUNT_OPTIONS.get(options.name, "contacts")
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
        *_initial_weights(model, options),
        f"- Network: {json.dumps(network)}",
        f"- Training: {json.dumps(settings)}; best epoch {p['outcome']['best_epoch']} of {p['outcome']['epochs']}"
        f"{longer}; torch {p['torch']}",
        "",
        "To make it again:",
        "",
        "```",
        f"tactip bench learning --task {task} --{count} {contacts} --only {options.name}",
        f"tactip bench release-models --task {task} --name {options.name}",
        "```",
    ]
    return "\n".join(lines) + "\n"
