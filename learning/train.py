"""Training of a PoseNet: plain, deterministic from its seed, and resumable at any kill.

    loss = sum over components of the mean squared error over scale² + L1 and L2 of the dense and output weights
    Adam, or Muon and Adam; early stopping on the validation error, without penalties; the best weights are kept

Every epoch's order and dropout are drawn from (seed, epoch): an epoch depends on the state before it and on nothing else.
"""

import dataclasses
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.configuration import PoseNetConfig, TrainSettings
from tactip_twin.learning.device import device_named, is_half
from tactip_twin.learning.model import net_sha256, save_model, tensors_of, to_input, weights_bytes
from tactip_twin.learning.muon import Muon, inner_weights
from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.learning.posenet import PoseNet, parameter_count
from tactip_twin.sim.dataset.format import labels_sha256
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file

CHECKPOINT, METRICS, LOCK = "checkpoint.pt", "metrics.jsonl", ".lock"


def paper_rate(settings, step, steps):
    """Learning rate at a step: as the paper's library had it, rate / (1 + decay × step)."""
    return settings.rate / (1 + settings.decay * step)


def cosine_rate(settings, step, steps):
    """Learning rate at a step of `steps`: up over the first twentieth, and down to nothing along a cosine."""
    warm = max(1, steps // 20)
    return settings.rate * min(1.0, (step + 1) / warm) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, steps))))


SCHEDULES = {"paper": paper_rate, "cosine": cosine_rate}
"""How the learning rate goes over a training, by name."""


class TrainingDiverged(TactipError):
    """The loss is no longer a number."""


class Pruned(TactipError):
    """A trial was ended because others were better by then."""


