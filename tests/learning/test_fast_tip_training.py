"""Teaching of a tip: resuming, its file, and sets that it predicts."""

import json
import shutil

import numpy as np
import pytest
import torch

from helpers.set_commands import contents
from tactip_twin.commands import main as tactip
from tactip_twin.learning import fast_tip_training
from tactip_twin.learning.fast_tip_settings import FastTipSettings
from tactip_twin.learning.fast_tip_training import FAST_TIP, read_contacts, train_fast_tip
from tactip_twin.learning.tip_networks import Perceptron
from tactip_twin.sim.dataset.format import read_meta, read_rows
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, read_fast_tip
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.presets import design_named

SETTINGS = FastTipSettings(modes=20, width=24, members=2, steps=150, batch=64, trusted_fraction=1.0)
MAKE = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--workers", "2"]
OPTIONS = [
    *("--modes", "20", "--width", "24", "--members", "2", "--steps", "150", "--batch", "64"),
    *("--trusted-fraction", "1", "--threads", "1"),
]


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    for split, samples in (("train", 32), ("val", 12)):
        arguments = ["--keep-mesh", "--split", split, "--samples", str(samples), "--out", str(folder / split)]
        assert tactip.main([*MAKE, *arguments]) == 0
    return folder


@pytest.fixture(scope="module")
def taught(sets, tmp_path_factory):
    out = tmp_path_factory.mktemp("tip") / "tip"
    assert tactip.main(["fast-tip", str(sets / "train"), "--val", str(sets / "val"), "--out", str(out), *OPTIONS]) == 0
    return out / FAST_TIP


def test_tip_is_closer_to_the_simulation_than_the_undeformed_tip(taught, sets):
    errors = read_fast_tip(taught).provenance["errors"]
    assert 0 < errors["pins_mm"] < 0.5 < np.linalg.norm(read_contacts([sets / "val"]).harmonics[:, :, :3]) / 12
    assert errors["force"] < 0.5
    assert 0.8 < errors["trusted"] <= 1


def test_teaching_goes_on_from_a_learned_tip(taught, sets, tmp_path):
    """A single step at a tiny rate changes nothing; the settings' modes and layers do not count."""
    settings = FastTipSettings(modes=7, width=16, steps=1, batch=8, learning_rate=1e-6, trusted_fraction=1.0)
    train, val = [sets / "train"], sets / "val"
    before = read_fast_tip(taught)
    after = train_fast_tip(train, val, settings, tmp_path / "out", quiet=True, init_from=before)
    assert after.provenance["errors"] == pytest.approx(before.provenance["errors"], rel=1e-2)
    assert after.provenance["initial_weights"] == before.digest
    with pytest.raises(TactipError, match="other settings"):
        train_fast_tip(train, val, settings, tmp_path / "out", quiet=True)


def test_numpy_network_is_that_of_torch():
    network = Perceptron(9, 16, 3, 12)
    x = torch.randn(50, 9, generator=torch.Generator().manual_seed(0))
    assert np.allclose(network.exported()(x.numpy()), network(x).detach().numpy(), atol=1e-5)


