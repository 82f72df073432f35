"""The paper's hyperparameter search at a budget, and what its best networks reach when they are trained in full.

`tactip bench search --task surface` makes missing sets, searches, trains the best networks and some others longer, and
writes docs/search.md, search.json and one figure per task. After an interruption it resumes; a larger number of trials adds
to the existing ones.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning import learning, learning_sets
from tactip_twin.benchmarks.learning.options import SearchBudget, SearchOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.checkpoint import METRICS, read_metrics, with_new_defaults
from tactip_twin.learning.configuration import PoseNetConfig, SearchSpace, TrainSettings, TuneSettings
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.evaluate import evaluate
from tactip_twin.learning.model import WEIGHTS, load_model
from tactip_twin.learning.train import train
from tactip_twin.learning.tune import read_results as read_results_of
from tactip_twin.learning.tune import tune
from tactip_twin.learning.tune_figure import PARAMETERS, plot_search
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, Split
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import lookup
from tactip_twin.tactip_model.presets import load_design

_SHORT_TRAINING = TrainSettings(epochs=12, learning_rate=1e-3, schedule="cosine")
"""Training of a trial: few epochs, hence ten times the paper's rate [?]."""

BUDGETS: dict[SearchBudget, TuneSettings] = {
    "laptop": TuneSettings(
        trials=60,
        random_trials=20,
        space=SearchSpace(max_conv_layers=4, max_filters=16, max_dense_units=128, blur_px=1.0, downsample=2),
        training=_SHORT_TRAINING,
    ),
    "gpu": TuneSettings(space=SearchSpace(max_filters=128), training=_SHORT_TRAINING, prune=True, min_epochs=4),
    "paper": TuneSettings(),
}
"""Settings of the search by budget."""

LONG_TRAINING = TrainSettings(epochs=40, learning_rate=1e-3, schedule="cosine", patience=40)
"""Training in full of the networks that the search found."""

BEST, OTHERS = 5, 5
"""Numbers of trials that are trained in full: the best, and some of the others, evenly spaced in rank."""

_SEED = 51
"""Seed of the sets; those of the networks have others [?]."""

_BINS = 4
"""Number of groups of equal size that a continuous parameter is divided into for its importance."""


def folder_of(options: SearchOptions, name: str) -> Path:
    """Return the folder with the splits of the set of a name: short, long or test."""
    return options.data / options.task / name


def jobs(options: SearchOptions) -> list[Job]:
    """Return the sets that are needed, whether they exist or not."""
    tip = shipped_fast_tip(options.task, learning_sets.DESIGN)
    digest = read_fast_tip(tip).digest

    def job(name: str, split: Split, samples: int) -> Job:
        """Return a set; test sets are simulated."""
        configuration = Configuration(
            task=options.task,
            split=split,
            samples=samples,
            seed=_SEED,
            renderer="raster",
            design=load_design(learning_sets.DESIGN),
            fidelity=fidelity_named(learning_sets.FIDELITY),
            pose=POSE_RANGES[options.task],
            fast_tip="" if split == "test" else digest,
        )
        return Job(configuration, folder_of(options, name) / split, None if split == "test" else tip)

    sizes = {"short": options.contacts, "long": options.long_contacts}
    out = [job(name, "train", size) for name, size in sizes.items()]
    return [*out, *(job(name, "val", options.val_contacts) for name in sizes), job("test", "test", options.test_contacts)]


