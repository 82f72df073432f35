"""The page of the search: trials, and differences from the paper's search; later trials are added to earlier ones."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.learning_sets import write_fake_set
from tactip_twin.benchmarks.learning import search as searched
from tactip_twin.benchmarks.learning.options import SearchOptions
from tactip_twin.learning.configuration import PoseNetConfig, SearchSpace, TrainSettings, TuneSettings
from tactip_twin.tactip_model.errors import TactipError

TINY = TuneSettings(
    random_trials=2,
    space=SearchSpace(max_conv_layers=2, max_filters=4, max_dense_layers=1, max_dense_units=4, downsample=2),
    training=TrainSettings(epochs=1),
)


@pytest.fixture
def options(tmp_path, monkeypatch):
    monkeypatch.setattr(searched, "make", lambda jobs, workers, log: None)
    monkeypatch.setitem(searched.BUDGETS, "laptop", TINY)
    monkeypatch.setattr(searched, "LONG_TRAINING", TrainSettings(epochs=2))
    folders = {name: tmp_path / name for name in ("data", "runs", "out")}
    options = SearchOptions(**folders, trials=2, jobs=1, contacts=12, long_contacts=16, val_contacts=8, test_contacts=8)
    for job in searched.jobs(options):
        c = job.configuration
        write_fake_set(job.folder, c.task, c.split, c.samples)
    return options


def test_search_sets_are_predicted_and_the_test_set_is_simulated(options):
    sets = {str(job.folder.relative_to(options.data)): job.configuration for job in searched.jobs(options)}
    samples = {"short/train": 12, "short/val": 8, "long/train": 16, "long/val": 8, "test/test": 8}
    assert {name: c.samples for name, c in sets.items()} == {f"surface/{name}": n for name, n in samples.items()}
    assert all(bool(c.fast_tip) != (c.split == "test") and not c.augment_symmetry for c in sets.values())


def test_importance_is_one_for_the_only_parameter_that_matters_and_small_for_noise():
    rng = np.random.default_rng(0)
    results = []
    for _ in range(400):
        network = dataclasses.asdict(PoseNetConfig(filters=int(2 ** rng.integers(1, 6)), dropout=float(rng.uniform(0, 0.5))))
        loss = 1.0 / network["filters"] + 1e-3 * rng.uniform()
        results.append({"status": "ok", "loss": loss, "network": network})
    found = searched.importance(results)
    assert found["filters"] > 0.9 and found["dropout"] < 0.05
    # A pruned trial counts with the loss that it had.
    pruned = [{"status": "pruned", "loss": None, "loss_when_pruned": r["loss"], "network": r["network"]} for r in results]
    assert searched.importance(pruned) == found


@pytest.mark.slow
def test_page_is_written_and_search_can_be_extended(options):
    searched.run(options, log=lambda line: None)
    record = searched.run(replace(options, trials=3), log=lambda line: None)
    assert [t["trial"] for t in record["trials"]] == [0, 1, 2]
    page = (options.out / "search.md").read_text()
    assert "3 trials (3 ok); 12 contacts for training, 8 for validation." in page
    assert "trials 3 instead of 300" in page and "space.max_filters 4 instead of 512" in page
    assert "training.epochs 1 instead of 500" in page
    assert "l1" not in page.split("Differences from the paper:")[1].split("<!--")[0]
    best = min(record["trials"], key=lambda t: t["loss"])
    assert page.index(f"| {best['trial']} | {best['loss']:.4g} |") > 0
    assert (options.out / "search_surface.png").stat().st_size > 5000
    assert list(json.loads((options.out / "search.json").read_text())) == ["surface"]
    assert [set(t["mae"]) for t in record["long"]] == 3 * [{"pose_z", "pose_Rx", "pose_Ry"}]
    assert [t["epochs"] for t in record["long"]] == [2, 2, 2]
    # The page can be written again, and by who has only the results.
    again = searched.run(replace(options, page_only=True), log=lambda line: None)
    assert again["trials"] == record["trials"] and [t["trial"] for t in again["long"]] == [
        t["trial"] for t in record["long"]
    ]


def test_paper_search_lists_no_reductions():
    import dataclasses

    assert searched.differences(dataclasses.asdict(TuneSettings())) == []


def test_another_task_is_refused():
    with pytest.raises(TactipError, match="unknown task 'sphere': choose one of surface, edge"):
        searched.run(SearchOptions(task="sphere"))


def test_record_without_a_new_field_lists_no_reduction():
    settings = dataclasses.asdict(TuneSettings())
    del settings["training"]["optics_ranges"]
    assert searched.differences(settings) == []
