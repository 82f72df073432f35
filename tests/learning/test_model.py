"""Models on disk: damaged and hostile ones are refused in one sentence."""

import hashlib
import json
import os

import pytest
import torch

from helpers.trainings import NET, QUICK, quiet
from tactip_twin.learning.model import load_model
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import with_checksum


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
