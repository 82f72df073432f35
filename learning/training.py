"""State of a training in memory, and its epochs.

    loss = sum over components of the mean squared error over scale², or of a negative log likelihood (outputs.py),
           + L1 and L2 of the dense and output weights
    optimizer: Adam, or Muon and Adam
    early stopping on the validation error, without penalties; the best weights are kept

The order and dropout of each epoch are sampled from (seed, epoch), so an epoch depends only on the state before it.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.configuration import DeviceName, PoseNetConfig, ScheduleName, TrainSettings
from tactip_twin.learning.contact_sources import DrawingTip, contact_source, drawing_tips
from tactip_twin.learning.data import Samples, kind_of
from tactip_twin.learning.deviation_scale import DeviationScale
from tactip_twin.learning.device import device_named, is_half
from tactip_twin.learning.drawn_contacts import ContactSource, DrawnContacts
from tactip_twin.learning.drawn_slides import SlideSource
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model, to_device, to_input
from tactip_twin.learning.muon import Muon, inner_weights
from tactip_twin.learning.optics_ranges import OPTICS
from tactip_twin.learning.outputs import Layout, losses, scaled_loss
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS, FORCES
from tactip_twin.tactip_model.errors import TactipError


def paper_rate(settings: TrainSettings, step: int, steps: int) -> float:
    """Return the learning rate at a step, rate / (1 + decay × step), as in the paper's library [P]."""
    return settings.learning_rate / (1 + settings.learning_rate_decay * step)


def cosine_rate(settings: TrainSettings, step: int, steps: int) -> float:
    """Return the learning rate at a step of `steps`: linear warm-up over the first twentieth, cosine decay to zero."""
    warm = max(1, steps // 20)
    return (
        settings.learning_rate * min(1.0, (step + 1) / warm) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / max(1, steps))))
    )


SCHEDULES: dict[ScheduleName, Callable[[TrainSettings, int, int], float]] = {"paper": paper_rate, "cosine": cosine_rate}
"""Learning-rate schedules by name: functions of settings, step and number of steps."""


class TrainingDiverged(TactipError):
    """The loss is no longer finite."""


