"""The page of learning: every row is trained, kept and written; a stopped one goes on."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.learning_sets import write_fake_set
from tactip_twin.benchmarks.learning import learning as learned
from tactip_twin.benchmarks.options import LearningOptions
from tactip_twin.learning.configuration import PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.model import load_network
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.tactip_model.errors import TactipError

TINY = Recipe(PoseNetConfig(conv_layers=1, filters=2, dense_units=4, batch_size=8), TrainSettings(epochs=1))


KINDS = ("plain", "symmetric", "most", "looks", "taps", "bent")


@pytest.fixture
def options(tmp_path, monkeypatch):
    """Sets without physics and networks of no size."""
    monkeypatch.setattr(learned, "make", lambda jobs, workers, log: None)
    monkeypatch.setattr(learned, "rows", _tiny)
    folders = {name: tmp_path / name for name in ("data", "runs", "out")}
    options = LearningOptions(**folders, contacts=2, most=3, bent=2, looked=1, judged=8, judged_taps=8)
    for job in learned.jobs(options, KINDS):
        c = job.configuration
        write_fake_set(job.folder, c.task, c.split, c.samples, shear=c.shear)
    return options


ROWS = learned.rows


def _tiny(task, paper):
    return [replace(row, recipe=TINY, init_from="") for row in ROWS(task, paper)]


def test_the_sets_are_what_the_page_says():
    jobs = {
        (j.folder.parts[-3], j.folder.parts[-1]): j.configuration for j in learned.jobs(LearningOptions(task="edge"), KINDS)
    }
    judged = {(kind, split) for kind in ("plain", "taps") for split in ("val", "test")}
    assert set(jobs) == judged | {("taps", "train"), ("symmetric", "train"), ("looks", "train")}
    assert jobs["symmetric", "train"].samples == 16000
    assert (jobs["taps", "train"].samples, jobs["taps", "test"].samples, jobs["plain", "test"].samples) == (2000, 500, 2000)
    looks = jobs["looks", "train"]
    assert (looks.samples, looks.snapshots_per_contact, looks.shear, looks.augment_symmetry) == (
        7000,
        20,
        jobs["plain", "test"].shear,
        False,
    )
    assert jobs["taps", "train"].shear == Ranges()
    assert jobs["plain", "test"].split == "test"
    assert jobs["plain", "test"].design.name == "tactip-127"


def test_only_what_is_needed_is_made():
    sets = [(j.folder.parts[-3], j.folder.parts[-1]) for j in learned.jobs(LearningOptions(), ("taps",))]
    tests = [("plain", "test"), ("taps", "test"), ("bent", "test")]
    assert sorted(sets) == sorted([*tests, ("taps", "train"), ("taps", "val")])


def test_a_larger_set_that_is_there_is_not_asked_for_in_a_smaller_size(options):
    """Of the fixture's, made for the row `most`, the others take a part."""
    for kinds in (("plain",), ("plain", "most")):
        (train,) = (j for j in learned.jobs(options, kinds) if j.folder.parts[-3] == "symmetric")
        assert train.configuration.samples == options.most * 8
    (fewer,) = (j for j in learned.jobs(replace(options, most=4), ("plain",)) if j.folder.parts[-3] == "symmetric")
    assert fewer.configuration.samples == options.contacts * 8


def test_bent_surfaces_are_of_the_surface_task():
    jobs = [j.configuration for j in learned.jobs(LearningOptions(), KINDS) if j.folder.parts[-3] == "bent"]
    sets = {c.split: (c.samples, c.augment_symmetry) for c in jobs}
    assert sets == {"train": (16000, True), "val": (500, False), "test": (500, False)}
    assert {c.curvature_per_m for c in jobs} == {learned.BENT_PER_M}
    assert all(any(r.kind == "bent" for r in learned.rows(task, False)) == (task == "surface") for task in learned.PAPER)


def test_what_is_taught_further_fits_what_it_begins_with():
    further = [row for task in learned.PAPER for row in learned.rows(task, False) if row.init_from]
    assert [row.name for row in further] == ["laptop-further", "laptop-bent", "laptop-further"]
    assert all(load_network(row.init_from).config.shape() == row.recipe.network.shape() for row in further)


