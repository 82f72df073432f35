"""Benchmark of learning: sets, rows, and the page."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.learning_sets import write_fake_set
from tactip_twin.benchmarks.learning import learning as learned
from tactip_twin.benchmarks.learning import learning_sets
from tactip_twin.benchmarks.learning.options import LearningOptions
from tactip_twin.learning.configuration import PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import load_network
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.errors import TactipError

TINY = Recipe(PoseNetConfig(conv_layers=1, filters=2, dense_units=4, batch_size=8), TrainSettings(epochs=1))


KINDS = ("plain", "symmetric", "large", "fast", "snapshots", "taps", "drawn", "slides", "256px")


@pytest.fixture
def options(tmp_path, monkeypatch):
    """Small options, with made-up sets and tiny networks."""
    monkeypatch.setattr(learned, "make", lambda jobs, workers, log: None)
    monkeypatch.setattr(learned, "rows", _tiny)
    monkeypatch.setattr(learning_sets, "_DRAWN_SET", 8)
    monkeypatch.setattr(learning_sets, "_SLIDE_SET", 8)
    monkeypatch.setattr(learning_sets, "_DRAWN_VAL", 8)
    monkeypatch.setattr(learning_sets, "with_noise", lambda samples, grey: samples)  # made-up sets have no pins
    folders = {name: tmp_path / name for name in ("data", "runs", "out")}
    options = LearningOptions(
        **folders,
        contacts=2,
        large_contacts=3,
        fast_images=4,
        slides=1,
        snapshot_contacts=1,
        test_contacts=8,
        other_test_contacts=8,
    )
    for job in learning_sets.jobs(options, KINDS):
        c = job.configuration
        write_fake_set(job.folder, c.task, c.split, c.samples, shear=c.shear)
    return options


ROWS = learned.rows


def _tiny(task, paper):
    return [replace(row, recipe=TINY, init_from="") for row in ROWS(task, paper)]


def test_sets_have_the_sizes_and_ranges_of_the_options():
    jobs = {
        (j.folder.parts[-3], j.folder.parts[-1]): j.configuration
        for j in learning_sets.jobs(LearningOptions(task="edge"), KINDS)
    }
    tests = {(kind, split) for kind in ("plain", "taps", "256px", "drawn", "slides") for split in ("val", "test")}
    tests |= {("light", "test"), ("fast", "val")}
    assert set(jobs) == tests | {
        (kind, "train") for kind in ("taps", "symmetric", "fast", "snapshots", "256px", "drawn", "slides")
    }
    wide = jobs["256px", "train"]
    assert (wide.design.image.size_px, jobs["256px", "test"].design.image.size_px) == (256, 256)
    assert (wide.samples, wide.fast_tip, wide.pose) == (500, jobs["fast", "train"].fast_tip, jobs["fast", "train"].pose)
    assert jobs["symmetric", "train"].samples == 16000
    predicted = jobs["fast", "train"]
    assert predicted.fast_tip == read_fast_tip(shipped_fast_tip("edge", "tactip-127")).digest
    assert (predicted.samples, predicted.keep_mesh, predicted.augment_symmetry) == (48000, False, True)
    assert predicted.seed != jobs["symmetric", "train"].seed  # the tip was taught on that one
    assert predicted.pose == jobs["light", "test"].pose == jobs["fast", "val"].pose
    assert predicted.pose.depth_mm == (-5, 0)
    assert not jobs["fast", "val"].fast_tip
    assert (jobs["taps", "train"].samples, jobs["taps", "test"].samples, jobs["plain", "test"].samples) == (2000, 500, 2000)
    snapshots = jobs["snapshots", "train"]
    assert (snapshots.samples, snapshots.snapshots_per_contact, snapshots.augment_symmetry) == (7000, 20, False)
    assert snapshots.shear == jobs["plain", "test"].shear
    assert jobs["taps", "train"].shear == Ranges()
    assert jobs["plain", "test"].split == "test"
    assert jobs["plain", "test"].design.name == "tactip-127"


def test_only_the_sets_of_the_chosen_rows_are_made():
    sets = [(j.folder.parts[-3], j.folder.parts[-1]) for j in learning_sets.jobs(LearningOptions(), ("taps",))]
    tests = [("plain", "test"), ("light", "test"), ("taps", "test")]
    assert sorted(sets) == sorted([*tests, ("taps", "train"), ("taps", "val")])
    assert [j.folder.parts[-3] for j in learning_sets.jobs(LearningOptions(), ())] == ["plain", "light", "taps"]
    sets = [(j.folder.parts[-3], j.folder.parts[-1]) for j in learning_sets.jobs(LearningOptions(), ("256px",))]
    assert sets == [("256px", split) for split in ("train", "val", "test")]
    wide = learning_sets.jobs(LearningOptions(), ("256px-slides",))
    sets = [(j.folder.parts[-3], j.folder.parts[-1]) for j in wide]
    assert sorted(sets) == [("256px", "test"), *(("256px-slides", split) for split in ("test", "train", "val"))]
    assert {j.configuration.design.image.size_px for j in wide} == {256}
    assert [j.configuration.is_curved for j in wide] == [j.folder.parts[-3] == "256px-slides" for j in wide]


def test_existing_larger_set_is_used_in_part(options):
    """The fixture's set is that of the row `laptop-large`; other rows use its first contacts."""
    for kinds in (("plain",), ("plain", "large")):
        (train,) = (j for j in learning_sets.jobs(options, kinds) if j.folder.parts[-3] == "symmetric")
        assert train.configuration.samples == options.large_contacts * 8
    larger = replace(options, large_contacts=4)
    (fewer,) = (j for j in learning_sets.jobs(larger, ("plain",)) if j.folder.parts[-3] == "symmetric")
    assert fewer.configuration.samples == options.contacts * 8


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_slides_on_surfaces_are_curved(task):
    options = LearningOptions(task=task)
    jobs = [j.configuration for j in learning_sets.jobs(options, ("slides",)) if j.folder.parts[-3] == "slides"]
    assert {c.split: c.samples for c in jobs} == {"train": 1500, "val": 600, "test": 600}
    assert {c.snapshots_per_contact for c in jobs} == {15}
    assert {c.curvature_per_m for c in jobs} == {learning_sets.CURVATURES_PER_M if task == "surface" else (0.0, 0.0)}
    assert [bool(c.fast_tip) for c in jobs] == [c.split == "train" for c in jobs]


