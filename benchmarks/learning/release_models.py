"""Release of networks of `tactip bench learning`: copied into assets/models, each with its evaluation and its card.

`tactip bench release-models --task surface` releases one network. With
--evaluate-only, the released network is evaluated again on test contacts of the current tip, and keeps its weights.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning.learning import PAPER, TARGETS, rows
from tactip_twin.benchmarks.learning.learning_sets import DESIGN, MORE_PINS_DESIGN, WIDE_PX, jobs
from tactip_twin.benchmarks.learning.options import LearningOptions, ReleaseModelsOptions
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.evaluate import evaluate, tables
from tactip_twin.learning.evaluation_page import force_table
from tactip_twin.learning.model import DESCRIPTION, WEIGHTS, Model, load_model, load_network, net_sha256
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.sim.dataset.configuration import samples_per_contact
from tactip_twin.sim.dataset.format import labels_sha256
from tactip_twin.sim.dataset.generate import make
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

MAX_BYTES = 5_000_000
"""Size that the weights of a released network must stay below, bytes."""

_COUNT_OPTIONS = {
    "laptop-large": "large_contacts",
    "laptop-fine-tuned": "large_contacts",
    "laptop-fast": "fast_images",
    "laptop-contact": "fast_images",
}
"""Option of `tactip bench learning` for the number of contacts of a row, if it is not `contacts`."""

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
    source = options.runs / options.task / options.row
    if options.evaluate_only:
        kinds = {
            "laptop-256px": "256px-",
            "laptop-any": "any-",
            "laptop-any-yaw": "any-yaw-",
            "laptop-256px-slides": "curved-256px-",
        }
        kind = kinds.get(options.row, "curved-" if (options.row, options.task) == ("laptop-slides", "surface") else "")
        source = options.out / f"{options.task}-{kind}{MORE_PINS_DESIGN if options.row == 'laptop-331' else DESIGN}"
    size = (source / WEIGHTS).stat().st_size if (source / WEIGHTS).exists() else 0
    model = load_model(source)
    if size >= MAX_BYTES:
        raise TactipError(f"the weights in {source} have {size} bytes: a shipped network must have fewer than {MAX_BYTES}")
    if not model.provenance["outcome"]["finished"]:
        raise TactipError(f"the training in {source} is unfinished: rerun it to the end before shipping the network")
    kind = "331" if _design(model) == MORE_PINS_DESIGN else _kind(model).removesuffix("-") or "plain"
    kind = {"curved": "slides", "curved-256px": "256px-slides"}.get(kind, kind)
    where = options.data / kind / options.task / "test"
    if options.evaluate_only or not where.exists():
        chosen = LearningOptions(task=options.task, data=options.data, test_contacts=options.test_contacts)
        make([job for job in jobs(chosen, (kind,)) if job.folder == where], worker_count(options.workers), log)
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
    if not options.evaluate_only:
        for name in (WEIGHTS, DESCRIPTION):
            shutil.copyfile(source / name, folder / name)
    write_file(folder / EVALUATION, (json.dumps(record, indent=1) + "\n").encode())
    write_file(folder / CARD, card(model, record, options).encode())
    return folder, record


def _design(model: Model) -> str:
    """Return the name of the sensor that a model was trained for."""
    return model.provenance["train"]["configuration"]["design"]["name"]


def _is_of_any_materials(model: Model) -> bool:
    """Return whether a model was trained on contacts whose mechanics vary."""
    return any(f != 1 for f in model.provenance["train"]["configuration"].get("mechanics_randomization", {}).values())


def _is_curved(model: Model) -> bool:
    """Return whether a model was trained on curved surfaces: its set has a curvature (sim/dataset/configuration.py)."""
    return any(model.provenance["train"]["configuration"].get("curvature_per_m", ()))  # 0.3.0 left it out for flat sets


def _name(model: Model) -> str:
    """Return the name of a released model."""
    return f"{model.labels.task}-{_kind(model)}{_design(model)}"


def _kind(model: Model) -> str:
    """Return what the name of a released model has between task and design."""
    curved, wide = ("curved-" if _is_curved(model) else ""), (f"{WIDE_PX}px-" if model.size == WIDE_PX else "")
    if curved or wide or not _is_of_any_materials(model) or _design(model) != DESIGN:
        return curved + wide
    return "any-" if model.labels.circular is None else "any-yaw-"


def _initial_weights(model: Model, options: ReleaseModelsOptions) -> list[str]:
    """Return a line on the initial weights of a training; none if they were random."""
    if "initial_weights" not in model.provenance:
        return []
    table = {row.name: row for row in rows(options.task, False)}
    start = table[options.row].init_from
    source = options.runs / options.task / start if start in table else start
    same = net_sha256(load_network(source).net) == model.provenance["initial_weights"]
    its = "" if same else " of an earlier version"
    return [f"- Initial weights: `{start}`{its} (checksum {model.provenance['initial_weights'][:16]})."]


def _drawn(provenance: Mapping[str, Any]) -> list[str]:
    """Return a line on contacts that were drawn in the training; none if none were."""
    count = provenance["settings"].get("drawn_contacts", 0)
    if not count:
        return []
    epochs = provenance["settings"].get("drawn_epochs", 1)
    every = "at every epoch" if epochs == 1 else f"every {epochs} epochs"
    tips = [digest[:16] for digest in provenance["fast_tip"].split("+")]
    those = f"the learned tip{'s' if len(tips) > 1 else ''} {' and '.join(tips)} draw{'s' if len(tips) == 1 else ''} anew"
    return [f"- Beside these, {every} {count} contacts that {those}."]


def _earlier_rows(options: ReleaseModelsOptions) -> list[str]:
    """Return the rows that the released one starts from, the first one first, back to one that starts from a shipped network
    or from random weights."""
    table = {row.name: row for row in rows(options.task, False)}
    chain, start = [], table[options.row].init_from
    while start in table:
        chain.insert(0, start)
        start = table[start].init_from
    return chain


def _by_force(record: Mapping[str, Any], units: Mapping[str, str]) -> list[str]:
    """Return the lines on errors by force and on other quantities; none if the network has no deviations."""
    if "by_force" not in record:
        return []
    lines = [
        "",
        "A light touch does not determine the pose, and the deviations say so. Mean errors by normal force, and the",
    ]
    lines[-1] += " labels inside of the 68 % and 95 % intervals:"
    lines += ["", *force_table(record["by_force"], units)]
    found = {q.name: f"{record['quantities'][q.name]:.3f} {q.unit}".strip() for q in QUANTITIES}
    return [*lines, "", "Mean errors beside the pose: " + ", ".join(f"{k} {v}" for k, v in found.items()) + "."]


def card(model: Model, record: Mapping[str, Any], options: ReleaseModelsOptions) -> str:
    """Return the Markdown of a network's card, from its evaluation."""
    task, p, labels = model.labels.task, model.provenance, model.labels
    data, settings, outcome = p["train"], p["settings"], p["outcome"]
    made = data["configuration"]
    # The number asked for: a few contacts of a set may have failed its checks.
    samples = made["samples"] if data.get("chosen") is None else data["samples"]
    contacts = samples // samples_per_contact(made)
    failed = f" ({samples - data['samples']} failed checks)" if data["samples"] < samples else ""
    what = {"surface": "a flat surface", "edge": "a straight edge"}[task]
    if _is_curved(model):
        varying = " (varying on half of them)" if made.get("varying_curvature_fraction") else ""
        what = "surfaces with curvatures of {:g} to {:g} /m{}".format(*made["curvature_per_m"], varying)
    known = "It knows tips of other materials and cameras, too. " if _is_of_any_materials(model) else ""
    # The paper's results and the targets are for flat surfaces, and for straight edges at yaws of -45 to 45 degrees.
    beside = {} if _is_curved(model) or labels.circular is not None else {"the paper, real sensor": PAPER, "target": TARGETS}
    lines = [
        f"# {_name(model)}",
        "",
        f"This network predicts the pose of {what} from one binary tactile image, {model.size} px wide, of the "
        f"{_design(model).removeprefix('tactip-')}-pin TacTip (`{_design(model)}`), and is insensitive to shear. It was "
        f"trained in simulation only; expect larger errors on a real sensor. {known}`sim/pose.py` defines frames and signs.",
        "",
        "| component | trained range | mean error | rms | bias | 95 % below |" + "".join(f" {title} |" for title in beside),
        "|" + "---|" * (6 + len(beside)),
    ]
    for name, unit, low, high in zip(labels.names, labels.units, labels.low, labels.high, strict=True):
        cells = [f"{low:g} to {high:g} {unit}", *(f"{record[k][name]:.3f} {unit}" for k in ("mae", "rmse", "bias", "p95"))]
        cells += [f"{values[task][name]:g} {unit}" for values in beside.values()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    fidelity = "fast" if made.get("fast_tip") else made["fidelity"]["name"]
    count = _COUNT_OPTIONS.get(options.row, "contacts").replace("_", "-")
    number = samples if count == "fast-images" else contacts
    sized = f" --{count} {number}"
    if settings.get("drawn_contacts"):
        sized = f" --test-contacts {options.test_contacts}"
        if made.get("snapshots_per_contact", 1) > 1:
            sized = f" --slides {p['val']['configuration']['samples'] // samples_per_contact(made)}"
    network = ", ".join(f"{key} {value}" for key, value in p["network"].items())
    training = ", ".join(f"{key} {value}" for key, value in settings.items())
    lines += _by_force(record, dict(zip(labels.names, labels.units, strict=True)))
    lines += [
        "",
        f"Evaluated on {record['samples']} test contacts that were not used for training. {record['parameters']} "
        f"parameters; {record['latency_ms']:.2f} ms per image on one core ({machine_text(record['machine'])}).",
        "",
        f"- Training data: {data['samples']} images of {contacts} contacts{failed}; fidelity `{fidelity}`, "
        f"renderer `{made['renderer']}`, seed {made['seed']}. `model.json` has the full configuration and the checksums.",
        *_drawn(p),
        *_initial_weights(model, options),
        f"- Network: {network}.",
        f"- Training: {training}. Best epoch: {outcome['best_epoch']} of {outcome['epochs']}. torch {p['torch']}.",
        "",
        "Commands that make it again:",
        "",
        "```",
        f"tactip bench learning --task {task}{sized} --only {' '.join([*_earlier_rows(options), options.row])}",
        f"tactip bench release-models --task {task} --row {options.row}",
        "```",
    ]
    return "\n".join(lines) + "\n"