class Training:
    """A training in memory: network, optimiser, data, and the step from one epoch to the next."""

    def __init__(self, train, val, config, settings, device="cpu", start=None):
        """train, val: Samples. config: PoseNetConfig. settings: TrainSettings. device: `auto`, `cpu` or `cuda`. start:
        Model whose weights it begins with; at random if None.

        Raises TactipError where network and images, or the start, do not fit each other.
        """
        self.config, self.settings, self.labels, self.size = config, settings, train.labels, train.size
        self.device = device_named(device)
        self._half = is_half(settings.precision, self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            net = PoseNet(config, train.size, len(self.labels.components))
        if start is not None:
            net.load_state_dict(_begun(start, config, train))
        self.net = net.to(device=self.device, memory_format=torch.channels_last)
        self._optimizers = _optimizers(self.net, settings, self._half)
        # The whole set lives on the device, as bytes.
        self._images, self._targets = self._resident(train)
        self._drawn = (
            OpticsAugmentation(train, settings.optics, OPTICS[settings.varied], self.device) if settings.drawn else None
        )
        self._val_images, self._val_targets = self._resident(val)
        self.epoch = 0
        self.history = []
        """A dict of figures an epoch."""
        self.best = None
        """State dict of the best epoch's network."""

    def _resident(self, samples):
        targets = torch.from_numpy((samples.targets / self.labels.scale).astype(np.float32))
        return torch.from_numpy(samples.images).to(self.device), targets.to(self.device)

    @property
    def steps_an_epoch(self):
        """Steps (int) of an epoch."""
        return -(-len(self._images) // self.config.batch_size)

    @property
    def images_an_epoch(self):
        """Images (int) of an epoch."""
        return len(self._images)

    @property
    def epochs(self):
        """Most epochs (int)."""
        return max(self.settings.epochs, -(-self.settings.least_steps // self.steps_an_epoch))

    @property
    def best_error(self):
        """Least validation error so far, -."""
        return min((h["val_loss"] for h in self.history), default=math.inf)

    @property
    def over(self):
        """Whether there is nothing left to do."""
        if not self.history:
            return False
        since = self.epoch - 1 - int(np.argmin([h["val_loss"] for h in self.history]))
        return self.epoch >= self.epochs or since >= self.settings.patience

    def train_epoch(self, tick=lambda count: None):
        """Go through the training set once, and judge. tick: called with the number of images of each step.

        Returns the epoch's figures (dict). Raises TrainingDiverged.
        """
        start = time.perf_counter()
        draw = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.settings.seed, spawn_key=(self.epoch,))))
        order = torch.from_numpy(draw.permutation(len(self._images))).to(self.device)
        devices = [torch.cuda.current_device()] if self.device == "cuda" else []
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(int(draw.integers(2**62)))
            loss = self._steps(order, tick)
        val = self.error(self._val_images, self._val_targets)
        if not math.isfinite(loss) or not math.isfinite(val):
            raise TrainingDiverged(
                f"the loss is {loss} after epoch {self.epoch + 1}: the training diverged; a learning rate below "
                f"{self.settings.rate:g} may help"
            )
        figures = {"epoch": self.epoch + 1, "loss": loss, "val_loss": val, "seconds": time.perf_counter() - start}
        if val < self.best_error:
            self.best = {name: tensor.detach().clone() for name, tensor in self.net.state_dict().items()}
        self.history.append(figures)
        self.epoch += 1
        return figures

    def _batch(self, chosen):
        """The images (m, size, size) uint8 of a step: plain, or a share of them drawn anew."""
        if not self._drawn:
            return self._images[chosen]
        plain = torch.rand(len(chosen), 1, 1, device=self.device) >= self.settings.drawn
        return torch.where(plain, self._images[chosen], self._drawn.draw(chosen))

    def _steps(self, order, tick):
        """The steps of an epoch over images in an `order` (n,). Returns the mean loss, penalties included (float)."""
        self.net.train()
        rate = SCHEDULES[self.settings.schedule]
        total, steps = torch.zeros((), device=self.device), self.steps_an_epoch
        for i in range(steps):
            share = rate(self.settings, self.epoch * steps + i, self.epochs * steps) / self.settings.rate
            chosen = order[i * self.config.batch_size : (i + 1) * self.config.batch_size]
            with torch.autocast(self.device, dtype=torch.bfloat16, enabled=self._half):
                out = self.net(to_input(self._batch(chosen)))
            loss = (out - self._targets[chosen]).square().sum(1).mean() + self.net.penalty()
            self.net.zero_grad(set_to_none=True)
            loss.backward()
            for optimizer, whole in self._optimizers:
                for group in optimizer.param_groups:
                    group["lr"] = whole * share
                optimizer.step()
            total += loss.detach() * len(chosen)
            tick(len(chosen))
        return float(total) / len(order)

    def error(self, images, targets, batch=256):
        """Sum over components of the mean squared error over scale² (float) of images (n, size, size) and targets (n, k).

        In single precision, as the network is used.
        """
        self.net.eval()
        total = torch.zeros((), device=self.device)
        with torch.inference_mode():
            for start in range(0, len(images), batch):
                out = self.net(to_input(images[start : start + batch]))
                total += (out - targets[start : start + batch]).square().sum()
        return float(total) / len(images)

    def state(self):
        """Everything that the next epoch depends on: a dict of tensors, numbers and text."""
        return {
            "net": self.net.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer, _ in self._optimizers],
            "best": self.best,
            "epoch": self.epoch,
            "history": json.dumps(self.history),
        }

    def restore(self, state):
        """Go on from a `state`."""
        self.net.load_state_dict(state["net"])
        for (optimizer, _), its in zip(self._optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(its)
        self.best, self.epoch, self.history = state["best"], state["epoch"], json.loads(state["history"])


def _begun(start, config, samples):
    """The state dict that a training on Samples begins with: a Model's, its outputs over the scales of the samples' labels.

    Raises TactipError where the Model does not fit them, or the network's config (PoseNetConfig).
    """
    here = {"layers": config.shape(), "width of images": samples.size, "components": samples.labels.components}
    there = {"layers": start.config.shape(), "width of images": start.size, "components": start.labels.components}
    for what, mine in here.items():
        if mine != there[what]:
            raise TactipError(
                f"the network to begin with has other {what} than what is trained: {_difference(there[what], mine)}"
            )
    state = {name: tensor.detach().cpu().clone() for name, tensor in start.net.state_dict().items()}
    share = torch.from_numpy((start.labels.scale / samples.labels.scale).astype(np.float32))
    last = len(start.net.dense) - 1
    state[f"dense.{last}.weight"] *= share[:, None]
    state[f"dense.{last}.bias"] *= share
    return state


def _difference(its, mine):
    """In what two things, or dicts of the same keys, differ, as text."""
    if not isinstance(its, dict):
        return f"{its}, not {mine}"
    return "; ".join(f"{key} {its[key]}, not {mine[key]}" for key in its if its[key] != mine[key])


def _optimizers(net, settings, half):
    """Optimisers of a net's weights, each with its learning rate: a list of pairs."""
    inner = inner_weights(net) if settings.muon else []
    ours = {id(p) for p in inner}
    rest = [p for p in net.parameters() if id(p) not in ours]
    out = [(torch.optim.Adam(rest, lr=settings.rate), settings.rate)]
    return [*out, (Muon(inner, lr=settings.muon, half=half), settings.muon)] if inner else out


def provenance(train, val, config, settings, start=None):
    """What a training depends on (dict, JSON): data, network, settings, and the Model that it begins with, if any."""

    def data(samples):
        meta = samples.dataset.meta
        return {
            "digest": meta.get("digest"),
            "samples": len(samples),
            "chosen": samples.chosen(),
            "targets_sha256": labels_sha256(meta),
            "configuration": meta.get("configuration"),
        }

    record = {
        "train": data(train),
        "val": data(val),
        "network": dataclasses.asdict(config),
        "settings": dataclasses.asdict(settings),
        "torch": torch.__version__,
    }
    if start is not None:
        record["begun_from"] = net_sha256(start.net)
    return json.loads(json.dumps(record))


def train(
    train_samples, val_samples, config, settings, folder, device="auto", say=print, hopeless=None, quiet=False, start=None
):
    """Train a network in a folder, or go on with one that was stopped there.

    train_samples, val_samples: Samples. config: PoseNetConfig. settings: TrainSettings. folder: path. device: str.
    say: called with lines for the user. hopeless: called with the history after each epoch; training ends where it says so.
    quiet: bool, without a progress bar. start: Model whose weights it begins with, of the same layers; at random if None.

    Writes model.pt and model.json (the best network so far), metrics.jsonl and, while unfinished, checkpoint.pt. Returns the
    history (list of dict). Raises TactipError where the folder holds another training, where memory is short and where the
    loss diverges, Pruned where it is hopeless, and Interrupted at Ctrl-C; nothing that was done is lost by any.
    """
    folder = Path(folder)
    record = provenance(train_samples, val_samples, config, settings, start)
    if _known(folder, record) is None:
        # What cannot be trained leaves no folder behind.
        if start is not None:
            _begun(start, config, train_samples)
        config.last_size(train_samples.size)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / LOCK, f"training in {folder}"):
        return _train(train_samples, val_samples, config, settings, folder, device, say, hopeless, quiet, start, record)


