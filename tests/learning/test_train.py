"""Training: determinism, optimizers, initial weights and early stopping."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.kills import Killed
from helpers.learning_sets import write_fake_splits
from helpers.trainings import NET, QUICK, quiet, same, weights
from tactip_twin.commands import main as tactip
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import TrainSettings
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.model import load_model, net_sha256, to_input
from tactip_twin.learning.muon import Muon, inner_weights
from tactip_twin.learning.train import Pruned
from tactip_twin.learning.training import Training, TrainingDiverged
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.tactip_model.errors import TactipError


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
    history = quiet(*splits, NET, TrainSettings(epochs=40, patience=40, learning_rate=3e-3), tmp_path / "run")
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


def test_error_weights_components_by_scale(splits):
    """Each component has the weight 1 / (maximum absolute value)²."""
    training = Training(*splits, NET, QUICK)
    _, val = splits
    with torch.no_grad():
        for parameter in training.net.parameters():
            parameter.zero_()
    expected = ((val.targets / [5, 15, 15]) ** 2).sum(1).mean()
    assert training.validation_loss() == pytest.approx(expected, rel=1e-5)


def test_train_killed_before_it_is_pruned_is_pruned_after_the_same_epoch(splits, tmp_path):
    def killed(history):
        if len(history) == 2:
            raise Killed
        return False

    with pytest.raises(Killed):
        quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=killed)
    with pytest.raises(Pruned, match="a lower loss after 2 epochs"):
        quiet(*splits, NET, QUICK, tmp_path / "run", should_prune=lambda history: True)
    assert len(read_metrics(tmp_path / "run")) == 2