def test_fine_tuned_networks_have_the_shape_of_their_initial_weights():
    """The outputs may differ: those that are new start from random weights."""
    for task in learned.PAPER:
        table = {row.name: row for row in learned.rows(task, False)}
        starts = {name: row.init_from for name, row in table.items() if row.init_from}
        expected = [
            "laptop-fine-tuned",
            "laptop-fast",
            "laptop-contact",
            "laptop-256px-noise",
            "laptop-any",
            *(["laptop-any-yaw"] if task == "edge" else []),
            "laptop-long",
            "laptop-noise",
            "laptop-light",
            "laptop-slides",
        ]
        expected += ["laptop-256px-slides"] if task == "surface" else []
        assert list(starts) == expected
        for name, start in starts.items():
            first = table[start].recipe.network if start in table else load_network(start).config
            shapes = [c.shape() | {"deviations": 0, "quantities": 0} for c in (first, table[name].recipe.network)]
            assert shapes[0] == shapes[1]


def test_page_is_written_and_finished_trainings_are_kept(options, monkeypatch):
    kinds = ("laptop-plain", "laptop-taps", "laptop", "laptop-256px", "laptop-noise", "laptop-slides")
    options = replace(options, only=kinds)
    first = learned.run(options, log=lambda line: None)
    assert [r["name"] for r in first["rows"]] == list(kinds)
    page = (options.out / "learning.md").read_text()
    assert "not sheared (`laptop-taps`) | single, sheared |" in page
    assert "sliding (on surfaces: curved ones) (`laptop-slides`)" in page
    assert f"{first['rows'][0]['mae']['sheared']['pose_z']:.3f}" in page
    assert "Not measured" in page.split("begin beta")[1]
    assert (options.out / "learning.png").stat().st_size > 5000
    monkeypatch.setattr(learned, "plot", lambda *_: None)  # it is drawn after every row, and has been looked at
    lines = []
    again = learned.run(options, log=lines.append)
    assert sum("already finished" in line for line in lines) == len(first["rows"])
    assert [r["mae"] for r in again["rows"]] == [r["mae"] for r in first["rows"]]
    assert list(json.loads((options.out / "learning.json").read_text())) == ["surface"]
    results = json.loads((options.out / "learning.json").read_text())
    results["surface"]["rows"].append(results["surface"]["rows"][0] | {"name": "laptop-gone"})
    (options.out / "learning.json").write_text(json.dumps(results))
    one = learned.run(replace(options, only=("laptop",)), log=lambda line: None)
    assert [r["name"] for r in one["rows"]] == [r["name"] for r in first["rows"]]
    with pytest.raises(TactipError, match="unknown row 'lap': choose one of paper-16, laptop-plain"):
        learned.run(replace(options, only=("lap",)))


