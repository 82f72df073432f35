"""Search for a network: hyperopt's TPE over the paper's space, each trial a training, everything on disk.

    OUT/trials/0000/ …    a training each (train.py), and trial.json once it has ended
    OUT/results.jsonl     a line a trial: what was tried, what came out
    OUT/best.json         the best network, for `tactip train --config`
    OUT/tune.png          loss by trial, and each parameter against the rank of its loss

What is suggested depends on the seed, the number of the trial and the results so far: with one job, a search that was
stopped goes on as if it had not been.
"""

import dataclasses
import json
import math
import os
import signal
import sys
from multiprocessing import connection, get_context
from pathlib import Path

import numpy as np
import torch
from hyperopt import STATUS_FAIL, STATUS_OK, Trials, rand, tpe
from hyperopt.base import JOB_STATE_DONE, Domain
from tqdm import tqdm

from tactip_twin.learning.configuration import TuneSettings
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.search_space import expressions, network_of_values
from tactip_twin.learning.train import METRICS, Pruned, read_metrics, train, with_new_defaults
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.view.plot import pyplot
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file

TRIAL, RESULTS, BEST, LOCK = "trial.json", "results.jsonl", "best.json", ".lock"


def past(results, domain):
    """hyperopt's Trials of results (list of dict), numbered as they come. domain: hyperopt's Domain of the space."""
    trials = Trials()
    docs = []
    for tid, result in enumerate(results):
        values = result["values"]
        misc = {"tid": tid, "cmd": domain.cmd, "workdir": None}
        misc |= {"idxs": {k: [tid] for k in values}, "vals": {k: [v] for k, v in values.items()}}
        good = result["status"] == "ok"
        outcome = {"status": STATUS_OK, "loss": result["loss"]} if good else {"status": STATUS_FAIL}
        docs += trials.new_trial_docs(trials.new_trial_ids(1), [None], [outcome], [misc])
        docs[-1]["state"] = JOB_STATE_DONE
    trials.insert_trial_docs(docs)
    trials.refresh()
    return trials


def values_of(doc):
    """The values (dict of label to number) of a trial document of hyperopt's."""
    return {k: v[0].item() if isinstance(v[0], np.generic) else v[0] for k, v in doc["misc"]["vals"].items() if v}


def suggest(settings, index, results):
    """Hyperopt's values (dict of label to number) for trial `index`, given results (list of dict) so far."""
    domain = Domain(lambda point: 0.0, expressions(settings.space))
    trials = past(results, domain)
    seed = int(np.random.SeedSequence(settings.seed, spawn_key=(index,)).generate_state(1)[0])
    algorithm = rand if index < settings.startup else tpe
    (doc,) = algorithm.suggest(trials.new_trial_ids(1), domain, trials, seed)
    return values_of(doc)


def tune(data, folder, settings, jobs=1, device="auto", say=print):
    """Search in a folder, or go on with a search that was stopped there.

    data: path of a task's sets. folder: path. settings: TuneSettings. jobs: int, trainings at a time. device: str. say:
    called with lines for the user.

    Returns the results (list of dict). Raises TactipError where data, folder or settings do not do, and Interrupted at
    Ctrl-C.
    """
    folder = Path(folder)
    claim(folder, data, settings)
    with locked(folder / LOCK, f"searching in {folder}"):
        return _tune(data, folder, settings, jobs, device, say)


def _tune(data, folder, settings, jobs, device, say):
    """`tune`, in a folder that is ours."""
    results = read_results(folder)
    todo = [i for i in range(settings.trials) if i not in {r["trial"] for r in results}]
    if results and todo:
        say(f"{len(results)} of {settings.trials} trials are there already")
    with tqdm(total=settings.trials, initial=len(results), unit="trial", file=sys.stderr) as bar:
        running = {}
        try:
            while todo or running:
                while todo and len(running) < jobs:
                    index = todo.pop(0)
                    values = _asked(folder, index) or suggest(settings, index, results)
                    note(folder, index, {"trial": index, "values": values})
                    running[index] = _start(data, folder, index, settings, device, jobs)
                for index in _ended(running):
                    process = running.pop(index)
                    process.join()
                    results.append(result_of(folder, index, _why_none(folder, index, process.exitcode)))
                    write_results(folder, results, settings)
                    bar.update()
                    bar.set_postfix(best=_best_loss(results))
        except KeyboardInterrupt:
            raise Interrupted(f"{len(results)} of {settings.trials} trials are over: the same command goes on") from None
        finally:
            for process in running.values():
                process.terminate()
                process.join()
    draw(results, folder / "tune.png", settings.startup)
    return results


