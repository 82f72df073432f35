"""Sets of shards have the samples of a set in one folder, even after interruptions, and are read as one set."""

import json
import shutil

import numpy as np
import pytest
import torch

from helpers.learning_sets import mend_checksums
from helpers.set_commands import contents, kill_unfinished, run_process, samples_found
from tactip_twin.commands import main as tactip
from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.data import read_samples
from tactip_twin.sim.dataset.format import PARTIAL, labels_sha256, read_configuration, read_dataset, read_meta, read_pins
from tactip_twin.sim.dataset.partial_record import unpack_finished_set
from tactip_twin.sim.dataset.shards import ShardFinalizer

SAMPLES, SHARD = 5, 2


def options(folder, *more, samples=SAMPLES, shard=SHARD):
    given = ["--fidelity", "draft", "--renderer", "raster", "--samples", str(samples), "--shard-samples", str(shard)]
    return ["dataset", "make", *given, "--out", str(folder), *more]


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """The set in one folder."""
    folder = tmp_path_factory.mktemp("flat") / "set"
    assert tactip.main(options(folder, "--workers", "1", shard=10_000)) == 0
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The set of shards."""
    folder = tmp_path_factory.mktemp("whole") / "set"
    assert tactip.main(options(folder, "--workers", "1")) == 0
    return folder


@pytest.fixture
def copy(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "set")
    return tmp_path / "set"


def test_sharded_samples_equal_those_of_one_folder(flat, whole):
    assert sorted(path.name for path in whole.iterdir()) == ["meta.json", "run.json", *(f"shard-0000{k}" for k in range(3))]
    one, many = read_dataset(flat), read_dataset(whole)
    assert one.images == many.images
    assert np.array_equal(one.poses, many.poses) and np.array_equal(one.shears, many.shears)
    assert all(np.array_equal(one.image(i), many.image(i)) for i in range(SAMPLES))
    for ours, theirs in zip(read_pins(flat, one.meta), read_pins(whole, many.meta), strict=True):
        assert np.array_equal(ours, theirs)
    tables = [(part / "targets.csv").read_text().splitlines()[1:] for part in sorted(whole.glob("shard-*"))]
    assert [len(rows) for rows in tables] == [2, 2, 1]
    assert [row for rows in tables for row in rows] == (flat / "targets.csv").read_text().splitlines()[1:]
    assert many.meta["samples"] == {"asked": SAMPLES, "kept": SAMPLES, "failed": 0}


def test_all_who_read_sets_take_it_as_one(flat, whole, tmp_path):
    samples = read_samples(whole)
    assert len(samples) == SAMPLES and samples.subset_sha256() is None
    drawn, plain = OpticsAugmentation(samples).render_plain(torch.arange(SAMPLES)).numpy() > 0, samples.images > 0
    assert (drawn == plain).mean() > 0.98
    assert labels_sha256(read_meta(whole)) != labels_sha256(read_meta(flat))
    for folder in (flat, whole):
        name = f"{folder.parent.name}.png"
        assert tactip.main(["dataset", "show", str(folder), "--out", str(tmp_path / name)]) == 0
        recording = ["dataset", "record", str(folder), "--sample", "4", "--out", str(tmp_path / folder.parent.name)]
        assert tactip.main(recording) == 0
    one, other = sorted(tmp_path.glob("*.png"))
    assert one.read_bytes() == other.read_bytes()


def test_two_workers_make_the_same_bytes(whole, tmp_path):
    assert tactip.main(options(tmp_path / "set", "--workers", "2")) == 0
    assert contents(tmp_path / "set") == contents(whole)


def test_eight_copies_of_a_contact_stay_in_one_shard(tmp_path, capsys):
    assert tactip.main(options(tmp_path / "odd", "--augment-symmetry")) == 1
    assert "shard_samples must be at least 8, the number of samples of one contact, got 2" in capsys.readouterr().err
    assert tactip.main(options(tmp_path / "set", "--augment-symmetry", samples=12, shard=8)) == 0
    assert tactip.main(options(tmp_path / "flat", "--augment-symmetry", samples=12, shard=16)) == 0
    one, other = read_dataset(tmp_path / "set"), read_dataset(tmp_path / "flat")
    assert np.array_equal(one.poses, other.poses)
    assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0


def test_unevenly_filled_shard_can_grow(tmp_path):
    """A shard holds the 8 samples of one contact, so a set of 12 samples has shards already, and grows by shards."""
    for samples in (12, 20):
        assert tactip.main(options(tmp_path / "set", "--augment-symmetry", samples=samples, shard=12)) == 0
        assert tactip.main(["dataset", "verify", str(tmp_path / "set")]) == 0
    assert [len(read_dataset(part).images) for part in sorted((tmp_path / "set").glob("shard-*"))] == [8, 8, 4]


def test_closing_a_shard_twice_is_harmless(copy, whole):
    """As after the loss of a worker before or after the end of its task."""
    shard = copy / "shard-00001"
    configuration = read_configuration(read_meta(copy), copy)
    (shard / PARTIAL).mkdir()
    unpack_finished_set(shard)
    assert not (shard / "meta.json").exists()
    closing = ShardFinalizer(1, (whole / "shard-00001" / "run.json").read_bytes())
    for _ in range(2):
        closing(configuration, copy)
        assert not (shard / PARTIAL).exists()
        assert contents(copy) == contents(whole)
        assert (shard / "run.json").read_bytes() == closing.run_json
        (shard / PARTIAL).mkdir()
    assert repr(closing) == "the completion of shard-00001"


def test_unfinished_shard_is_closed_on_resuming(copy, whole, capsys):
    for name in ("meta.json", "run.json"):
        (copy / name).unlink()
    for place in (copy, copy / "shard-00002"):
        (place / PARTIAL).mkdir()
    unpack_finished_set(copy / "shard-00002")
    assert tactip.main(options(copy)) == 0
    assert "complete already" in capsys.readouterr().out
    assert contents(copy) == contents(whole)


@pytest.mark.parametrize("before", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_set_grows_from_one_folder_or_fewer_shards(whole, tmp_path, before):
    assert tactip.main(options(tmp_path / "set", samples=before)) == 0
    assert (tmp_path / "set" / "targets.csv").exists() == (before <= SHARD)
    assert tactip.main(options(tmp_path / "set")) == 0
    assert contents(tmp_path / "set") == contents(whole)


@pytest.mark.parametrize("moved", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 4))])
def test_growth_that_is_killed_while_it_moves_goes_on(whole, tmp_path, monkeypatch, capsys, moved):
    folder = tmp_path / "set"
    assert tactip.main(options(folder, samples=1)) == 0

    rename, left = type(folder).rename, iter(range(moved))

    def killed(path, target):
        if next(left, None) is None:
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(type(folder), "rename", killed)
        assert tactip.main(options(folder)) != 0
    assert tactip.main(["dataset", "verify", str(folder)]) == 1
    assert "unfinished" in capsys.readouterr().err
    assert tactip.main(options(folder, samples=1)) == 1
    assert "has 5 samples: samples must be 5 until the set is finished, got 1" in capsys.readouterr().err
    assert tactip.main(options(folder)) == 0
    assert contents(folder) == contents(whole)


@pytest.mark.slow
def test_kill_loses_no_shard(whole, tmp_path):
    folder = tmp_path / "set"
    command = options(folder, "--workers", "2")
    kill_unfinished(command, folder, (folder / "shard-00000" / "meta.json").exists)
    # A shard's partial records are removed after its meta.json is written: a kill in between leaves some of them.
    shard = folder / "shard-00000"
    files = [path for path in shard.rglob("*") if path.is_file() and PARTIAL not in path.relative_to(shard).parts]
    closed = {path: path.stat().st_mtime_ns for path in files}
    resumed = run_process(command)
    assert resumed.returncode == 0, resumed.stderr
    # The number varies, because the orphaned workers still finish their contacts.
    assert samples_found(resumed.stderr + resumed.stdout) >= SHARD
    assert all(path.stat().st_mtime_ns == written for path, written in closed.items())
    assert contents(folder) == contents(whole)


def test_fewer_samples_than_there_are_are_refused(copy, capsys):
    for fewer in (1, 4):
        assert tactip.main(options(copy, samples=fewer)) == 1
        output = capsys.readouterr().err
        assert f"has 5 samples: samples must be at least 5, got {fewer}" in output


def test_large_set_of_one_folder_is_unchanged(tmp_path, capsys):
    """Made as before shards were introduced."""
    folder = tmp_path / "set"
    assert tactip.main(options(folder, samples=1)) == 0
    meta = json.loads((folder / "meta.json").read_text())
    meta["configuration"]["samples"] = 3
    (folder / "meta.json").write_text(json.dumps(meta))
    mend_checksums(folder)
    before = {path.name for path in folder.iterdir()}
    assert tactip.main(options(folder)) == 1
    assert "it has 3 samples in one folder, more than the 2 of a shard" in capsys.readouterr().err
    assert before <= {path.name for path in folder.iterdir()}
    assert len(read_dataset(folder).images) == 1


def _alter_manifest(folder):
    meta = json.loads((folder / "meta.json").read_text())
    meta["samples"] = {"asked": 12, "kept": 11, "failed": 1}
    (folder / "meta.json").write_text(json.dumps(meta))


def _swap_shards(folder):
    (folder / "shard-00000").rename(folder / "x")
    (folder / "shard-00001").rename(folder / "shard-00000")
    (folder / "x").rename(folder / "shard-00001")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda f: (f / "shard-00001" / "images" / "image_00003.png").unlink(),
            "shard-00001/images/image_00003.png: missing",
        ),
        (lambda f: shutil.rmtree(f / "shard-00002"), "shard-00002/meta.json: missing"),
        (lambda f: (f / "shard-00007").mkdir(), "shard-00007: not a shard of this set"),
        (lambda f: (f / "shard-00000" / "meta.json").write_text("{}"), "shard-00000/meta.json: altered"),
        (_alter_manifest, "meta.json: samples are"),
        (_swap_shards, "shard-00000: has another configuration"),
    ],
)
def test_damage_is_told_by_shard(copy, capsys, damage, words):
    damage(copy)
    assert tactip.main(["dataset", "verify", str(copy)]) == 1
    assert words in capsys.readouterr().err


def test_results_are_json_for_scripts(copy, tmp_path, capsys):
    assert tactip.main(options(copy, "--json")) == 0
    (made,) = json.loads(capsys.readouterr().out)
    assert (made["kept"], made["failed"], made["made"]) == (SAMPLES, 0, 0)
    assert tactip.main(["dataset", "verify", str(copy), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["problems"] == []
    shutil.rmtree(copy / "shard-00001")
    assert tactip.main(["dataset", "verify", str(copy), "--json"]) == 1
    assert "shard-00001/meta.json: missing" in json.loads(capsys.readouterr().out)["problems"]