def test_networks_are_compared_by_the_exponent_of_the_likelihood():
    """Means over the pose's components; rows without such an exponent are left out."""
    names = list(learned.PAPER["surface"])
    levels = {0.68: (0.6, 0.7, 0.8), 0.95: (0.9, 0.95, 1.0)}
    row = {
        "name": "laptop-beta-0.5",
        "mae": {"sheared": dict(zip(names, (0.03, 0.2, 0.25), strict=True))},
        "nll": dict(zip(names, (-1.0, 0.5, 1.1), strict=True)) | {"shear_x": 9.0},
        "reliability": [{"level": p, "coverage": dict(zip(names, c, strict=True))} for p, c in levels.items()],
    }
    text = learned._betas("surface", [row, row | {"name": "laptop"}])
    assert text.splitlines()[2:] == ["| 0.5 | 0.030 | 0.200 | 0.250 | 0.200 | 70% | 95% |"]
    assert learned._betas("surface", [row | {"name": "laptop"}]) == ""


@pytest.mark.slow
def test_noise_makes_pixels_white_and_keeps_labels(tmp_path):
    path = shipped_fast_tip("surface", "tactip-127")
    (job,) = (j for j in learning_sets.jobs(LearningOptions(data=tmp_path), ("drawn",)) if j.configuration.split == "train")
    few = replace(job.configuration, samples=3, fast_tip=read_fast_tip(path).digest)
    make([Job(few, tmp_path / "set", path)], 1, log=lambda line: None)
    samples = read_samples(tmp_path / "set")
    assert np.array_equal(learning_sets.with_noise(samples, 0).images, samples.images)
    noisy = learning_sets.with_noise(samples, 15)
    assert (noisy.images > 0).sum() > 2 * (samples.images > 0).sum()
    assert np.array_equal(noisy.targets, samples.targets)
    assert np.array_equal(learning_sets.with_noise(samples.take(slice(2, 3)), 0).images, samples.images[2:])


def test_rows_of_other_versions_and_other_test_sets_are_dropped(options, monkeypatch):
    def names(**changes):
        return [row["name"] for row in learned.run(replace(options, **changes), log=lambda line: None)["rows"]]

    monkeypatch.setattr(learned, "plot", lambda *_: None)  # it is drawn after every row
    assert names(only=("laptop",)) == ["laptop"]
    assert names(only=("laptop-4",)) == ["laptop", "laptop-4"]
    monkeypatch.setattr(learned, "version", lambda package: "9.9")
    assert names(only=("laptop",)) == ["laptop"]
    assert names(only=("laptop-4",)) == ["laptop", "laptop-4"]
    assert learned._other_rows(replace(options, test_contacts=4)) == []


def test_unknown_task_is_refused():
    with pytest.raises(TactipError, match="unknown task 'sphere': choose one of surface, edge"):
        learned.run(LearningOptions(task="sphere"))
