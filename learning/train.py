"""Training of a PoseNet in a folder: deterministic for a seed, and resumable after a kill at any time."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from tactip_twin.learning.checkpoint import (
    CHECKPOINT,
    LOCK,
    TENSORBOARD,
    load_checkpoint,
    provenance,
    read_metrics,
    save_checkpoint,
)
from tactip_twin.learning.configuration import DeviceName, PoseNetConfig, TrainSettings
from tactip_twin.learning.contact_sources import DrawingTip, drawing_tips, not_drawn
from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import Model
from tactip_twin.learning.posenet import parameter_count
from tactip_twin.learning.training import Training, initial_state
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import remove_leftovers

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

ShouldPrune = Callable[[list[dict[str, float]]], bool]
"""Function that gets the figures of the epochs so far and returns whether to end the training."""


class Pruned(TactipError):
    """The training ended early because other trials were better after the same number of epochs."""


def train(
    train_samples: Samples,
    val_samples: Samples,
    config: PoseNetConfig,
    settings: TrainSettings,
    folder: str | Path,
    device: DeviceName = "auto",
    log: Callable[[str], None] = print,
    should_prune: ShouldPrune | None = None,
    quiet: bool = False,
    init_from: Model | None = None,
    tips: Sequence[DrawingTip] = (),
) -> list[dict[str, float]]:
    """Train a network in a folder, or resume an interrupted training; return the figures of each epoch.

    Writes model.pt and model.json (the best network so far), metrics.jsonl and, while unfinished, checkpoint.pt. Completed
    epochs are kept after any error.

    Args:
        train_samples: Training set.
        val_samples: Validation set.
        config: Network.
        settings: Settings of the training.
        folder: Output folder.
        device: Device to train on.
        log: Callback for messages to the user.
        should_prune: Callback that decides after each epoch whether to end the training.
        quiet: Whether to hide the progress bar.
        init_from: Model with the initial weights and the same layers; random weights if None.
        tips: Learned tips that draw contacts, if the settings ask for any; empty for the shipped ones of the set's sensor.

    Raises:
        TactipError: If the folder holds something else, memory runs out or the loss diverges.
        Pruned: If `should_prune` ended the training.
        Interrupted: On Ctrl-C.
    """
    folder = Path(folder)
    if settings.drawn_contacts and not tips:
        tips = drawing_tips(train_samples)
    record = provenance(train_samples, val_samples, config, settings, init_from, tips if settings.drawn_contacts else ())
    if load_checkpoint(folder, record) is None:
        # Checked before the folder is created, so a network that cannot be trained leaves none behind.
        if init_from is not None:
            initial_state(init_from, config, train_samples)
        config.last_size(train_samples.size)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / LOCK, f"training in {folder}"):
        remove_leftovers(folder)
        state = load_checkpoint(folder, record)
        if state == "finished":
            log(f"this training is already finished in {folder}")
            return read_metrics(folder)
        try:
            for line in not_drawn(train_samples, tips) if settings.drawn_contacts else ():
                log(line)
            training = Training(train_samples, val_samples, config, settings, device, init_from, tips)
            if state:
                training.restore(state)
                log(f"resuming after epoch {training.epoch}")
            log(
                f"{parameter_count(training.net)} parameters on {training.device}; {len(train_samples)} training images, "
                f"{len(val_samples)} validation images"
            )
            _train_epochs(training, folder, record, should_prune, quiet)
        except KeyboardInterrupt:
            raise Interrupted("completed epochs are saved: run the same command to resume") from None
        except (torch.OutOfMemoryError, MemoryError) as error:
            raise _out_of_memory(config) from error
        except RuntimeError as error:
            if "memory" not in str(error).lower():
                raise
            raise _out_of_memory(config) from error
        best = min(training.history, key=lambda h: h["val_loss"])
        log(f"best: epoch {best['epoch']} of {training.epoch}, validation loss {best['val_loss']:.5f}")
        return training.history


def _out_of_memory(config: PoseNetConfig) -> TactipError:
    """Return the error for a network that does not fit into memory."""
    return TactipError(f"out of memory: try fewer filters or a smaller batch than those of {config}")


def _train_epochs(
    training: Training, folder: Path, record: dict[str, Any], should_prune: ShouldPrune | None, quiet: bool
) -> None:
    """Train until finished, with a checkpoint after each epoch. Raises Pruned."""
    if training.finished:
        # The process was killed after the last checkpoint and before the other files were written.
        save_checkpoint(training, folder, record)
    writer = _tensorboard(folder)
    steps = training.steps_per_epoch
    with tqdm(
        total=training.epochs * steps,
        initial=training.epoch * steps,
        unit="step",
        file=sys.stderr,
        mininterval=0.5 if sys.stderr.isatty() else 15,
        disable=quiet,
    ) as bar:
        while True:
            # First, because a kill may have come between the last checkpoint and this decision.
            if should_prune and training.epoch and not training.finished and should_prune(training.history):
                raise Pruned(f"half of the earlier trials had a lower loss after {training.epoch} epochs")
            if training.finished:
                break
            figures = training.train_epoch(bar.update)
            epoch = f"{training.epoch}/{training.epochs}"
            bar.set_postfix(epoch=epoch, loss=figures["loss"], val=figures["val_loss"], best=training.best_error)
            if writer:
                for name in ("loss", "val_loss"):
                    writer.add_scalar(name, figures[name], training.epoch)
            save_checkpoint(training, folder, record)
    if writer:
        writer.close()
    (folder / CHECKPOINT).unlink()


def _tensorboard(folder: Path) -> "SummaryWriter | None":
    """Return a writer for TensorBoard, or None if it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / TENSORBOARD))
