"""Hyperparameter search with hyperopt's TPE over the paper's space; each trial is a training.

    OUT/trials/0000/ …    training of each trial (train.py), and trial.json once it has ended
    OUT/results.jsonl     one line per trial: values and result
    OUT/best.json         best network, for `tactip train --config`
    OUT/tune.png          loss by trial, and each parameter against the rank of its loss

Suggestions depend only on the seed, the trial's number and the results so far, so with one job an interrupted and resumed
search gives the same results as an uninterrupted one.
"""

import dataclasses
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection, get_context
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hyperopt import STATUS_FAIL, STATUS_OK, Trials, rand, tpe
from hyperopt.base import JOB_STATE_DONE, Domain
from tqdm import tqdm

from tactip_twin.learning.checkpoint import METRICS, read_metrics, with_new_defaults
from tactip_twin.learning.configuration import DeviceName, PoseNetConfig, SearchSpace, TuneSettings
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.search_space import check_values, expressions, network_of_values
from tactip_twin.learning.train import Pruned, ShouldPrune, train
from tactip_twin.learning.tune_figure import plot_search
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.parent_watch import end_with_parent
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import remove_leftovers, write_file
from tactip_twin.tactip_model.input_files import read_json, read_json_lines

TRIAL, RESULTS, BEST, LOCK = "trial.json", "results.jsonl", "best.json", ".lock"


Result = dict[str, Any]
"""Values, status, loss and network of a trial, as JSON."""


def to_hyperopt_trials(results: Sequence[Result], domain: Domain) -> Trials:
    """Return results as hyperopt's Trials, numbered in order. domain: hyperopt's Domain of the space."""
    trials = Trials()
    docs = []
    for tid, result in enumerate(results):
        values = result["values"]
        misc = {"tid": tid, "cmd": domain.cmd, "workdir": None}
        misc |= {"idxs": {k: [tid] for k in values}, "vals": {k: [v] for k, v in values.items()}}
        # The loss at which a trial was pruned is above the one that it would have reached, so it is not better than it is.
        loss = result["loss"] if result["status"] == "ok" else result.get("loss_when_pruned")
        outcome = {"status": STATUS_FAIL} if loss is None else {"status": STATUS_OK, "loss": loss}
        docs += trials.new_trial_docs(trials.new_trial_ids(1), [None], [outcome], [misc])
        docs[-1]["state"] = JOB_STATE_DONE
    trials.insert_trial_docs(docs)
    trials.refresh()
    return trials