def test_interrupted_teaching_resumes_to_the_same_bytes(taught, sets, tmp_path, monkeypatch):
    train, calls = fast_tip_training._train, []

    def stopped(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise Interrupted("stopped")
        return train(*arguments)

    torch.set_num_threads(1)
    monkeypatch.setattr(fast_tip_training, "_train", stopped)
    arguments = [sets / "train"], sets / "val", SETTINGS, tmp_path / "tip"
    with pytest.raises(Interrupted):
        train_fast_tip(*arguments, quiet=True)
    train_fast_tip(*arguments, quiet=True)
    assert len(calls) == 4  # two, of which one was interrupted, then the two that were missing
    assert (tmp_path / "tip" / FAST_TIP).read_bytes() == taught.read_bytes()
    with pytest.raises(TactipError, match="other settings"):
        train_fast_tip([sets / "train"], sets / "val", FastTipSettings(modes=5), tmp_path / "tip", quiet=True)


def test_prediction_has_the_symmetries_of_its_pins(taught):
    """A mirrored contact has the mirrored force, about as exactly as the networks have learned it."""
    tip = FastContacts(read_fast_tip(taught), design_named("tactip-127"))
    pose, shear = from_mm_deg([0, 0, -3, 5, -8, 0]), from_mm_deg([2, 1, 0, 1, 2, 3])
    contacts, _ = tip.predict(*(np.array([s.label(x) for s in SYMMETRIES["surface"]]) for x in (pose, shear)))
    first = contacts[0].force_n
    for symmetry, contact in zip(SYMMETRIES["surface"], contacts, strict=True):
        assert np.allclose(symmetry.in_sensor.T @ contact.force_n, first, atol=0.15 * np.linalg.norm(first))


def test_prediction_reads_forces_in_the_sensor_frame(taught, sets):
    contacts = read_contacts([sets / "val"])
    tip = read_fast_tip(taught)
    found = tip.predict(PinDecoder(design_named("tactip-127"), tip.modes), contacts.poses, contacts.shears)
    true = np.array(
        [[float(row[f"force_{c}_N"]) for c in "xyz"] for row in read_rows(sets / "val", read_meta(sets / "val"))]
    )
    assert np.corrcoef(found.forces_n[:, 2], true[:, 2])[0, 1] > 0.9
    assert (np.sign(found.forces_n[:, 2]) == np.sign(true[:, 2])).all()


def test_contacts_outside_of_the_learned_ranges_are_not_trusted(taught):
    tip = FastContacts(read_fast_tip(taught), design_named("tactip-127"))
    inside, outside = from_mm_deg([0, 0, -3, 2, 2, 0]), from_mm_deg([0, 0, -6, 2, 2, 0])
    _, trusted = tip.predict([inside, outside], np.zeros((2, 6)))
    assert trusted.tolist() == [True, False]
    assert tip.trusted(outside, np.zeros(6), SYMMETRIES["surface"]) is None


def fast(taught, folder, *options):
    return tactip.main(
        ["dataset", "make", "--fidelity", "fast", "--fast-tip", str(taught), "--renderer", "raster", "--out", str(folder)]
        + list(options)
    )


def test_predicted_set_is_the_same_with_any_worker_count(taught, tmp_path):
    for name, workers in (("a", "1"), ("b", "2")):
        assert fast(taught, tmp_path / name, "--samples", "24", "--augment-symmetry", "--workers", workers) == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    steps = {row["steps"] for row in read_rows(tmp_path / "a", read_meta(tmp_path / "a"))}
    assert "0" in steps


def test_contacts_that_are_not_trusted_are_simulated(taught, tmp_path, capsys):
    """Some depths are outside of what the tip learned."""
    depth = ["--pose.depth-mm", "-5.4", "-3"]
    assert fast(taught, tmp_path / "set", "--samples", "6", "--seed", "1", *depth) == 0
    rows = read_rows(tmp_path / "set", read_meta(tmp_path / "set"))
    for row in rows:
        assert (int(row["steps"]) > 0) >= (float(row["pose_z"]) < -5)
    assert {int(row["steps"]) > 0 for row in rows} == {True, False}
    assert f"{sum(int(row['steps']) > 0 for row in rows)} of them were simulated" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--snapshots-per-contact", "2"], "must be a file of the format 'tactip-twin sliding tip'"),
        (["--keep-mesh"], "keep_mesh needs a simulated tip"),
        (["--curvature-per-m", "0", "20"], "must be a file of the format 'tactip-twin sliding tip'"),
        (["--randomize-mechanics", "real"], "mechanics_randomization needs a learned tip of any materials"),
        (["--design", "tactip-331"], "the learned tip belongs to materials."),
        (["--task", "edge"], "is for surface, got --task edge"),
    ],
)
def test_sets_that_the_tip_has_not_learned_give_one_sentence(taught, tmp_path, capsys, options, words):
    assert fast(taught, tmp_path / "set", "--samples", "2", *options) == 1
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("damage", ["truncated", "altered", "array", "other"])
def test_damaged_files_give_one_sentence(taught, tmp_path, damage):
    path = tmp_path / "tip.npz"
    data = taught.read_bytes()
    if damage == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "other":
        np.savez(path, description=np.array(json.dumps({"format": "another"})))
    else:
        with np.load(taught) as arrays:
            changed = dict(arrays)
        if damage == "altered":
            changed["center"] = changed["center"] + 1
        else:
            del changed["network1_2"]
        np.savez(path, **changed)
    with pytest.raises(TactipError):
        read_fast_tip(path)


def test_sets_of_different_tips_are_refused(sets, tmp_path):
    other = tmp_path / "other"
    arguments = ["--keep-mesh", "--samples", "1", "--design", "nominal-127", "--out", str(other)]
    assert tactip.main([*MAKE, *arguments]) == 0
    with pytest.raises(TactipError, match="another shape or other materials"):
        read_contacts([sets / "train", other])


def test_set_without_meshes_is_refused(sets, tmp_path, capsys):
    plain = tmp_path / "plain"
    assert tactip.main([*MAKE, "--samples", "1", "--out", str(plain)]) == 0
    assert tactip.main(["fast-tip", str(plain), "--val", str(plain), "--out", str(tmp_path / "tip")]) == 1
    assert "make it with --keep-mesh" in capsys.readouterr().err
    shutil.rmtree(plain)