def test_a_page_is_written_and_what_was_trained_is_kept(options):
    first = learned.run(options, log=lambda line: None)
    assert [r["name"] for r in first["rows"]] == [r.name for r in learned.rows("surface", False)]
    page = (options.out / "learning.md").read_text()
    assert "| taps | sheared contacts |" in page and "| bent surfaces | flat surfaces |" in page
    assert f"{first['rows'][0]['mae']['sheared']['pose_z']:.3f}" in page
    assert (options.out / "learning.png").stat().st_size > 5000
    said = []
    again = learned.run(options, log=said.append)
    assert sum("already finished" in line for line in said) == len(first["rows"])
    assert [r["mae"] for r in again["rows"]] == [r["mae"] for r in first["rows"]]
    assert list(json.loads((options.out / "learning.json").read_text())) == ["surface"]
    one = learned.run(replace(options, only=("laptop",)), log=lambda line: None)
    assert [r["name"] for r in one["rows"]] == [r["name"] for r in first["rows"]]
    with pytest.raises(TactipError, match="unknown row 'lap': choose one of paper-16, laptop-plain"):
        learned.run(replace(options, only=("lap",)))


def test_rows_of_fewer_contacts_are_not_kept(options):
    learned.run(replace(options, only=("laptop",)), log=lambda line: None)
    other = learned.run(replace(options, contacts=1, only=("laptop-most",)), log=lambda line: None)
    assert [r["name"] for r in other["rows"]] == ["laptop-most"]


def test_rows_of_other_sets_are_kept_and_those_of_another_count_are_not(options):
    """Contacts on bent surfaces, and contacts with looks, are of some rows alone."""
    only = ("laptop-plain", "laptop-looks", "laptop-bent")
    first = learned.run(replace(options, only=only), log=lambda line: None)
    assert [row.get("contacts") for row in first["rows"]] == [None, 1, 2]
    quiet = {"log": lambda line: None}
    assert _names(learned.run(replace(options, only=("laptop",)), **quiet)) == [*only[:2], "laptop", "laptop-bent"]
    assert _names(learned.run(replace(options, bent=1, only=("laptop",)), **quiet)) == [*only[:2], "laptop"]
    assert _names(learned.run(replace(options, looked=2, only=("laptop",)), **quiet)) == ["laptop-plain", "laptop"]


def _names(record):
    return [row["name"] for row in record["rows"]]


def test_rows_keep_the_machine_that_they_were_measured_on(options, monkeypatch):
    monkeypatch.setattr(learned, "machine", lambda: {"processor": "old"})
    record = learned.run(replace(options, only=("laptop", "laptop-4")), log=lambda line: None)
    page = (options.out / "learning.md").read_text()
    assert page.count("processor old") == 1 and "without shear 8. On: processor old." in page
    # As rows were kept before: the record says it for all.
    before = {**record, "machine": {"processor": "older"}}
    before["rows"] = [{k: v for k, v in row.items() if k != "machine"} for row in record["rows"]]
    assert "On: processor older." in learned.markdown({"surface": before})
    (options.out / "learning.json").write_text(json.dumps({"surface": before}))
    monkeypatch.setattr(learned, "machine", lambda: {"processor": "new"})
    again = learned.run(replace(options, only=("laptop-4",)), log=lambda line: None)
    assert [row["machine"]["processor"] for row in again["rows"]] == ["older", "new"]
    page = (options.out / "learning.md").read_text()
    assert "`laptop` on: processor older." in page and "`laptop-4` on: processor new." in page


def test_the_record_that_is_there_is_kept(tmp_path):
    """Every row of it, by the counts that it was measured with, though rows of before do not say theirs."""
    (tmp_path / "learning.json").write_bytes((Path(__file__).parents[3] / "docs" / "learning.json").read_bytes())
    for task, record in json.loads((tmp_path / "learning.json").read_text()).items():
        counts = {name: record[name] for name in ("contacts", "most", "judged", "judged_taps")}
        kept = learned._kept(LearningOptions(task=task, out=tmp_path, **counts), counts)
        assert [row["name"] for row in kept] == [row["name"] for row in record["rows"]]
        assert all(row["machine"]["cores"] == "2" for row in kept)


def test_another_task_is_refused():
    with pytest.raises(TactipError, match="unknown task 'sphere': choose one of surface, edge"):
        learned.run(LearningOptions(task="sphere"))