def claim(folder, data, settings):
    """Make a folder that of this search; what is wrong with data or space is said before any trial.

    Raises TactipError there, and where the folder is another's.
    """
    train_samples, _ = read_splits(data)
    settings.space.check_image_size(train_samples.size)
    identity = {"settings": dataclasses.asdict(settings), "data": train_samples.dataset.meta.get("digest")}
    del identity["settings"]["trials"]  # a search may be made longer
    identity = json.loads(json.dumps(identity))
    path = folder / "search.json"
    if path.exists():
        there = json.loads(path.read_text())
        before = {"settings": json.loads(json.dumps(dataclasses.asdict(TuneSettings())))}
        del before["settings"]["trials"]
        for part, asked in identity.items():
            if with_new_defaults(there.get(part), before.get(part)) != asked:
                raise TactipError(f"the folder {folder} holds a search with other {part}: name another one, or remove it")
        return
    if folder.exists() and any(folder.iterdir()):
        raise TactipError(f"the folder {folder} is not empty and holds no search: name another one")
    (folder / "trials").mkdir(parents=True)
    write_file(path, (json.dumps(identity, indent=1) + "\n").encode())


def trial_folder(folder, index):
    """Folder (Path) of a trial's training."""
    return Path(folder) / "trials" / f"{index:04d}"


def note(folder, index, record):
    """Write what is known of a trial."""
    place = trial_folder(folder, index)
    place.mkdir(parents=True, exist_ok=True)
    write_file(place.with_suffix(".json"), (json.dumps(record) + "\n").encode())


def _asked(folder, index):
    """The values (dict) that a trial which was stopped had been given, or None."""
    path = trial_folder(folder, index).with_suffix(".json")
    return json.loads(path.read_text())["values"] if path.exists() else None


def read_results(folder):
    """Results (list of dict) of the trials that are over, in the order of their ends."""
    path = Path(folder) / RESULTS
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def write_results(folder, results, settings):
    """Write results.jsonl of results (list of dict) and, of the best, best.json."""
    write_file(folder / RESULTS, "".join(json.dumps(r) + "\n" for r in results).encode())
    good = [r for r in results if r["status"] == "ok"]
    if good:
        best = min(good, key=lambda r: r["loss"])
        chosen = {"network": best["network"], "settings": dataclasses.asdict(settings.training)}
        chosen["found"] = {"trial": best["trial"], "val_loss": best["loss"], "of_trials": len(results)}
        write_file(folder / BEST, (json.dumps(chosen, indent=1) + "\n").encode())


def _best_loss(results):
    return min((r["loss"] for r in results if r["status"] == "ok"), default=math.nan)


def _start(data, folder, index, settings, device, jobs):
    """Begin a trial in a process of its own: what ends it, memory that is short among it, ends nothing else."""
    threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    arguments = (str(data), str(folder), index, settings, device, threads)
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])  # torch is imported once, not a trial
    process = context.Process(target=_trial_process, args=arguments)
    process.start()
    return process


def _trial_process(*arguments):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    # By this the parent ends trials: they leave as programs do, and let go of what they hold.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    run_trial(*arguments)


def run_trial(data, folder, index, settings, device, threads):
    """One trial: train, and write how it ended to its trial.json.

    data, folder: str. index: int. settings: TuneSettings. device: str. threads: int, that it may use.
    """
    torch.set_num_threads(threads)
    place = trial_folder(folder, index)
    record = json.loads(place.with_suffix(".json").read_text())
    result = record | {"status": "failed", "loss": None, "network": None}
    try:
        network = network_of_values(settings.space, record["values"])
        result["network"] = dataclasses.asdict(network)
        watch = _hopeless(read_results(folder), folder, settings.least_epochs) if settings.prune else None
        history = train(*read_splits(data), network, settings.training, place, device, lambda line: None, watch, quiet=True)
        result |= {"status": "ok", "loss": min(h["val_loss"] for h in history), "epochs": len(history)}
        result["seconds"] = sum(h["seconds"] for h in history)
    except Pruned as pruned:
        result |= {"status": "pruned", "why": str(pruned)}
    except TactipError as error:
        result["why"] = str(error)
    write_file(place / TRIAL, (json.dumps(result) + "\n").encode())


