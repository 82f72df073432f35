"""Hyperparameter search: suggestions, resuming after a kill, failed trials, pruning, and Ray."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from hyperopt.base import Domain

from helpers.kills import contents
from helpers.learning_sets import write_fake_splits
from helpers.set_commands import process, run, run_process
from tactip_twin.learning.configuration import SearchSpace, TrainSettings, TuneSettings
from tactip_twin.learning.recipes import read_recipe
from tactip_twin.learning.search_space import expressions, network_of_values
from tactip_twin.learning.tune import read_results, record_start, run_trial, suggest, to_hyperopt_trials, tune
from tactip_twin.learning.tune_ray import clear, tune_on_cluster
from tactip_twin.tactip_model.errors import TactipError

SPACE = SearchSpace(max_conv_layers=2, max_filters=4, max_dense_layers=2, max_dense_units=8)
COMMAND_SPACE = replace(SPACE, max_dense_layers=5)
SETTINGS = TuneSettings(trials=2, random_trials=1, space=SPACE, training=TrainSettings(epochs=2))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_fake_splits(tmp_path_factory.mktemp("sets") / "surface", samples=16)


def results_of(pairs):
    """Return results of pairs of values and loss."""
    return [{"trial": i, "values": v, "status": "ok", "loss": loss} for i, (v, loss) in enumerate(pairs)]


def test_suggest_random_covers_paper_space():
    networks = [network_of_values(SearchSpace(), suggest(TuneSettings(random_trials=200), i, [])) for i in range(100)]
    assert {n.conv_layers for n in networks} == {1, 2, 3, 4, 5}
    assert {n.filters for n in networks} == {2**k for k in range(1, 10)} == {n.dense_units for n in networks}
    assert {n.dense_layers for n in networks} == {1, 2, 3, 4, 5}
    assert {n.batch_size for n in networks} == {16, 32, 64, 128}
    assert {n.activation for n in networks} == {"relu", "elu"}
    assert Counter(n.batch_norm for n in networks)[True] > 40
    assert all(0 <= n.dropout <= 0.5 and 1e-4 <= n.l1 <= 1e-1 and 1e-4 <= n.l2 <= 1e-1 for n in networks)
    # L1 is uniform in its logarithm.
    assert np.mean([np.log10(n.l1) for n in networks]) == pytest.approx(-2.5, abs=0.3)


def test_suggest_with_results_improves():
    """Where the loss favours four filters, later suggestions are closer to four."""
    settings = TuneSettings(random_trials=30)
    past = []
    for i in range(60):
        values = suggest(settings, i, results_of(past))
        past.append((values, abs(values["log2_filters"] - 2) + 0.1 * values["dropout"]))
    first, later = ([abs(v["log2_filters"] - 2) for v, _ in part] for part in (past[:30], past[30:]))
    assert np.mean(later) < 0.6 * np.mean(first)


def test_suggest_depends_on_index_and_results():
    past = results_of([(suggest(SETTINGS, i, []), float(i)) for i in range(3)])
    assert suggest(SETTINGS, 3, past) == suggest(SETTINGS, 3, past)
    assert suggest(SETTINGS, 3, past) != suggest(SETTINGS, 4, past)
    failed = [*past, {"trial": 3, "values": past[0]["values"], "status": "failed", "loss": None}]
    assert suggest(SETTINGS, 4, failed)


def test_tune_writes_best_and_resumes(data, tmp_path):
    results = tune(data, tmp_path / "search", SETTINGS, log=lambda line: None)
    assert [r["trial"] for r in results] == [0, 1]
    assert all(r["status"] == "ok" for r in results)
    best = read_recipe(tmp_path / "search" / "best.json")
    winner = min(results, key=lambda r: r["loss"])
    assert best.network.filters == winner["network"]["filters"]
    assert best.settings == SETTINGS.training
    assert (tmp_path / "search" / "tune.png").stat().st_size > 10_000
    # A search with more trials resumes; other settings make it another search.
    longer = replace(SETTINGS, trials=3)
    assert [r["trial"] for r in tune(data, tmp_path / "search", longer, log=lambda line: None)] == [0, 1, 2]
    # A search recorded before a field was added to the settings is recognized.
    path = tmp_path / "search" / "search.json"
    there = json.loads(path.read_text())
    del there["settings"]["training"]["optics_ranges"], there["settings"]["prune"]
    path.write_text(json.dumps(there))
    assert len(tune(data, tmp_path / "search", longer, log=lambda line: None)) == 3
    with pytest.raises(TactipError, match=r"holds a search with other settings \(settings.seed is 0 there, 1 here\)"):
        tune(data, tmp_path / "search", replace(SETTINGS, seed=1), log=lambda line: None)


def test_tune_space_too_deep_for_images_raises(data, tmp_path):
    with pytest.raises(TactipError, match=r"conv_layers must be at most 3.*, got 5"):
        tune(data, tmp_path / "search", TuneSettings(), log=lambda line: None)
    assert not (tmp_path / "search").exists()


def search_command(data, out, *options):
    limits = ["--space.max-conv-layers", "2", "--space.max-dense-units", "8", "--max-filters", "4", "--training.epochs", "2"]
    return ["tune", "--data", str(data), "--out", str(out), "--trials", "3", "--random-trials", "2", *limits, *options]


def without_seconds(results):
    return [{k: v for k, v in r.items() if k != "seconds"} for r in results]


@pytest.mark.slow
def test_tune_command_killed_resumes_to_same_results(data, tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(search_command(data, whole)).returncode == 0
    command = process(search_command(data, killed))
    started = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    end = time.monotonic() + 90
    while not read_results(killed, COMMAND_SPACE):
        assert time.monotonic() < end
        time.sleep(0.05)
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    assert len(read_results(killed, COMMAND_SPACE)) < 3
    again = run(search_command(data, killed))
    assert again.returncode == 0 and "of 3 trials are already done" in again.stderr
    assert without_seconds(read_results(killed, COMMAND_SPACE)) == without_seconds(read_results(whole, COMMAND_SPACE))


@pytest.mark.slow
def test_tune_command_two_jobs_runs_all_trials(data, tmp_path):
    assert run_process(search_command(data, tmp_path / "two", "--jobs", "2")).returncode == 0
    assert sorted(r["trial"] for r in read_results(tmp_path / "two", COMMAND_SPACE)) == [0, 1, 2]


def test_run_trial_failed_writes_reason(data, tmp_path, monkeypatch):
    """The reason of the failure is recorded, and the search continues."""
    folder = tmp_path / "search"
    place = folder / "trials"
    (place / "0000").mkdir(parents=True)
    (place / "0000.json").write_text(json.dumps({"trial": 0, "values": suggest(SETTINGS, 0, [])}))

    def short(*arguments, **options):
        raise TactipError("out of memory")

    monkeypatch.setattr("tactip_twin.learning.tune.train", short)
    threads = torch.get_num_threads()
    run_trial(str(data), str(folder), 0, SETTINGS, "cpu", 1)
    torch.set_num_threads(threads)
    result = json.loads((place / "0000" / "trial.json").read_text())
    assert result["status"] == "failed"
    assert "out of memory" in result["why"]


class _Ended:
    """A process that has ended."""

    def __init__(self, exit_code):
        self.exitcode, self.sentinel = exit_code, None

    def join(self):
        """Return at once."""


@pytest.mark.parametrize(("exit_code", "kept"), [(-signal.SIGKILL, True), (1, False), (0, False)])
def test_tune_killed_trial_is_result_and_broken_program_raises(data, tmp_path, monkeypatch, exit_code, kept):
    """Running out of memory kills one trial, but an error of the program would end all of them."""
    monkeypatch.setattr("tactip_twin.learning.tune._start", lambda *arguments: _Ended(exit_code))
    monkeypatch.setattr("tactip_twin.learning.tune._ended", sorted)
    folder = tmp_path / "search"
    if kept:
        with pytest.raises(TactipError, match="all trials failed or were pruned"):
            tune(data, folder, SETTINGS, log=lambda line: None)
        results = read_results(folder, SPACE)
        assert len(results) == SETTINGS.trials
        assert all(r["status"] == "failed" and "SIGKILL" in r["why"] for r in results)
        return
    with pytest.raises(TactipError, match=f"the process of trial 0 failed with exit code {exit_code}"):
        tune(data, folder, SETTINGS, log=lambda line: None)
    assert read_results(folder, SPACE) == []


@pytest.mark.slow
def test_tune_prune_ends_bad_trials(data, tmp_path):
    settings = TuneSettings(
        trials=6, random_trials=6, prune=True, min_epochs=2, space=SPACE, training=TrainSettings(epochs=4, patience=4)
    )
    results = tune(data, tmp_path / "search", settings, log=lambda line: None)
    pruned = [r for r in results if r["status"] == "pruned"]
    assert pruned
    assert all("had a lower loss after" in r["why"] for r in pruned)
    # A pruned trial still tells the search that its place is a bad one.
    assert all(np.isfinite(r["loss_when_pruned"]) for r in pruned)
    told = to_hyperopt_trials(results, Domain(lambda point: 0.0, expressions(settings.space))).losses()
    assert told == [r["loss"] if r["status"] == "ok" else r["loss_when_pruned"] for r in results]
    good = [r for r in results if r["status"] == "ok"]
    assert len(good) >= 2


@pytest.mark.slow
def test_tune_on_cluster_writes_same_files(data, tmp_path):
    """It also resumes. Needs the extra `cluster`."""
    pytest.importorskip("ray")
    for trials in ("2", "3"):
        command = search_command(data, tmp_path / "ray", "--cluster", "local", "--jobs", "2")
        command[command.index("--trials") + 1] = trials
        assert run_process(command).returncode == 0
        results = read_results(tmp_path / "ray", COMMAND_SPACE)
        assert sorted(r["trial"] for r in results) == list(range(int(trials)))
        assert all(r["status"] == "ok" and r["network"]["filters"] <= 4 for r in results)
    assert read_recipe(tmp_path / "ray" / "best.json").settings.epochs == 2


def test_tune_on_cluster_without_ray_raises(data, tmp_path, monkeypatch):
    """The error says what to install, and no folder is created."""
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(TactipError, match=r"pip install -e '\.\[cluster\]'"):
        tune_on_cluster(data, tmp_path / "search", SETTINGS, 1, "auto")
    assert not (tmp_path / "search").exists()


def test_clear_removes_interrupted_trials(tmp_path):
    """Their numbers are reused with other values."""
    ended = {"trial": 1, "status": "ok", "loss": 0.5, "values": {}}
    for index in range(3):
        record_start(tmp_path, index, {"trial": index, "values": {}})
    clear(tmp_path, [ended])
    assert sorted(path.name for path in (tmp_path / "trials").iterdir()) == ["0001", "0001.json"]


def test_tune_killed_between_its_files_is_completed_by_the_same_command(data, tmp_path):
    """A kill between results.jsonl and best.json of the last trial, and between the folder and its first file."""
    folder, settings = tmp_path / "search", replace(SETTINGS, trials=1)
    folder.mkdir()
    (folder / ".search.json.4194305.tmp").touch()
    tune(data, folder, settings, log=lambda line: None)
    whole = contents(folder)
    (folder / "best.json").unlink()
    (folder / "tune.png").unlink()
    (folder / "trials" / ".0000.json.4194305.tmp").touch()
    tune(data, folder, settings, log=lambda line: None)
    assert contents(folder) == whole
    assert {"best.json", "tune.png", "search.json"} <= set(whole)