def values_of(doc: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values (label to number) of one of hyperopt's trial documents."""
    return {k: v[0].item() if isinstance(v[0], np.generic) else v[0] for k, v in doc["misc"]["vals"].items() if v}


def suggest(settings: TuneSettings, index: int, results: Sequence[Result]) -> dict[str, Any]:
    """Suggest hyperopt's values (label to number) for trial `index`, given the results so far."""
    domain = Domain(lambda point: 0.0, expressions(settings.space))
    trials = to_hyperopt_trials(results, domain)
    seed = int(np.random.SeedSequence(settings.seed, spawn_key=(index,)).generate_state(1)[0])
    algorithm = rand if index < settings.random_trials else tpe
    (doc,) = algorithm.suggest(trials.new_trial_ids(1), domain, trials, seed)
    return values_of(doc)


def tune(
    data: str | Path,
    folder: str | Path,
    settings: TuneSettings,
    jobs: int = 1,
    device: DeviceName = "auto",
    log: Callable[[str], None] = print,
    threads: int | None = None,
) -> list[Result]:
    """Search in a folder, or resume an interrupted search; return the results.

    Args:
        data: Folder of a task's sets.
        folder: Output folder.
        settings: Settings of the search.
        jobs: Number of parallel trials.
        device: Device to train on.
        log: Callback for messages to the user.
        threads: Number of threads of each trial; None divides the cores among the jobs.

    Raises:
        TactipError: If the data are invalid, the folder holds something else, or all trials failed.
        Interrupted: On Ctrl-C.
    """
    if threads is None:
        threads = max(1, len(os.sched_getaffinity(0)) // jobs)
    folder = Path(folder)
    prepare_folder(folder, data, settings)
    with locked(folder / LOCK, f"searching in {folder}"):
        return _tune(data, folder, settings, jobs, device, log, threads)


def _tune(
    data: str | Path,
    folder: Path,
    settings: TuneSettings,
    jobs: int,
    device: DeviceName,
    log: Callable[[str], None],
    threads: int,
) -> list[Result]:
    """Search in a locked folder; see `tune`."""
    results = resumed_results(folder, settings)
    todo = [i for i in range(settings.trials) if i not in {r["trial"] for r in results}]
    if results and todo:
        log(f"{len(results)} of {settings.trials} trials are already done")
    with tqdm(total=settings.trials, initial=len(results), unit="trial", file=sys.stderr) as bar:
        running: dict[int, ForkServerProcess] = {}
        try:
            while todo or running:
                while todo and len(running) < jobs:
                    index = todo.pop(0)
                    values = _recorded_values(folder, index, settings.space) or suggest(settings, index, results)
                    record_start(folder, index, {"trial": index, "values": values})
                    running[index] = _start(data, folder, index, settings, device, threads)
                for index in _ended(running):
                    process = running.pop(index)
                    process.join()
                    why = _missing_result(folder, index, process.exitcode)
                    results.append(read_result(folder, index, settings.space, why))
                    write_results(folder, results, settings)
                    bar.update()
                    bar.set_postfix(best=_best_loss(results))
        except KeyboardInterrupt:
            raise Interrupted(interrupted_message(results, settings)) from None
        finally:
            for process in running.values():
                process.terminate()
                process.join()
    plot_search(results, folder / "tune.png", settings.random_trials)
    return results


def interrupted_message(results: Sequence[Result], settings: TuneSettings) -> str:
    """Return the message of an interrupted search."""
    return f"{len(results)} of {settings.trials} trials are done: run the same command to resume"


def prepare_folder(folder: Path, data: str | Path, settings: TuneSettings) -> None:
    """Check the data and the space, and create the folder of the search unless it exists.

    Raises:
        TactipError: If the data or the space are invalid, or the folder holds something else.
    """
    train_samples, _ = read_splits(data)
    settings.space.check_image_size(train_samples.size)
    requested = {"settings": _identity(settings), "data": train_samples.dataset.meta.get("digest")}
    path = folder / "search.json"
    recorded = None
    if path.exists():
        recorded = read_json(path)
        if not isinstance(recorded, dict):
            raise TactipError(f"{path} must have the settings of a search, got {recorded!r:.60}")
        recorded = recorded | {"settings": with_new_defaults(recorded.get("settings"), _identity(TuneSettings()))}
    if not check_resumable(folder, "search", recorded, requested):
        folder.mkdir(parents=True, exist_ok=True)
        write_file(path, (json.dumps(requested, indent=1) + "\n").encode())


def _identity(settings: TuneSettings) -> dict[str, Any]:
    """Return the settings that identify a search, as JSON: all except the number of trials, which may be increased."""
    identity = dataclasses.asdict(settings)
    del identity["trials"]
    return json.loads(json.dumps(identity))


def trial_folder(folder: str | Path, index: int) -> Path:
    """Return the folder of a trial's training."""
    return Path(folder) / "trials" / f"{index:04d}"


def record_start(folder: Path, index: int, record: Result) -> None:
    """Record the number and values of a trial before it starts."""
    place = trial_folder(folder, index)
    place.mkdir(parents=True, exist_ok=True)
    write_file(place.with_suffix(".json"), (json.dumps(record) + "\n").encode())


def _recorded_values(folder: Path, index: int, space: SearchSpace) -> dict[str, Any] | None:
    """Return the values of an interrupted trial, or None if it has not started."""
    return _read_start(folder, index, space)["values"] if trial_folder(folder, index).with_suffix(".json").exists() else None


def _read_start(folder: str | Path, index: int, space: SearchSpace) -> Result:
    """Return what `record_start` wrote. Raises TactipError where it cannot be read."""
    path = trial_folder(folder, index).with_suffix(".json")
    return _check_start(read_json(path), index, space, f"{path}: delete it to repeat the trial, because it is damaged")


def _check_start(record: Any, index: int | None, space: SearchSpace, name: str) -> Result:
    """Return a JSON value. Raises TactipError unless it has the number and the values of a trial.

    Args:
        record: The value.
        index: Number of the trial; None for any.
        space: Space of the search.
        name: Name of the file, for messages.
    """
    trial = record.get("trial") if isinstance(record, dict) else None
    if type(trial) is not int or trial < 0 or (index is not None and trial != index):
        raise TactipError(f"{name}: it must be an object with the number of the trial, got {record!r:.60}")
    check_values(space, record.get("values"), name)
    return record


def _check_result(result: Any, index: int | None, space: SearchSpace, name: str) -> Result:
    """Return a JSON value. Raises TactipError unless it is the result of a trial. Arguments as of `_check_start`."""
    _check_start(result, index, space, name)
    status, loss = result.get("status"), result.get("loss")
    if status not in ("ok", "pruned", "failed") or (status == "ok" and type(loss) not in (int, float)):
        raise TactipError(f"{name}: status must be ok, pruned or failed, and the loss of ok a number, got {status!r:.60}")
    if status == "ok":
        from_dict(PoseNetConfig, result.get("network"), f"{name}: network")
    elif status == "pruned" and type(result.get("loss_when_pruned", 0.0)) not in (int, float):
        raise TactipError(f"{name}: loss_when_pruned must be a number, got {result['loss_when_pruned']!r:.60}")
    elif status == "failed" and not isinstance(result.get("why"), str):
        raise TactipError(f"{name}: why must be a sentence, got {result.get('why')!r:.60}")
    return result


def read_results(folder: str | Path, space: SearchSpace) -> list[Result]:
    """Return the results of the trials that have ended, in the order in which they ended.

    Args:
        folder: Folder of the search.
        space: Space of the search.

    Raises:
        TactipError: If the file cannot be read, or has anything but results of trials with values of the space.
    """
    path = Path(folder) / RESULTS
    if not path.exists():
        return []
    results = read_json_lines(path)
    for number, result in enumerate(results, 1):
        _check_result(result, None, space, f"{path}, line {number}")
    if len({result["trial"] for result in results}) < len(results):
        raise TactipError(f"{path} must have one result per trial, but it has the same trial twice")
    return results


def resumed_results(folder: Path, settings: TuneSettings) -> list[Result]:
    """Return the results so far of a search that resumes, after mending what a kill may have left in its locked folder."""
    remove_leftovers(folder)
    remove_leftovers(folder / "trials")
    results = read_results(folder, settings.space)
    if results:
        write_results(folder, results, settings)  # a kill may have come between its two files
    return results


def write_results(folder: Path, results: Sequence[Result], settings: TuneSettings) -> None:
    """Write results.jsonl and, for the best result, best.json."""
    write_file(folder / RESULTS, "".join(json.dumps(r) + "\n" for r in results).encode())
    good = [r for r in results if r["status"] == "ok"]
    if good:
        best = min(good, key=lambda r: r["loss"])
        chosen = {"network": best["network"], "settings": dataclasses.asdict(settings.training)}
        chosen["found"] = {"trial": best["trial"], "val_loss": best["loss"], "of_trials": len(results)}
        write_file(folder / BEST, (json.dumps(chosen, indent=1) + "\n").encode())


def _best_loss(results: Sequence[Result]) -> float:
    """Return the lowest loss; NaN if there is none."""
    return min((r["loss"] for r in results if r["status"] == "ok"), default=math.nan)


def _start(
    data: str | Path, folder: Path, index: int, settings: TuneSettings, device: DeviceName, threads: int
) -> ForkServerProcess:
    """Start a trial in its own process, so the search survives a crash of the trial, such as running out of memory."""
    arguments = (str(data), str(folder), index, settings, device, threads)
    context = get_context("forkserver")
    # Imported once instead of in every trial; the second is what torch imports when an optimizer is made.
    context.set_forkserver_preload([__name__, "torch._dynamo"])
    process = context.Process(target=_trial_process, args=arguments)
    process.start()
    return process


def _trial_process(data: str, folder: str, index: int, settings: TuneSettings, device: DeviceName, threads: int) -> None:
    """Run a trial as the main function of its process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    end_with_parent()
    # The parent ends trials by SIGTERM: an orderly exit releases their locks and memory.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    run_trial(data, folder, index, settings, device, threads)


def run_trial(data: str, folder: str, index: int, settings: TuneSettings, device: DeviceName, threads: int) -> None:
    """Train one trial and write its result to trial.json in its folder.

    Args:
        data: Folder of a task's sets.
        folder: Folder of the search.
        index: Number of the trial.
        settings: Settings of the search.
        device: Device to train on.
        threads: Maximum number of threads.
    """
    torch.set_num_threads(threads)
    place = trial_folder(folder, index)
    record = _read_start(folder, index, settings.space)
    result = record | {"status": "failed", "loss": None, "network": None}
    try:
        network = network_of_values(settings.space, record["values"])
        result["network"] = dataclasses.asdict(network)
        prune = _should_prune(read_results(folder, settings.space), folder, settings.min_epochs) if settings.prune else None
        history = train(*read_splits(data), network, settings.training, place, device, lambda line: None, prune, quiet=True)
        result |= {"status": "ok", "loss": min(h["val_loss"] for h in history), "epochs": len(history)}
        result["seconds"] = sum(h["seconds"] for h in history)
    except Pruned as pruned:
        history = read_metrics(place)
        result |= {"status": "pruned", "why": str(pruned), "epochs": len(history)}
        result["loss_when_pruned"] = min(h["val_loss"] for h in history)
    except TactipError as error:
        result["why"] = str(error)
    write_file(place / TRIAL, (json.dumps(result) + "\n").encode())


def _should_prune(results: Sequence[Result], folder: str | Path, min_epochs: int) -> ShouldPrune:
    """Return a function that decides whether half of the earlier trials were better after the same number of epochs.

    Args:
        results: Results of the earlier trials.
        folder: Folder of the search.
        min_epochs: Number of epochs, and of trials, below which no training is ended.
    """
    bests = []
    for r in results:
        path = trial_folder(folder, r["trial"]) / METRICS
        if r["status"] == "ok" and path.exists():
            bests.append(np.minimum.accumulate([h["val_loss"] for h in read_metrics(path.parent)]))

    def should_prune(history: list[dict[str, float]]) -> bool:
        """Return whether to end the training."""
        epochs = len(history)
        if epochs < min_epochs or len(bests) < min_epochs:
            return False
        then = [b[min(epochs, len(b)) - 1] for b in bests]
        return bool(min(h["val_loss"] for h in history) > np.median(then))

    return should_prune


def _ended(running: Mapping[int, ForkServerProcess]) -> list[int]:
    """Wait until a trial ends; return the numbers of all that have ended, sorted. running: processes by trial number."""
    ready = connection.wait([p.sentinel for p in running.values()])
    return [index for index, p in sorted(running.items()) if p.sentinel in ready]


def _missing_result(folder: Path, index: int, exit_code: int | None) -> str:
    """Return the reason why a trial whose process has ended wrote no result; an empty string if it wrote one.

    Raises:
        TactipError: If an error of the program ended it, because that error would end every other trial, too.
    """
    if (trial_folder(folder, index) / TRIAL).exists():
        return ""
    if exit_code is None or exit_code >= 0:
        raise TactipError(
            f"the process of trial {index} failed with exit code {exit_code}; its output is above: fix the error and run "
            "the same command to resume"
        )
    return f"the process was killed by {signal.Signals(-exit_code).name}; the machine may be out of memory"


def read_result(folder: str | Path, index: int, space: SearchSpace, why: str) -> Result:
    """Read the result of a trial that has ended.

    Args:
        folder: Folder of the search.
        index: Number of the trial.
        space: Space of the search.
        why: Reason of its failure, for a trial that wrote no result.

    Raises:
        TactipError: If a file of the trial cannot be read.
    """
    path = trial_folder(folder, index) / TRIAL
    if path.exists():
        return _check_result(read_json(path), index, space, f"{path}: delete it to repeat the trial, because it is damaged")
    record = _read_start(folder, index, space)
    return record | {"status": "failed", "loss": None, "network": None, "why": why}