def _train(train_samples, val_samples, config, settings, folder, device, say, hopeless, quiet, start, record):
    """`train`, in a folder that is ours."""
    known = _known(folder, record)
    if known == "finished":
        say(f"{folder} holds this training, finished already")
        return read_metrics(folder)
    try:
        training = Training(train_samples, val_samples, config, settings, device, start)
        if known:
            training.restore(known)
            say(f"going on after epoch {training.epoch}")
        say(
            f"{parameter_count(training.net)} parameters on {training.device}; {len(train_samples)} images to train on, "
            f"{len(val_samples)} to validate on"
        )
        _epochs(training, folder, record, hopeless, quiet)
    except KeyboardInterrupt:
        raise Interrupted("the epochs that are over are kept: the same command goes on from there") from None
    except (torch.OutOfMemoryError, MemoryError) as error:
        raise TactipError(f"memory is short for {config}: fewer filters or a smaller batch may help") from error
    except RuntimeError as error:
        if "memory" not in str(error).lower():
            raise
        raise TactipError(f"memory is short for {config}: fewer filters or a smaller batch may help") from error
    best = min(training.history, key=lambda h: h["val_loss"])
    say(f"best: epoch {best['epoch']} of {training.epoch}, validation loss {best['val_loss']:.5f}")
    return training.history


