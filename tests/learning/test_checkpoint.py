"""Trainings that are killed, interrupted or resumed, and folders that hold something else."""

import json
import subprocess
import time

import pytest
import torch

from helpers.set_commands import process, run
from helpers.trainings import NET, QUICK, quiet, same, weights
from tactip_twin.learning import checkpoint
from tactip_twin.learning import train as train_module
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import TrainSettings
from tactip_twin.learning.model import load_model
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.input_files import with_checksum


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


def test_finished_training_of_another_torch_is_kept(splits, tmp_path, monkeypatch):
    """As when a network comes from a machine with a GPU; an unfinished one is not continued with another version."""

    def stop(history):
        raise KeyboardInterrupt

    settings = TrainSettings(epochs=2, learning_rate=3e-3)
    history = quiet(*splits, NET, settings, tmp_path / "whole")
    with pytest.raises(Interrupted):
        quiet(*splits, NET, settings, tmp_path / "cut", should_prune=stop)
    monkeypatch.setattr(checkpoint.torch, "__version__", "9.9")
    assert quiet(*splits, NET, settings, tmp_path / "whole") == history
    with pytest.raises(TactipError, match="torch is"):
        quiet(*splits, NET, settings, tmp_path / "cut")


@pytest.mark.slow
def test_train_command_killed_resumes_to_same_weights(data, tmp_path, monkeypatch):
    settings = ["--training.epochs", "40", "--training.patience", "40", "--training.learning-rate", "0.003"]
    network = ["--network.conv-layers", "2", "--network.filters", "6", "--network.dense_units", "24"]
    command = ["train", "--data", str(data), "--recipe", "paper", *settings, *network, "--network.batch-size", "8"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    assert run([*command, "--out", str(whole)]).returncode == 0
    started = subprocess.Popen(
        process([*command, "--out", str(killed)]), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    end = time.monotonic() + 60
    while not (killed / "metrics.jsonl").exists() or len(read_metrics(killed)) < 3:
        assert time.monotonic() < end
        time.sleep(0.02)
    started.kill()
    started.wait()
    assert (killed / "checkpoint.pt").exists()
    again = run([*command, "--out", str(killed)])
    assert again.returncode == 0 and "resuming after epoch" in again.stderr
    assert same(weights(whole), weights(killed))
    losses = [[(h["epoch"], h["loss"], h["val_loss"]) for h in read_metrics(f)] for f in (whole, killed)]
    assert losses[0] == losses[1]
    assert not (killed / "checkpoint.pt").exists()
    assert "already finished" in run([*command, "--out", str(killed)]).stderr


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
