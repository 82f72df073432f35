"""Training: determinism, resuming, validation of the input, and evaluation."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.learning_sets import mend_checksums, write_fake_set, write_fake_splits
from tactip_twin.commands import main as tactip
from tactip_twin.learning import checkpoint
from tactip_twin.learning import train as train_module
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.evaluate import binned, evaluate, tables
from tactip_twin.learning.model import load_model, net_sha256, save_model, to_input
from tactip_twin.learning.muon import Muon, inner_weights
from tactip_twin.learning.recipes import read_recipe, recipe_json
from tactip_twin.learning.train import train
from tactip_twin.learning.training import Training, TrainingDiverged
from tactip_twin.sim.dataset.format import encode_image, read_dataset
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.input_files import with_checksum
from tactip_twin.tactip_model.presets import design_named

NET = PoseNetConfig(conv_layers=2, filters=6, dense_units=24, dropout=0.1, l1=0, l2=1e-5, batch_size=8)
QUICK = TrainSettings(epochs=4, learning_rate=3e-3)
TACTIP = str(Path(sys.executable).parent / "tactip")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_fake_splits(tmp_path_factory.mktemp("sets") / "surface", samples=48)


@pytest.fixture(scope="module")
def splits(data):
    return read_splits(data)


def weights(folder):
    return torch.load(folder / "model.pt", weights_only=True)


def same(a, b):
    return all(torch.equal(a[k], b[k]) for k in a) and a.keys() == b.keys()


def quiet(*arguments, **options):
    return train(*arguments, log=lambda line: None, quiet=True, **options)


def test_epochs_small_set_reaches_min_steps(splits):
    """48 images in batches of 8 are 6 steps per epoch, so 20 steps take 4 epochs."""
    assert Training(*splits, NET, TrainSettings(epochs=2, min_steps=20)).epochs == 4
    assert Training(*splits, NET, TrainSettings(epochs=5, min_steps=20)).epochs == 5


def test_train_set_without_pins_disables_augmentation(data, tmp_path, capsys):
    """The recipe draws images anew, for which a real set has no pins; asked for by name, that is refused."""
    command = ["train", "--data", str(data), "--network.conv-layers", "1", "--training.min-steps", "1"]
    command += ["--training.epochs", "1"]
    assert tactip.main([*command, "--out", str(tmp_path / "run")]) == 0
    assert "has no pins: its images are taken as they are" in capsys.readouterr().err
    assert load_model(tmp_path / "run").provenance["settings"]["augmented_fraction"] == 0
    assert tactip.main([*command, "--out", str(tmp_path / "other"), "--training.augmented_fraction", "1"]) == 1
    assert "only simulated sets have pins" in capsys.readouterr().err
    assert not (tmp_path / "other" / "model.json").exists()


@pytest.mark.parametrize("shape", [(6, 20), (20, 6), (8, 3, 4, 4)])
def test_muon_step_is_nearly_orthogonal(shape):
    """Its singular values are near one for any gradient; its singular vectors are those of the gradient."""
    torch.manual_seed(0)
    weight = torch.nn.Parameter(torch.zeros(shape))
    gradient = torch.randn(shape).reshape(shape[0], -1)
    left, values, right = torch.linalg.svd(gradient, full_matrices=False)
    gradient = left @ torch.diag(torch.logspace(0, -1.5, len(values))) @ right
    weight.grad = gradient.reshape(shape)
    Muon([weight], lr=0.1).step()
    stretch = max(1, shape[0] / gradient.shape[1]) ** 0.5
    moved = -weight.detach().reshape(shape[0], -1) / (0.1 * stretch)
    seen = left.T @ moved @ right.T
    assert torch.allclose(seen, torch.diag(seen.diagonal()), atol=1e-4)
    assert 0.6 < seen.diagonal().min() < seen.diagonal().max() < 1.3


def test_muon_optimizes_inner_weights_and_beats_adam(splits):
    settings = TrainSettings(epochs=8, learning_rate=2e-3, muon_learning_rate=0.02)
    training = Training(*splits, NET, settings)
    inner = inner_weights(training.net)
    assert [tuple(p.shape) for p in inner] == [(6, 6, 3, 3), (24, 6 * 8 * 8)]
    for _ in range(8):
        training.train_epoch()
    adam = Training(*splits, NET, TrainSettings(epochs=8, learning_rate=2e-3))
    for _ in range(8):
        adam.train_epoch()
    assert training.history[-1]["loss"] < adam.history[-1]["loss"]


def test_train_fake_set_beats_mean_prediction(splits, tmp_path):
    """The network predicts the labels far better than their mean does."""
    history = quiet(*splits, NET, TrainSettings(epochs=60, patience=60, learning_rate=3e-3), tmp_path / "run")
    val = splits[1]
    by_mean = (((val.targets - splits[0].targets.mean(0)) / val.labels.scale) ** 2).sum(1).mean()
    assert min(h["val_loss"] for h in history) < 0.1 * by_mean
    model = load_model(tmp_path / "run")
    error = ((model.predict(val.images) - val.targets) / val.labels.scale) ** 2
    assert error.sum(1).mean() == pytest.approx(min(h["val_loss"] for h in history), rel=1e-4)


def test_train_bfloat16_matches_float32_loss(splits):
    """With bfloat16 in convolutions and Muon, the final loss differs by at most 5 % of the initial loss."""
    ends = []
    for precision in ("float32", "bfloat16"):
        training = Training(
            *splits, NET, TrainSettings(epochs=12, learning_rate=2e-3, muon_learning_rate=0.02, precision=precision)
        )
        for _ in range(12):
            training.train_epoch()
        ends.append(training.history)
    start = ends[0][0]["loss"]
    assert ends[0][-1]["loss"] < 0.3 * start
    assert ends[1] != ends[0]
    assert ends[1][-1]["loss"] == pytest.approx(ends[0][-1]["loss"], abs=0.05 * start)


def test_train_same_seed_gives_same_weights(splits, tmp_path):
    for name in ("a", "b"):
        quiet(*splits, NET, QUICK, tmp_path / name)
    quiet(*splits, NET, TrainSettings(epochs=4, learning_rate=3e-3, seed=1), tmp_path / "c")
    assert same(weights(tmp_path / "a"), weights(tmp_path / "b"))
    assert not same(weights(tmp_path / "a"), weights(tmp_path / "c"))


def test_train_keeps_global_random_state(splits, tmp_path):
    before = torch.random.get_rng_state()
    quiet(*splits, NET, TrainSettings(epochs=1), tmp_path / "run")
    assert torch.equal(before, torch.random.get_rng_state())


@pytest.mark.parametrize("epochs", [1, 4])
def test_train_killed_after_last_checkpoint_resumes(splits, tmp_path, monkeypatch, epochs):
    """The checkpoint is written first; the other files are recreated from it."""
    settings = TrainSettings(epochs=epochs, learning_rate=3e-3)
    quiet(*splits, NET, settings, tmp_path / "whole")
    save = train_module.save_checkpoint

    def killed(training, folder, record):
        if not training.finished:
            return save(training, folder, record)
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "save_model", _cut)
            return save(training, folder, record)

    def _cut(*_):
        raise SystemError("killed")

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "save_checkpoint", killed)
        with pytest.raises(SystemError):
            quiet(*splits, NET, settings, tmp_path / "killed")
    history = quiet(*splits, NET, settings, tmp_path / "killed")
    assert same(weights(tmp_path / "whole"), weights(tmp_path / "killed"))
    outcome = load_model(tmp_path / "killed").provenance["outcome"]
    assert outcome == load_model(tmp_path / "whole").provenance["outcome"]
    assert outcome["finished"] and outcome["epochs"] == len(history) == epochs
    assert not (tmp_path / "killed" / "checkpoint.pt").exists()


def test_train_command_killed_resumes_to_same_weights(data, splits, tmp_path):
    settings = ["--training.epochs", "40", "--training.patience", "40", "--training.learning-rate", "0.003"]
    network = [
        "--network.conv-layers",
        "2",
        "--network.filters",
        "6",
        "--network.dense_units",
        "24",
        "--network.batch-size",
        "8",
    ]
    command = [TACTIP, "train", "--data", str(data), "--recipe", "paper", *settings, *network]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*command, "--out", str(whole)], check=True, capture_output=True)
    process = subprocess.Popen([*command, "--out", str(killed)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not (killed / "metrics.jsonl").exists() or len(read_metrics(killed)) < 3:
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (killed / "checkpoint.pt").exists()
    again = subprocess.run([*command, "--out", str(killed)], check=True, capture_output=True, text=True)
    assert "resuming after epoch" in again.stderr
    assert same(weights(whole), weights(killed))
    losses = [[(h["epoch"], h["loss"], h["val_loss"]) for h in read_metrics(f)] for f in (whole, killed)]
    assert losses[0] == losses[1]
    assert not (killed / "checkpoint.pt").exists()
    assert "already finished" in subprocess.run([*command, "--out", str(killed)], capture_output=True, text=True).stderr


def test_train_patience_exhausted_keeps_best_epoch(splits, tmp_path):
    history = quiet(*splits, NET, TrainSettings(epochs=300, patience=3, learning_rate=0.02), tmp_path / "run")
    losses = [h["val_loss"] for h in history]
    assert len(losses) < 300
    assert int(np.argmin(losses)) == len(losses) - 4
    outcome = load_model(tmp_path / "run").provenance["outcome"]
    assert outcome["best_epoch"] == len(losses) - 3
    assert outcome["finished"]


def test_train_epoch_nan_loss_raises(splits):
    training = Training(*splits, NET, QUICK)
    with torch.no_grad():
        training.net.dense[1].weight.fill_(float("nan"))
    with pytest.raises(TrainingDiverged, match="the training diverged"):
        training.train_epoch()


def test_train_locked_folder_raises(splits, tmp_path):
    def again(history):
        with pytest.raises(TactipError, match="another command is training in"):
            quiet(*splits, NET, QUICK, tmp_path / "run")
        return False

    quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=again)
    assert load_model(tmp_path / "run").provenance["outcome"]["finished"]


def test_train_record_without_new_fields_is_recognized(splits, tmp_path):
    """A field that was added later counts as having its default."""
    history = quiet(*splits, NET, QUICK, tmp_path / "run")
    path = tmp_path / "run" / "model.json"
    description = json.loads(path.read_text())
    del (
        description["provenance"]["network"]["pixel_unshuffle"],
        description["provenance"]["settings"]["augmentation_strength"],
    )
    path.write_text(json.dumps(with_checksum(description)))
    assert quiet(*splits, NET, QUICK, tmp_path / "run") == history
    description["provenance"]["network"]["filters"] += 1
    path.write_text(json.dumps(with_checksum(description)))
    with pytest.raises(TactipError, match=r"holds a training with other settings \(network.filters is 7 there, 6 here\)"):
        quiet(*splits, NET, QUICK, tmp_path / "run")


def test_train_folder_of_other_training_raises(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    with pytest.raises(TactipError, match=r"holds a training with other settings \(settings.epochs is 4 there, 5 here\)"):
        quiet(*splits, NET, TrainSettings(epochs=5), tmp_path / "run")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    with pytest.raises(TactipError, match="holds no training"):
        quiet(*splits, NET, QUICK, tmp_path / "other")


def test_train_init_from_starts_with_its_predictions(splits, tmp_path):
    """The initial predictions are those of the initial network, also for labels with other ranges."""
    quiet(*splits, NET, QUICK, tmp_path / "first")
    first = load_model(tmp_path / "first")
    ranges = replace(POSE_RANGES["surface"], depth_mm=(-10, -1), roll_deg=(-5, 5))
    wider = read_splits(write_fake_splits(tmp_path / "wider", pose=ranges))
    training = Training(*wider, NET, QUICK, init_from=first)
    begun = training.net.eval()(to_input(torch.from_numpy(wider[1].images))).detach().numpy() * training.labels.scale
    np.testing.assert_allclose(begun, first.predict(wider[1].images), rtol=1e-4, atol=1e-3)

    quiet(*splits, NET, QUICK, tmp_path / "second", init_from=first)
    assert load_model(tmp_path / "second").provenance["initial_weights"] == net_sha256(first.net)
    assert read_metrics(tmp_path / "second")[0]["loss"] < read_metrics(tmp_path / "first")[0]["loss"]
    initial_weights = f'"{net_sha256(first.net)}"'
    for folder, start, there, here in (("first", first, "null", initial_weights), ("second", None, initial_weights, "null")):
        message = f"holds a training with other settings \\(initial_weights is {there} there, {here} here\\)"
        with pytest.raises(TactipError, match=message):
            quiet(*splits, NET, QUICK, tmp_path / folder, init_from=start)
    with pytest.raises(TactipError, match=r"does not match the model to be trained: dense_units is 24, expected 8$"):
        quiet(*splits, replace(NET, dense_units=8), QUICK, tmp_path / "third", init_from=first)
    assert not (tmp_path / "third").exists()


def test_train_command_start_uses_its_layers(data, splits, tmp_path, capsys):
    """Its layers are used; a network for another image width is rejected."""
    quiet(*splits, NET, QUICK, tmp_path / "first")
    given = ["train", "--data", str(data), "--training.epochs", "1", "--training.min-steps", "0"]
    given += ["--training.augmented_fraction", "0"]
    assert tactip.main([*given, "--out", str(tmp_path / "on"), "--init-from", str(tmp_path / "first")]) == 0
    assert load_model(tmp_path / "on").config == NET
    assert tactip.main([*given, "--out", str(tmp_path / "off"), "--init-from", "surface-tactip-127"]) == 1
    assert "image width is 128, expected 40" in capsys.readouterr().err
    assert not (tmp_path / "off").exists()


@pytest.mark.parametrize("damage", [lambda b: b"rubbish", lambda b: b[: len(b) // 2], lambda b: b""])
def test_train_damaged_checkpoint_raises(splits, tmp_path, damage):
    with pytest.raises(Interrupted):
        quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=_stop)
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(TactipError, match="delete it to restart the training"):
        quiet(*splits, NET, QUICK, tmp_path / "run")


def test_train_interrupted_keeps_completed_epochs(splits, tmp_path):
    with pytest.raises(Interrupted, match="completed epochs are saved: run the same command to resume"):
        quiet(*splits, NET, QUICK, tmp_path / "stopped", should_prune=_stop)
    assert len(read_metrics(tmp_path / "stopped")) == 2
    quiet(*splits, NET, QUICK, tmp_path / "stopped")
    quiet(*splits, NET, QUICK, tmp_path / "whole")
    assert same(weights(tmp_path / "stopped"), weights(tmp_path / "whole"))


def _stop(history):
    """Interrupt after the second epoch."""
    if len(history) == 2:
        raise KeyboardInterrupt
    return False


def test_error_weights_components_by_scale(splits):
    """Each component has the weight 1 / (maximum absolute value)²."""
    training = Training(*splits, NET, QUICK)
    _, val = splits
    with torch.no_grad():
        for parameter in training.net.parameters():
            parameter.zero_()
    expected = ((val.targets / [5, 15, 15]) ** 2).sum(1).mean()
    assert training.error(training._val_images, training._val_targets) == pytest.approx(expected, rel=1e-5)


# Invalid input is rejected before training.


def damaged(tmp_path, damage):
    folder = write_fake_splits(tmp_path / "data", samples=6)
    damage(folder / "train")
    if (folder / "train" / "meta.json").exists():
        mend_checksums(folder / "train")  # so that the content is judged
    return folder


def edit_row(column, value):
    def damage(folder):
        lines = (folder / "targets.csv").read_text().splitlines()
        at = lines[0].split(",").index(column)
        cells = lines[3].split(",")
        cells[at] = value
        lines[3] = ",".join(cells)
        (folder / "targets.csv").write_text("\n".join(lines) + "\n")

    return damage


def keep_header(folder):
    (folder / "targets.csv").write_text((folder / "targets.csv").read_text().splitlines()[0] + "\n")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"images": {}}))


def resize_one(folder):
    (folder / "images" / "image_00002.png").write_bytes(encode_image(np.zeros((20, 20), np.uint8)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (keep_header, "has no samples: at least one is needed"),
        (edit_row("pose_z", "nan"), "pose_z of image_00002.png .* must be from -5 to -1 mm .*, got nan"),
        (edit_row("pose_Rx", "15.2"), "pose_Rx of image_00002.png .* must be from -15 to 15 ° .*, got 15.2"),
        (edit_row("pose_z", "deep"), "a cell that is not a number"),
        (edit_row("shear_x", "inf"), r"shear of image_00002.png .* must be finite, got \[inf, "),
        (lambda f: (f / "images" / "image_00001.png").write_bytes(b"no image"), "image_00001.png cannot be read"),
        (resize_one, "image_00002.png .* is 20 by 20 px, but the first image is 40 by 40 px"),
        (lambda f: (f / "meta.json").unlink(), "there is no data set in"),
    ],
)
def test_read_splits_damaged_set_raises(tmp_path, capsys, damage, message):
    folder = damaged(tmp_path, damage)
    with pytest.raises(TactipError, match=message):
        read_splits(folder)
    assert tactip.main(["train", "--data", str(folder), "--out", str(tmp_path / "run")]) == 1
    assert not (tmp_path / "run").exists()
    assert capsys.readouterr().err.startswith("tactip: ")


def test_read_splits_mixed_tasks_raises(tmp_path):
    folder = tmp_path / "data"
    write_fake_set(folder / "train", "surface", samples=4)
    write_fake_set(folder / "val", "edge", "val", samples=4)
    with pytest.raises(TactipError, match=r"has the task 'edge', but the training set in .* has 'surface'"):
        read_splits(folder)
    with pytest.raises(TactipError, match=r"folder .* does not exist: training needs the sets"):
        read_splits(tmp_path / "nothing")


def test_evaluate_command_mismatched_set_fails(splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    other = write_fake_set(tmp_path / "edge", "edge", samples=4)
    large = write_fake_set(tmp_path / "large", "surface", samples=4, size=64)
    for folder, message in (
        (other, "has the task 'edge', but the model has 'surface'"),
        (large, "64 px wide, but the model uses 40 px"),
    ):
        assert tactip.main(["evaluate", "--model", str(tmp_path / "run"), "--data", str(folder)]) == 1
        assert message in capsys.readouterr().err


def test_load_model_damaged_raises(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    with pytest.raises(TactipError, match="no model in"):
        load_model(tmp_path)
    data = (tmp_path / "run" / "model.pt").read_bytes()
    (tmp_path / "run" / "model.pt").write_bytes(data[:-1] + b"x")
    with pytest.raises(TactipError, match="do not match the checksum in"):
        load_model(tmp_path / "run")
    path = tmp_path / "run" / "model.json"
    description = json.loads(path.read_text())
    description["labels"]["task"] = "ceiling"
    path.write_text(json.dumps(description))
    with pytest.raises(TactipError, match="was altered: it does not match its own checksum"):
        load_model(tmp_path / "run")
    path.write_text(json.dumps(with_checksum(description)))
    with pytest.raises(TactipError, match="unknown task 'ceiling': choose one of surface, edge"):
        load_model(tmp_path / "run")
    path.write_text("{")
    with pytest.raises(TactipError, match=r"model\.json is not JSON"):
        load_model(tmp_path / "run")


class _Payload:
    def __reduce__(self):
        return os.mkdir, ("payload-ran",)


def _nan_weights(state):
    return {name: tensor.clone().fill_(float("nan")) for name, tensor in state.items()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: _Payload(), "damaged, or not a file of tensors"),
        (lambda state: [1, 2], "it has no tensors by name"),
        (lambda state: {1: torch.zeros(1)}, "it has no tensors by name"),
        (lambda state: dict.fromkeys(state, "x"), "something else than tensors of finite numbers"),
        (_nan_weights, "something else than tensors of finite numbers"),
    ],
)
def test_load_model_hostile_weights_raise(splits, tmp_path, monkeypatch, change, message):
    """Weights with a matching checksum that are no weights of the network, or run a program when they are unpickled."""
    monkeypatch.chdir(tmp_path)
    quiet(*splits, NET, QUICK, tmp_path / "run")
    weights, path = tmp_path / "run" / "model.pt", tmp_path / "run" / "model.json"
    torch.save(change(torch.load(weights, weights_only=True)), weights)
    description = json.loads(path.read_text())
    description["weights"]["sha256"] = hashlib.sha256(weights.read_bytes()).hexdigest()
    path.write_text(json.dumps(with_checksum(description)))
    with pytest.raises(TactipError, match=message):
        load_model(tmp_path / "run")
    assert not (tmp_path / "payload-ran").exists()


def test_load_model_weights_outside_of_folder_raise(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    path = tmp_path / "run" / "model.json"
    description = json.loads(path.read_text())
    for file in ("../model.pt", "/dev/zero"):
        description["weights"]["file"] = file
        path.write_text(json.dumps(with_checksum(description)))
        with pytest.raises(TactipError, match=r"weights must have the file model\.pt"):
            load_model(tmp_path / "run")


def test_read_recipe_round_trip_and_errors(tmp_path):
    recipe = Recipe(NET, QUICK)
    (tmp_path / "good.json").write_text(recipe_json(recipe))
    assert read_recipe(tmp_path / "good.json") == recipe
    for text, message in (
        ("{", "bad.json is not JSON"),
        ("[1]", "must be a recipe, JSON with `network`"),
        ('{"network": {"depth": 3}}', "network has no field 'depth': it has conv_layers"),
        ('{"network": {"filters": "many"}}', "network.filters must be a whole number, got 'many'"),
        ('{"network": {"filters": 1025}}', "filters must be a whole number from 1 to 1024, got 1025"),
    ):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(TactipError, match=message):
            read_recipe(tmp_path / "bad.json")


# Evaluation.


def test_evaluate_command_matches_numpy(data, splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    arguments = ["evaluate", "--model", str(tmp_path / "run"), "--data", str(data / "test")]
    assert tactip.main([*arguments, "--json", "--out", str(tmp_path / "report")]) == 0
    figures = json.loads(capsys.readouterr().out)
    model, samples = load_model(tmp_path / "run"), read_samples(data / "test")
    errors = model.predict(samples.images) - read_dataset(data / "test").poses[:, [2, 3, 4]]
    names = ["pose_z", "pose_Rx", "pose_Ry"]
    for key, expected in (
        ("mae", np.abs(errors).mean(0)),
        ("rmse", np.sqrt((errors**2).mean(0))),
        ("bias", errors.mean(0)),
    ):
        assert list(figures[key]) == names
        assert list(figures[key].values()) == pytest.approx(expected.tolist(), abs=1e-5)
    assert figures["samples"] == 48
    assert figures["latency_ms"] > 0
    assert figures["parameters"] == sum(p.numel() for p in model.net.parameters())
    page = (tmp_path / "report" / "evaluation.md").read_text()
    assert f"{figures['mae']['pose_z']:.3f} mm" in page
    assert {f.name for f in (tmp_path / "report").iterdir()} == {
        "evaluation.json",
        "evaluation.md",
        "errors.png",
        "worst.png",
    }
    assert tactip.main(arguments) == 0
    assert "pose_Ry: mean error" in capsys.readouterr().out


def test_evaluate_edge_has_five_components(tmp_path):
    data = write_fake_splits(tmp_path / "edge", "edge", samples=8)
    train_set, val = read_splits(data)
    quiet(train_set, val, NET, TrainSettings(epochs=1), tmp_path / "run")
    evaluation = evaluate(load_model(tmp_path / "run"), val)
    assert list(evaluation.figures["mae"]) == ["pose_x", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz"]
    assert train_set.labels.scale.tolist() == [5, 5, 15, 15, 45]


def test_tables_bins_and_worst_samples(data, splits, tmp_path):
    values, errors = np.arange(20.0), np.stack([np.arange(20.0), np.ones(20)], 1)
    rows = binned(values, errors, ("a", "b"))
    assert [r["samples"] for r in rows] == [2] * 10
    assert rows[3]["mae"] == {"a": 6.5, "b": 1.0}
    assert rows[3]["from"] == 6 and rows[3]["to"] == 7
    quiet(*splits, NET, QUICK, tmp_path / "run")
    model, samples = load_model(tmp_path / "run"), read_samples(data / "test")
    evaluation = evaluate(model, samples)
    worst = tables(evaluation, samples, model.labels)["worst"]
    size = ((evaluation.errors / model.labels.scale) ** 2).sum(1)
    assert worst[0]["image"] == samples.dataset.images[int(size.argmax())]


def test_evaluate_on_a_sensor_with_other_pins_is_refused_unless_asked_for(splits, tmp_path, capsys):
    """Predictions from images of a sensor that was not learned mean nothing; where they are far outside, that is said."""
    quiet(*splits, NET, QUICK, tmp_path / "run")
    other = write_fake_set(tmp_path / "other", samples=4, design=design_named("nominal-331"))
    command = ["evaluate", "--model", str(tmp_path / "run"), "--data", str(other)]
    assert tactip.main(command) == 1
    assert "show 331 pins, but the network was trained on images of 127" in capsys.readouterr().err
    assert tactip.main([*command, "--any-sensor", "--json"]) == 0
    assert 0 <= json.loads(capsys.readouterr().out)["outside_fraction"] <= 1


def test_predictions_far_outside_the_learned_range_are_counted_and_said(splits, tmp_path, capsys):
    quiet(*splits, NET, QUICK, tmp_path / "run")
    model = load_model(tmp_path / "run")
    state = model.net.state_dict()
    state[list(state)[-1]] += 5.0  # the bias of the last layer: five times the learned range
    (tmp_path / "shifted").mkdir()
    save_model(tmp_path / "shifted", state, model.config, model.labels, model.size, model.provenance)
    data = write_fake_set(tmp_path / "set", samples=4)
    assert tactip.main(["evaluate", "--model", str(tmp_path / "shifted"), "--data", str(data), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["outside_fraction"] == 1
    assert "100% of the predictions are far outside the range that the network learned" in err