def run(options: SearchOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Search, write search.json, search.md and the figure of the task, and return the results of the task.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    lookup("task", options.task, dict.fromkeys(learning.PAPER))
    settings = lookup("budget", options.budget, BUDGETS)
    settings = replace(settings, trials=options.trials or settings.trials)
    folder = options.runs / options.task
    if options.page_only:
        results = read_results_of(folder, settings.space)
        settings = replace(settings, trials=len(results))
    else:
        make(jobs(options), worker_count(options.workers), log)
        results = tune(folder_of(options, "short"), folder, settings, options.jobs, log=log)
    results = sorted(results, key=lambda r: r["trial"])
    kept = ("trial", "status", "loss", "loss_when_pruned", "epochs", "seconds", "network", "why")
    record = {
        "contacts": options.contacts,
        "long_contacts": options.long_contacts,
        "val_contacts": options.val_contacts,
        "test_contacts": options.test_contacts,
        "settings": dataclasses.asdict(settings),
        "machine": machine(),
        "trials": [{k: r[k] for k in kept if k in r} for r in results],
        "long": long_trainings(options, results, log),
        "importance": importance(results),
    }
    whole = read_results(options.out / "search.json") | {options.task: record}
    whole = {task: whole[task] for task in learning.PAPER if task in whole}
    write_results("search", whole, tables(whole), options.out)
    plot_search(results, options.out / f"search_{options.task}.png", settings.random_trials)
    return record


def long_trainings(
    options: SearchOptions, results: Sequence[Mapping[str, Any]], log: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Train the chosen trials' networks in full, unless that is done; return what each reached, by rank."""
    good = sorted((r for r in results if r["status"] == "ok"), key=lambda r: r["loss"])
    others = np.linspace(BEST, len(good) - 1, OTHERS).round().astype(int) if len(good) > BEST else []
    ranks = sorted({*range(min(BEST, len(good))), *(int(k) for k in others)})
    folders = {k: options.runs / f"{options.task}-long" / f"{good[k]['trial']:04d}" for k in ranks}
    if not options.page_only:
        log(f"{len(ranks)} networks are trained in full")
        networks = [from_dict(PoseNetConfig, good[k]["network"], "network") for k in ranks]
        with ProcessPoolExecutor(options.jobs, get_context("forkserver")) as pool:
            data = folder_of(options, "long")
            pairs = zip(networks, folders.values(), strict=True)
            for one in [pool.submit(_train_one, data, *pair, LONG_TRAINING) for pair in pairs]:
                one.result()
    where = folder_of(options, "test") / "test"
    test = None if options.page_only and not where.exists() else read_samples(where)
    out = []
    for k, folder in folders.items():
        history = read_metrics(folder) if (folder / METRICS).exists() else []
        if history:
            best = min(h["val_loss"] for h in history)
            out.append({"rank": k + 1, "trial": good[k]["trial"], "epochs": len(history), "val_loss": best})
        if history and test is not None and (folder / WEIGHTS).exists():
            out[-1]["mae"] = evaluate(load_model(folder), test).figures["mae"]
    return out


def _train_one(data: Path, network: PoseNetConfig, folder: Path, settings: TrainSettings) -> None:
    """Train a network in a folder, or finish its training."""
    torch.set_num_threads(1)
    train(*read_splits(data), network, settings, folder, log=lambda line: None, quiet=True)


def importance(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the share, 0 to 1, of the variance of the loss's rank that each parameter alone explains.

    This is the correlation ratio (K. Pearson, 1905) over the values of the parameter, or over groups of equal size of its
    values if it is continuous. Pruned trials count with the loss at which they were pruned.
    """
    seen = [(r["network"], r["loss"] if r["status"] == "ok" else r.get("loss_when_pruned")) for r in results]
    seen = [(network, loss) for network, loss in seen if network and loss is not None]
    if len(seen) < 2:
        return {}
    rank, out = np.argsort(np.argsort([loss for _, loss in seen])).astype(float), {}
    for name in PARAMETERS:
        values = [network[name] for network, _ in seen]
        if isinstance(values[0], float):
            values = np.argsort(np.argsort(values)) * _BINS // len(values)
        groups = np.unique([str(v) for v in values], return_inverse=True)[1]
        means = np.array([rank[groups == g].mean() for g in range(groups.max() + 1)])
        out[name] = float(((means[groups] - rank.mean()) ** 2).mean() / rank.var())
    return out


def tables(whole: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/search.md from search.json: the best trials of each task, the networks that were trained in
    full, the importance of the parameters, and how the search was made."""
    out = dict.fromkeys(learning.PAPER, "Not measured.")
    for task, record in whole.items():
        out[task] = "\n\n".join([_trials(record), _long(task, record), _importance(record), _made(record)])
    return out


def _trials(record: Mapping[str, Any]) -> str:
    """Return the table of the best trials."""
    names = list(PARAMETERS)
    good = sorted((t for t in record["trials"] if t["status"] == "ok"), key=lambda t: t["loss"])
    rows = [
        [t["trial"], f"{t['loss']:.4g}", *(f"{v:.2g}" if isinstance(v, float) else v for v in map(t["network"].get, names))]
        for t in good[:BEST]
    ]
    return table(["trial", "loss", *(title for title, _ in PARAMETERS.values())], rows)


def _long(task: str, record: Mapping[str, Any]) -> str:
    """Return the table of the networks that were trained in full, and whether the ranking of the search survived."""
    long = record["long"]
    if not long:
        return "No network has been trained in full."
    names = list(learning.PAPER[task]) if any("mae" in t for t in long) else []
    rows = [["*the paper, real sensor*", "", "", "", *learning.PAPER[task].values()]] if names else []
    for t in long:
        errors = [f"{t['mae'][n]:.3g}" if "mae" in t else "" for n in names]
        rows.append([t["trial"], t["rank"], t["epochs"], f"{t['val_loss']:.4g}", *errors])
    text = table(["trial", "rank in the search", "epochs", "validation loss", *names], rows)
    if len(long) > 2:
        correlation = spearmanr([t["rank"] for t in long], [t["val_loss"] for t in long]).statistic
        text += f"\n\nRank correlation (Spearman) of both losses over these networks: {correlation:.2f}."
    return text


def _importance(record: Mapping[str, Any]) -> str:
    """Return the table of the importance of the parameters, most important first."""
    found = sorted(record["importance"].items(), key=lambda item: -item[1])
    rows = [[PARAMETERS[name][0], f"{value:.0%}"] for name, value in found]
    return table(["parameter", "variance of the loss's rank that the parameter alone explains"], rows)


def _made(record: Mapping[str, Any]) -> str:
    """Return how a search was made."""
    ended = Counter(t["status"] for t in record["trials"])
    counts = ", ".join(f"{n} {status}" for status, n in sorted(ended.items()))
    return (
        f"{len(record['trials'])} trials ({counts}); {record['contacts']} contacts for training, {record['val_contacts']} "
        f"for validation. In full: {record['long_contacts']} contacts, up to {LONG_TRAINING.epochs} epochs; errors, if any, "
        f"on {record['test_contacts']} simulated contacts. Page written on: {machine_text(record['machine'])}. "
        f"Differences from the paper: {', '.join(differences(record['settings'])) or 'none'}."
    )


def differences(settings: dict[str, Any]) -> list[str]:
    """Return the differences of a search's settings from the paper's, in words."""

    def differing(ours: Mapping[str, Any], papers: Mapping[str, Any], name: str) -> Iterator[str]:
        for key, value in papers.items():
            if isinstance(value, dict):
                yield from differing(ours[key], value, f"{name}{key}.")
            elif ours[key] != value:
                yield f"{name}{key} {_text(ours[key])} instead of {_text(value)}"

    papers = dataclasses.asdict(TuneSettings())
    return list(differing(with_new_defaults(settings, papers), papers, ""))


def _text(value: object) -> str:
    """Return a setting as text."""
    return f"{value:g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