def _epochs(training, folder, record, hopeless, quiet):
    """Train to the end, with a checkpoint after each epoch."""
    if training.over:
        # A kill came after the last checkpoint, and before what is made of it.
        _keep(training, folder, record)
    writer = _tensorboard(folder)
    images = training.images_an_epoch
    with tqdm(
        total=training.epochs * images,
        initial=training.epoch * images,
        unit="image",
        unit_scale=True,
        file=sys.stderr,
        mininterval=0.5 if sys.stderr.isatty() else 15,
        disable=quiet,
    ) as bar:
        while not training.over:
            figures = training.train_epoch(bar.update)
            bar.set_postfix(epoch=training.epoch, loss=figures["loss"], val=figures["val_loss"], best=training.best_error)
            if writer:
                for name in ("loss", "val_loss"):
                    writer.add_scalar(name, figures[name], training.epoch)
            _keep(training, folder, record)
            if hopeless and not training.over and hopeless(training.history):
                raise Pruned(f"half of the trials before were better after {training.epoch} epochs")
    if writer:
        writer.close()
    (folder / CHECKPOINT).unlink()


def _keep(training, folder, record):
    """Write the state after an epoch: the checkpoint first, from which the rest can be made anew."""
    finished = training.over
    best = min(training.history, key=lambda h: h["val_loss"])
    write_file(folder / CHECKPOINT, weights_bytes({"of": json.dumps(record), **training.state()}))
    lines = "".join(json.dumps(h) + "\n" for h in training.history)
    write_file(folder / METRICS, lines.encode())
    if finished or best["epoch"] == training.epoch:
        outcome = {"finished": finished, "epochs": training.epoch, "best_epoch": best["epoch"], "val_loss": best["val_loss"]}
        save_model(folder, training.best, training.config, training.labels, training.size, record | {"outcome": outcome})


def read_metrics(folder):
    """The history (list of dict) of a training in a folder."""
    return [json.loads(line) for line in (Path(folder) / METRICS).read_text().splitlines()]


def _known(folder, record):
    """State of the training of `record` in a folder: None, a checkpoint, or "finished". Raises TactipError on another's."""
    checkpoint, description = folder / CHECKPOINT, folder / "model.json"
    if checkpoint.exists():
        try:
            state = tensors_of(checkpoint.read_bytes())
            there = json.loads(state["of"])
        except (ValueError, KeyError, TypeError) as error:
            raise TactipError(f"{checkpoint} cannot be read ({error}): remove it to begin anew") from error
        _refuse_other(folder, there, record)
        return state
    if description.exists():
        _refuse_other(folder, json.loads(description.read_text()).get("provenance", {}), record)
        return "finished"
    if folder.exists() and any(path.name != LOCK for path in folder.iterdir()):
        raise TactipError(f"the folder {folder} is not empty and holds no training: name another one")
    return None


def with_new_defaults(found, defaults):
    """What was written of a configuration (a JSON value), with fields that came to it since as their defaults have it.

    defaults: dict, of the configuration as it is now.
    """
    if not isinstance(found, dict) or not isinstance(defaults, dict):
        return found
    return defaults | {name: with_new_defaults(value, defaults.get(name)) for name, value in found.items()}


def _refuse_other(folder, there, record):
    before = {"network": dataclasses.asdict(PoseNetConfig()), "settings": dataclasses.asdict(TrainSettings())}
    for part, asked in ({"begun_from": None} | record).items():
        found = with_new_defaults(there.get(part), before.get(part))
        if found != asked:
            what = {"begun_from": "another network to begin with", "settings": "other settings"}.get(part, f"another {part}")
            raise TactipError(f"the folder {folder} holds a training with {what}: name another folder, or remove this one")


def _tensorboard(folder):
    """A writer of TensorBoard's, or None where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"))
