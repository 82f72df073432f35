"""The paper's hyperparameter search with a limited number of trials, and its differences from the paper's, on one page.

`tactip bench search --task surface --trials 60` makes missing sets, searches, and writes docs/search.md, search.json and one
figure per task. After an interruption it resumes; a larger number of trials adds to the existing ones.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from tactip_twin.benchmarks.hardware import machine, machine_text
from tactip_twin.benchmarks.learning import learning
from tactip_twin.benchmarks.options import LearningOptions, SearchOptions
from tactip_twin.benchmarks.report import read_results, table, write_results
from tactip_twin.learning.checkpoint import with_new_defaults
from tactip_twin.learning.configuration import SearchSpace, TrainSettings, TuneSettings
from tactip_twin.learning.tune import tune
from tactip_twin.learning.tune_figure import PARAMETERS, plot_search
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.tactip_model.errors import lookup

LAPTOP = TuneSettings(
    trials=60,
    random_trials=20,
    space=SearchSpace(max_conv_layers=4, max_filters=16, max_dense_units=128, blur_px=1.0, downsample=2),
    training=TrainSettings(epochs=40, learning_rate=1e-3),
)
"""A search for two cores: few epochs, hence ten times the paper's rate [?]."""

BEST = 5
"""Number of best trials in the table."""


def jobs(options: SearchOptions) -> list[Job]:
    """Return the sets that are needed, whether they exist or not."""
    sizes = LearningOptions(task=options.task, test_contacts=options.val_contacts, data=options.data)
    (val,) = (job for job in learning.jobs(sizes, ("plain",)) if job.folder == options.data / "plain" / options.task / "val")
    train = replace(val.configuration, split="train", samples=options.contacts)
    return [val, Job(train, val.folder.with_name("train"))]


def run(options: SearchOptions, log: Callable[[str], None] = print) -> dict[str, Any]:
    """Search, write search.json, search.md and the figure of the task, and return the results of the task.

    Progress goes to `log`. Raises TactipError, and Interrupted on Ctrl-C.
    """
    lookup("task", options.task, dict.fromkeys(learning.PAPER))
    settings = TuneSettings() if options.paper else replace(LAPTOP, trials=options.trials)
    make(jobs(options), worker_count(options.workers), log)
    results = tune(options.data / "plain" / options.task, options.runs / options.task, settings, options.jobs, log=log)
    results = sorted(results, key=lambda r: r["trial"])
    record = {
        "contacts": options.contacts,
        "val_contacts": options.val_contacts,
        "settings": dataclasses.asdict(settings),
        "machine": machine(),
        "trials": [{k: r.get(k) for k in ("trial", "status", "loss", "network", "why")} for r in results],
    }
    whole = read_results(options.out / "search.json") | {options.task: record}
    whole = {task: whole[task] for task in learning.PAPER if task in whole}
    write_results("search", whole, tables(whole), options.out)
    plot_search(results, options.out / f"search_{options.task}.png", settings.random_trials)
    return record


def tables(whole: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of docs/search.md from search.json: the best trials of each task, and how the search was made."""
    out = dict.fromkeys(learning.PAPER, "Not measured.")
    names = [name for name, _ in PARAMETERS]
    for task, record in whole.items():
        ended = Counter(t["status"] for t in record["trials"])
        good = sorted((t for t in record["trials"] if t["status"] == "ok"), key=lambda t: t["loss"])
        rows = [
            [
                t["trial"],
                f"{t['loss']:.4g}",
                *(f"{v:.2g}" if isinstance(v, float) else v for v in map(t["network"].get, names)),
            ]
            for t in good[:BEST]
        ]
        made = (
            f"{len(record['trials'])} trials ({', '.join(f'{n} {status}' for status, n in sorted(ended.items()))}); "
            f"{record['contacts']} contacts for training, {record['val_contacts']} for validation. Machine: "
            f"{machine_text(record['machine'])}. Differences from the paper: "
            f"{', '.join(differences(record['settings'])) or 'none'}."
        )
        out[task] = f"{table(['trial', 'loss', *names], rows)}\n\n{made}"
    return out


def differences(settings: dict[str, Any]) -> list[str]:
    """Return the differences of a search's settings from the paper's, in words."""

    def differing(ours: Mapping[str, Any], papers: Mapping[str, Any], name: str) -> Iterator[str]:
        for key, value in papers.items():
            if isinstance(value, dict):
                yield from differing(ours[key], value, f"{name}{key}.")
            elif ours[key] != value:
                yield f"{name}{key} {ours[key]:g} instead of {value:g}"

    papers = dataclasses.asdict(TuneSettings())
    return list(differing(with_new_defaults(settings, papers), papers, ""))