def _hopeless(results, folder, least):
    """A function of a history that says (bool) whether half of the trials before were better by now."""
    bests = []
    for r in results:
        path = trial_folder(folder, r["trial"]) / METRICS
        if r["status"] == "ok" and path.exists():
            bests.append(np.minimum.accumulate([h["val_loss"] for h in read_metrics(path.parent)]))

    def hopeless(history):
        epochs = len(history)
        if epochs < least or len(bests) < least:
            return False
        then = [b[min(epochs, len(b)) - 1] for b in bests]
        return min(h["val_loss"] for h in history) > np.median(then)

    return hopeless


def _ended(running):
    """Wait until at least one trial has ended. running: dict of index to process. Returns indices (list), in order."""
    ready = connection.wait([p.sentinel for p in running.values()])
    return [index for index, p in sorted(running.items()) if p.sentinel in ready]


def _why_none(folder, index, exit_code):
    """Why (str) a trial whose process has ended left no result, if it left none: it was killed, as by a system that is short
    of memory.

    Raises TactipError where it ended by an error of the program, which is no trial's: all others would end so, too.
    """
    if (trial_folder(folder, index) / TRIAL).exists():
        return ""
    if exit_code >= 0:
        raise TactipError(
            f"the process of trial {index} ended with exit code {exit_code}, and what it said is above: the search goes on "
            "from where it was when it is run again"
        )
    return f"its process was ended by {signal.Signals(-exit_code).name}: is memory short?"


def result_of(folder, index, why):
    """The result (dict) of a trial that has ended; `why` (str) it left none, if it did."""
    path = trial_folder(folder, index) / TRIAL
    if path.exists():
        return json.loads(path.read_text())
    record = json.loads(trial_folder(folder, index).with_suffix(".json").read_text())
    return record | {"status": "failed", "loss": None, "network": None, "why": why}


PARAMETERS = (
    ("conv_layers", False),
    ("filters", True),
    ("dense_layers", False),
    ("units", True),
    ("activation", False),
    ("batch_norm", False),
    ("dropout", False),
    ("l1", True),
    ("l2", True),
    ("batch_size", True),
)
"""Parameters of the figure, and whether their axis is logarithmic."""


def draw(results, path, startup):
    """Loss by trial, and each parameter against the rank of its loss, best marked. Writes a PNG to `path`."""
    plt = pyplot()
    good = sorted((r for r in results if r["status"] == "ok"), key=lambda r: r["trial"])
    if not good:
        raise TactipError("no trial ended well: there is nothing to draw, and results.jsonl says why")
    losses = np.array([r["loss"] for r in good])
    rank = np.argsort(np.argsort(losses)) + 1
    best = int(losses.argmin())
    figure, axes = plt.subplots(3, 4, figsize=(15, 9))
    axis = axes[0, 0]
    trials = np.array([r["trial"] for r in good])
    axis.semilogy(trials, losses, ".", color="0.5", ms=4)
    axis.semilogy(trials, np.minimum.accumulate(losses), "-", color="C0", lw=1.2)
    axis.semilogy(trials[best], losses[best], "o", color="C3")
    axis.axvline(startup - 0.5, color="0.8", lw=0.8)
    axis.set(xlabel="trial", ylabel="validation loss", title=f"best {losses[best]:.4g}, trial {trials[best]}")
    for axis, (name, logarithmic) in zip(axes.ravel()[1:], PARAMETERS, strict=False):
        values = [r["network"][name] for r in good]
        ticks = sorted(set(values)) if isinstance(values[0], str | bool) else None
        numbers = np.array([ticks.index(v) for v in values] if ticks else values, float)
        axis.plot(rank, numbers, ".", color="0.5", ms=4)
        axis.plot(rank[best], numbers[best], "o", color="C3")
        if ticks:
            axis.set_yticks(range(len(ticks)), [str(t) for t in ticks])
        if logarithmic:
            axis.set_yscale("log", base=10 if name in ("l1", "l2") else 2)
        axis.set(xlabel="rank of its loss", title=name)
    axes[2, 3].axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