class Training:
    """A training in memory: network, optimizers and data."""

    def __init__(
        self,
        train: Samples,
        val: Samples,
        config: PoseNetConfig,
        settings: TrainSettings,
        device: DeviceName = "cpu",
        init_from: Model | None = None,
        tips: Sequence[DrawingTip] = (),
    ) -> None:
        """Build the network and move the data to the device.

        Args:
            train: Training set.
            val: Validation set.
            config: Network.
            settings: Settings of the training.
            device: Device to train on.
            init_from: Model with the initial weights; random weights if None.
            tips: Learned tips that draw contacts (contact_sources.drawing_tips); empty for the shipped ones of the set's
                sensor.

        Raises:
            TactipError: If the network or the initial network does not match the images, or no learned tip can draw contacts
                like those of the set.
        """
        self.config, self.settings, self.labels, self.size = config, settings, train.labels, train.size
        knows = init_from is not None and init_from.config.quantities
        if config.quantities and not knows and not np.isfinite(train.quantities).all(1).any():
            raise TactipError(
                f"the set in {train.folder} has no forces to learn from, as simulated sets have: add --network.no-quantities"
            )
        self.layout = Layout(config, self.labels)
        """Arrangement of the outputs."""
        self.device = device_named(device)
        self._half = is_half(settings.precision, self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            net = PoseNet(config, train.size, self.layout.size)
        if init_from is not None:
            net.load_state_dict(initial_state(init_from, config, train, net.state_dict()))
        self.net = to_device(net, self.device)
        self._optimizers = _optimizers(self.net, settings, self._half)
        # The whole set is kept on the device, as bytes.
        self._images, self._targets = self._to_device(train)
        self._count = len(train)
        undeformed = settings.undeformed_fraction if config.quantities else 0.0
        self._source = contact_source(train, tips or drawing_tips(train), self.device) if settings.drawn_contacts else None
        self._augmentation = (
            OpticsAugmentation(train, settings.augmentation_strength, OPTICS[settings.optics_ranges], self.device)
            if settings.augmented_fraction or undeformed or self._source
            else None
        )
        self._drawn_in = -1  # epoch in which the drawn contacts were drawn
        self._undeformed = undeformed
        if self._augmentation:
            self._add_undeformed_tip(self._augmentation)
        self._val_images, self._val_targets = self._to_device(val)
        if settings.validation_renderings:
            self._randomize_validation(val)
        self.epoch = 0
        self.history: list[dict[str, float]] = []
        """Figures of each epoch so far."""
        self.best: dict[str, torch.Tensor] = {}
        """State dict of the network after the best epoch; empty before the first epoch."""

    def _to_device(self, samples: Samples) -> tuple[torch.Tensor, torch.Tensor]:
        """Return images (n, size, size) uint8 and targets (n, k) over their scales, on the device."""
        targets = torch.from_numpy(scaled_targets(samples, self.labels, self.config).astype(np.float32))
        return torch.from_numpy(samples.images).to(self.device), targets.to(self.device)

    def _add_undeformed_tip(self, augmentation: OpticsAugmentation) -> None:
        """Append the undeformed tip to the images and targets: without force, at an unknown pose. Networks that estimate no
        force never see it."""
        zero = [*FORCES, *EFFECTIVE_SHEARS]
        known = [0.0 if q.name in zero else np.nan for q in QUANTITIES]
        known = known if self.config.quantities else []
        targets = torch.tensor([np.nan] * len(self.labels.components) + known, device=self.device)
        image = augmentation.render_plain(torch.tensor([augmentation.undeformed], device=self.device))
        self._images = torch.cat([self._images, image])
        self._targets = torch.cat([self._targets, targets[None].to(self._targets.dtype)])

    def _randomize_validation(self, val: Samples) -> None:
        """Replace the validation images by several renderings of each, all with randomized optics."""
        s, count = self.settings, self.settings.validation_renderings
        augmentation = OpticsAugmentation(val, s.augmentation_strength, OPTICS[s.optics_ranges], self.device)
        with self._seeded(self._generator(0, 1)):
            every = torch.arange(len(val), device=self.device)
            self._val_images = torch.cat([augmentation.render(every) for _ in range(count)])
        self._val_targets = self._val_targets.repeat(count, 1)

    @property
    def steps_per_epoch(self) -> int:
        """Number of steps per epoch."""
        return -(-(self._count + self.settings.drawn_contacts) // self.config.batch_size)

    @property
    def epochs(self) -> int:
        """Maximum number of epochs."""
        return max(self.settings.epochs, -(-self.settings.min_steps // self.steps_per_epoch))

    @property
    def best_error(self) -> float:
        """Lowest validation error so far, -; infinite before the first epoch."""
        return min((h["val_loss"] for h in self.history), default=math.inf)

    @property
    def finished(self) -> bool:
        """Whether the last epoch is reached or the patience is exhausted."""
        if not self.history:
            return False
        since = self.epoch - 1 - int(np.argmin([h["val_loss"] for h in self.history]))
        return self.epoch >= self.epochs or since >= self.settings.patience

    def train_epoch(self, progress: Callable[[], object] = lambda: None) -> dict[str, float]:
        """Train for one epoch, validate, and return the figures of the epoch.

        Args:
            progress: Called after each step.

        Raises:
            TrainingDiverged: If a loss is not finite.
        """
        start = time.perf_counter()
        rng = self._generator(self.epoch)
        choices = np.arange(self._count)
        if self._source and self._augmentation:
            first = self.epoch - self.epoch % self.settings.drawn_epochs
            if self._drawn_in != first:  # after an interruption, those of an earlier epoch are drawn again
                self._draw(self._source, self._augmentation, rng if first == self.epoch else self._generator(first))
                self._drawn_in = first
            # The undeformed tip lies between the contacts of the set and the drawn ones.
            choices = np.concatenate([choices, self._count + 1 + np.arange(self.settings.drawn_contacts)])
        order = torch.from_numpy(rng.permutation(choices)).to(self.device)
        with self._seeded(rng):
            loss = self._train_steps(order, progress)
        val = self.validation_loss()
        if not math.isfinite(loss) or not math.isfinite(val):
            raise TrainingDiverged(
                f"the training diverged in epoch {self.epoch + 1} (loss {loss}, validation loss {val}): "
                f"try a learning rate below {self.settings.learning_rate:g}"
            )
        figures = {"epoch": self.epoch + 1, "loss": loss, "val_loss": val, "seconds": time.perf_counter() - start}
        if val < self.best_error:
            self.best = {name: tensor.detach().clone() for name, tensor in self.net.state_dict().items()}
        self.history.append(figures)
        self.epoch += 1
        return figures

    def _generator(self, *key: int) -> np.random.Generator:
        """Return the generator of an epoch, or of another key."""
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.settings.seed, spawn_key=key)))

    @contextmanager
    def _seeded(self, rng: np.random.Generator) -> Iterator[None]:
        """Seed torch's generator by a number of another one, and restore it afterwards."""
        with torch.random.fork_rng(devices=[torch.cuda.current_device()] if self.device == "cuda" else []):
            torch.manual_seed(int(rng.integers(2**62)))
            yield

    def _draw(self, source: ContactSource | SlideSource, augmentation: OpticsAugmentation, rng: np.random.Generator) -> None:
        """Replace the drawn contacts by others."""
        drawn, own = source.draw(self.settings.drawn_contacts, rng), self._count + 1
        targets = scaled_targets(drawn, self.labels, self.config).astype(np.float32)
        self._images = torch.cat([self._images[:own], drawn.images])
        self._targets = torch.cat([self._targets[:own], torch.from_numpy(targets).to(self.device)])
        augmentation.replace_drawn(drawn.pin_tips, drawn.directions)

    def _batch(self, chosen: torch.Tensor) -> torch.Tensor:
        """Return images (m, size, size) uint8 of samples `chosen` (m,) int, a fraction of them augmented."""
        if not self._augmentation or not self.settings.augmented_fraction:
            return self._images[chosen]
        plain = torch.rand(len(chosen), 1, 1, device=self.device) >= self.settings.augmented_fraction
        return torch.where(plain, self._images[chosen], self._augmentation.render(chosen))

    def _train_steps(self, order: torch.Tensor, progress: Callable[[], object]) -> float:
        """Train on all images in the given `order` (n,) int; return the mean loss, with penalties."""
        self.net.train()
        schedule = SCHEDULES[self.settings.schedule]
        total, steps = torch.zeros((), device=self.device), self.steps_per_epoch
        for i in range(steps):
            fraction = schedule(self.settings, self.epoch * steps + i, self.epochs * steps) / self.settings.learning_rate
            chosen = order[i * self.config.batch_size : (i + 1) * self.config.batch_size]
            if self._undeformed:
                some = torch.rand(len(chosen), device=self.device) < self._undeformed
                chosen = torch.where(some, torch.full_like(chosen, self._count), chosen)
            with torch.autocast(self.device, dtype=torch.bfloat16, enabled=self._half):
                out = self.net(to_input(self._batch(chosen)))
            each = losses(self.layout.split(out), self._targets[chosen], self.settings.beta)
            loss = each.mean() + self.net.penalty()
            self.net.zero_grad(set_to_none=True)
            loss.backward()
            for optimizer, rate in self._optimizers:
                for group in optimizer.param_groups:
                    group["lr"] = rate * fraction
                optimizer.step()
            total += loss.detach() * len(chosen)
            progress()
        return float(total) / len(order)

    def validation_loss(self, batch: int = 256) -> float:
        """Return the mean loss of the validation set, without weights and penalties, in single precision as in prediction.

        Deviations count after the factor on each component that suits the validation set best, because `deviation_scale`
        multiplies them later. Otherwise the best epoch of a small set would be an early one: deviations become too small
        long before the means stop improving.

        Args:
            batch: Number of images per forward pass.
        """
        images, targets = self._val_images, self._val_targets
        self.net.eval()
        with torch.inference_mode():
            parts = [slice(start, start + batch) for start in range(0, len(images), batch)]
            outputs = torch.cat([self.net(to_input(images[part])) for part in parts])
            return float(scaled_loss(self.layout.split(outputs), targets))

    def deviation_scale(self) -> DeviationScale | None:
        """Return the factors on the best network's deviations that fit the validation set; None if it has none."""
        if not self.config.deviations:
            return None
        net = PoseNet(self.config, self.size, self.layout.size)
        net.load_state_dict(self.best)
        model = Model(to_device(net, self.device), self.config, self.labels, self.size, {})
        targets = self._val_targets.double().cpu().numpy() * model.scales
        return model.with_fitted_scale(self._val_images.cpu().numpy(), targets).deviation_scale

    def state(self) -> dict[str, Any]:
        """Return everything the next epoch depends on: tensors, numbers and text by name."""
        return {
            "net": self.net.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer, _ in self._optimizers],
            "best": self.best,
            "epoch": self.epoch,
            "history": json.dumps(self.history),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned. Raises TactipError where it is not the state of a training of this network."""
        try:
            self.net.load_state_dict(state["net"])
            for (optimizer, _), saved in zip(self._optimizers, state["optimizers"], strict=True):
                optimizer.load_state_dict(saved)
                # torch does not compare the shapes.
                for parameter, values in optimizer.state.items():
                    if any(value.shape not in ((), parameter.shape) for value in values.values()):
                        raise ValueError("an optimizer's state has another shape than its parameter")
            self.best, self.epoch, self.history = state["best"], state["epoch"], json.loads(state["history"])
            if _shapes(self.best) != _shapes(self.net.state_dict()) or self.epoch != len(self.history):
                raise ValueError("the best network or the history does not belong to it")
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise TactipError(
                f"the checkpoint does not fit this training ({reason}): delete checkpoint.pt to restart the training"
            ) from error


def _shapes(state: dict[str, torch.Tensor]) -> dict[str, torch.Size]:
    """Return the shapes of the tensors of a state dict."""
    return {name: tensor.shape for name, tensor in state.items()}


def scaled_targets(samples: Samples | DrawnContacts, labels: Labels, config: PoseNetConfig) -> np.ndarray:
    """Return the targets (n, k) of a network over their scales; NaN where the set does not have them."""
    pose = samples.targets / labels.scale
    return np.concatenate([pose, samples.quantities / [q.scale for q in QUANTITIES]], 1) if config.quantities else pose


def initial_state(
    init_from: Model, config: PoseNetConfig, samples: Samples, random: dict[str, torch.Tensor] | None = None
) -> dict[str, torch.Tensor]:
    """Return the state dict of a model as initial weights, its outputs rescaled to the samples' labels.

    Args:
        init_from: Model with the initial weights.
        config: Network to be trained.
        samples: Training set.
        random: State dict of the network with random weights, for outputs that the model does not have; None to check
            only, or if it has all.

    Raises:
        TactipError: If the model has other layers than `config`, or other images or components than the samples.
    """
    outputs = {"deviations": None, "quantities": None}  # the initial network may have fewer or more
    expected = {**config.shape(), **outputs, "image width": samples.size, "components": samples.labels.components}
    expected["images"] = kind_of(samples.grey)
    initial = {
        **init_from.config.shape(),
        **outputs,
        "image width": init_from.size,
        "components": init_from.labels.components,
        "images": kind_of(init_from.grey),
    }
    differences = [
        f"{name} is {initial[name]}, expected {value}" for name, value in expected.items() if initial[name] != value
    ]
    if differences:
        raise TactipError(f"the initial network does not match the model to be trained: {'; '.join(differences)}")
    state = {name: tensor.detach().cpu().clone() for name, tensor in init_from.net.state_dict().items()}
    ratio = torch.from_numpy((init_from.labels.scale / samples.labels.scale).astype(np.float32))
    last = len(init_from.net.dense) - 1
    components = len(samples.labels.components)
    old, new = Layout(init_from.config, init_from.labels), Layout(config, samples.labels)
    if old.circular is not None and old.circular == new.circular:
        ratio[old.circular] = 1.0  # a sine has no scale
    weight, bias = f"dense.{last}.weight", f"dense.{last}.bias"
    state[weight][:components] *= ratio[:, None]
    state[bias][:components] *= ratio
    if init_from.config.deviations:
        state[bias][old.components : old.components + components] += ratio.log()
    if random is not None and (old.size, old.circular) != (new.size, new.circular):
        own, old_rows = zip(*new.rows_of(old), strict=True)
        for name in (weight, bias):
            values = random[name].clone()
            values[list(own)] = state[name][list(old_rows)]
            state[name] = values
    return state


def _optimizers(net: PoseNet, settings: TrainSettings, half: bool) -> list[tuple[torch.optim.Optimizer, float]]:
    """Return the optimizers of a network, each with its learning rate."""
    inner = inner_weights(net) if settings.muon_learning_rate else []
    of_muon = {id(p) for p in inner}
    rest = [p for p in net.parameters() if id(p) not in of_muon]
    out: list[tuple[torch.optim.Optimizer, float]] = [
        (torch.optim.Adam(rest, lr=settings.learning_rate), settings.learning_rate)
    ]
    return [*out, (Muon(inner, lr=settings.muon_learning_rate, half=half), settings.muon_learning_rate)] if inner else out
