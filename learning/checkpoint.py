"""Files of a training: written after every epoch and read to resume it.

model.pt, model.json  the best network so far
metrics.jsonl         a line for each epoch
checkpoint.pt         the state after the last epoch, while the training is unfinished
"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch

from tactip_twin.learning.configuration import PoseNetConfig, TrainSettings
from tactip_twin.learning.contact_sources import DrawingTip, digest_of
from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import (
    DESCRIPTION,
    Model,
    net_sha256,
    read_description,
    save_model,
    tensors_from_bytes,
    weights_bytes,
)
from tactip_twin.learning.training import Training
from tactip_twin.sim.dataset.format import labels_sha256
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import parse_json, read_file, read_json_lines

CHECKPOINT, METRICS, LOCK, TENSORBOARD = "checkpoint.pt", "metrics.jsonl", ".lock", "tensorboard"


def provenance(
    train: Samples,
    val: Samples,
    config: PoseNetConfig,
    settings: TrainSettings,
    init_from: Model | None = None,
    tips: Sequence[DrawingTip] = (),
) -> dict[str, Any]:
    """Return everything a training depends on, as JSON: data, network, settings, and checksums of the initial network and of
    the learned tips that draw contacts."""

    def data(samples: Samples) -> dict[str, Any]:
        """Return the JSON that identifies a set."""
        meta = samples.dataset.meta
        return {
            "digest": meta.get("digest"),
            "samples": len(samples),
            "chosen": samples.subset_sha256(),
            "targets_sha256": labels_sha256(meta),
            "configuration": meta.get("configuration"),
        }

    record: dict[str, Any] = {
        "train": data(train),
        "val": data(val),
        "network": dataclasses.asdict(config),
        "settings": dataclasses.asdict(settings),
        "torch": torch.__version__,
    }
    if init_from is not None:
        record["initial_weights"] = net_sha256(init_from.net)
    if tips:
        record["fast_tip"] = digest_of(tips)
    return json.loads(json.dumps(record))


def save_checkpoint(training: Training, folder: Path, record: dict[str, Any]) -> None:
    """Write the state after an epoch: the checkpoint first, because the other files can be recreated from it.

    Args:
        training: The training, after at least one epoch.
        folder: Folder of the training.
        record: Provenance of the training.
    """
    finished = training.finished
    best = min(training.history, key=lambda h: h["val_loss"])
    write_file(folder / CHECKPOINT, weights_bytes({"of": json.dumps(record), **training.state()}))
    lines = "".join(json.dumps(h) + "\n" for h in training.history)
    write_file(folder / METRICS, lines.encode())
    if finished or best["epoch"] == training.epoch:
        outcome = {"finished": finished, "epochs": training.epoch, "best_epoch": best["epoch"], "val_loss": best["val_loss"]}
        save_model(
            folder,
            training.best,
            training.config,
            training.labels,
            training.size,
            record | {"outcome": outcome},
            training.deviation_scale(),
        )


def load_checkpoint(folder: Path, record: dict[str, Any]) -> dict[str, Any] | Literal["finished"] | None:
    """Return the state of a training in a folder, "finished" if it has ended, or None if the folder is empty.

    Args:
        folder: Folder of the training.
        record: Provenance of the training.

    Raises:
        TactipError: If the checkpoint cannot be read, or the folder holds another training or something else.
    """
    checkpoint, description = folder / CHECKPOINT, folder / DESCRIPTION
    state: dict[str, Any] | Literal["finished"] | None = None
    recorded: dict[str, Any] | None = None
    if checkpoint.exists():
        try:
            state = tensors_from_bytes(read_file(checkpoint))
            recorded = parse_json(state["of"], f"the settings in {checkpoint}")
            _check_history(parse_json(state["history"], f"the history in {checkpoint}"), str(checkpoint))
        except (ValueError, KeyError, TypeError) as error:
            raise TactipError(f"cannot read {checkpoint} ({error}): delete it to restart the training") from error
    elif description.exists():
        state, recorded = "finished", read_description(folder)["provenance"]
    requested = {"initial_weights": None, "fast_tip": None} | record
    if recorded is not None:
        defaults = {"network": dataclasses.asdict(PoseNetConfig()), "settings": dataclasses.asdict(TrainSettings())}
        recorded = {part: with_new_defaults(recorded.get(part), defaults.get(part)) for part in requested}
    if recorded is not None and state == "finished":
        # Nothing is computed any more: a network from another machine, a GPU for example, may be used here.
        recorded["torch"] = record["torch"]
    check_resumable(folder, "training", recorded, requested, own=(LOCK, TENSORBOARD))
    return state


def with_new_defaults(recorded: Any, defaults: Any) -> Any:
    """Return a recorded configuration (a JSON value) in which fields that were added later have their defaults.

    Args:
        recorded: JSON value that was recorded.
        defaults: JSON value of the defaults of the current configuration.
    """
    if not isinstance(recorded, dict) or not isinstance(defaults, dict):
        return recorded
    return defaults | {name: with_new_defaults(value, defaults.get(name)) for name, value in recorded.items()}


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Return the figures of each epoch of the training in a folder. Raises TactipError where they cannot be read."""
    path = Path(folder) / METRICS
    return _check_history(read_json_lines(path), str(path))


_FIGURES = ("epoch", "loss", "val_loss", "seconds")


def _check_history(history: Any, name: str) -> list[dict[str, float]]:
    """Return a JSON value. Raises TactipError unless it has the figures of each epoch. name: its file, for the message."""
    if not isinstance(history, list):
        raise TactipError(f"{name} is damaged: the history must be a list of epochs")
    for epoch, figures in enumerate(history, 1):
        good = isinstance(figures, dict) and all(type(figures.get(key)) in (int, float) for key in _FIGURES)
        if not good or figures["epoch"] != epoch:
            raise TactipError(f"{name} is damaged: epoch {epoch} must have the numbers {', '.join(_FIGURES)}")
    return history
