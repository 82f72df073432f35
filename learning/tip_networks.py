"""Training of the networks of learned tips, one by one; finished ones are kept, so a training resumes."""

import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, Protocol

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.sim.fast_tip.network import Network
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_arrays


class Perceptron(torch.nn.Module):
    """The torch version of sim/fast_tip/network.Network."""

    def __init__(self, inputs: int, width: int, layers: int, outputs: int, skip: bool = False) -> None:
        """Take the numbers of inputs, of units per layer, of residual layers and of outputs; skip: add a linear map."""
        super().__init__()
        self.first, self.last = torch.nn.Linear(inputs, width), torch.nn.Linear(width, outputs)
        self.residual = torch.nn.ModuleList([torch.nn.Linear(width, width) for _ in range(layers)])
        self.skip = torch.nn.Linear(inputs, outputs, bias=False) if skip else None

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return outputs (n, out) for inputs (n, in)."""
        hidden = torch.nn.functional.silu(self.first(x))
        for layer in self.residual:
            hidden = hidden + torch.nn.functional.silu(layer(hidden))
        out = self.last(hidden)
        return out if self.skip is None else out + self.skip(x)

    def exported(self) -> Network:
        """Return the network for numpy."""
        # Parameters by name: weight, then bias, of each layer.
        layers = (self.first, *self.residual, self.last)
        tensors = [parameter for layer in layers for parameter in layer.parameters()]
        arrays = [tensor.detach().numpy().copy() for tensor in tensors]
        skip = None if self.skip is None else self.skip.weight.detach().numpy().copy()
        return Network(tuple(arrays), skip)


class NetworkSettings(Protocol):
    """Settings of the training of a network."""

    @property
    def steps(self) -> int:
        """Number of training steps."""
        ...

    @property
    def learning_rate(self) -> float:
        """Highest learning rate of a one-cycle schedule."""
        ...

    @property
    def weight_decay(self) -> float:
        """Weight decay of AdamW."""
        ...


def train_network(
    network: Callable[[], Perceptron],
    loss: Callable[[Perceptron, torch.Generator, int], torch.Tensor],
    settings: NetworkSettings,
    seed: int,
    bar: "tqdm[NoReturn]",
) -> Network:
    """Train a network and return it.

    Args:
        network: Makes the network, with weights from torch's generator.
        loss: Loss of a batch that it draws with the given generator, at a training step.
        settings: Settings.
        seed: Seed of weights and batches.
        bar: Progress bar, which advances with each step.

    Raises:
        Interrupted: Ctrl-C.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        trained = network()
    optimizer = torch.optim.AdamW(trained.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    try:
        for step in range(settings.steps):
            optimizer.zero_grad()
            loss(trained, generator, step).backward()
            optimizer.step()
            schedule.step()
            bar.update()
    except KeyboardInterrupt:
        raise Interrupted("finished networks are saved: run the same command to resume") from None
    return trained.exported()


def train_networks(
    train: Callable[[int, "tqdm[NoReturn]"], Network], count: int, steps: int, out: Path, quiet: bool
) -> list[Network]:
    """Return `count` networks: finished ones from the folder `out`, the others as `train` returns them by their number.

    Args:
        train: Trains a network.
        count: Number of networks.
        steps: Number of training steps of each.
        out: Folder of the training.
        quiet: Whether to hide the progress bar.
    """
    networks = []
    interval = 0.5 if sys.stderr.isatty() else 15
    with tqdm(total=count * steps, unit="step", file=sys.stderr, mininterval=interval, disable=quiet) as bar:
        for member in range(count):
            path = out / f"network-{member}.npz"
            network = _finished(path)
            if network is None:
                network = train(member, bar)
                data = io.BytesIO()
                np.savez(data, allow_pickle=False, **network.arrays("array"))
                write_file(path, data.getvalue())
            else:
                bar.update(steps)
            networks.append(network)
    return networks


def _finished(path: Path) -> Network | None:
    """Return the network in a file; None if there is none, or it is damaged."""
    if not path.exists():
        return None
    try:
        arrays = read_arrays(path)
        skip = arrays.pop("array_skip", None)
        return Network(tuple(arrays[f"array_{k}"] for k in range(len(arrays))), skip)
    except (TactipError, KeyError):
        return None


def turned_pairs(values: torch.Tensor, firsts: Sequence[int], angle: torch.Tensor) -> torch.Tensor:
    """Return values (n, …) whose pairs, which begin at `firsts`, are turned by angles (n,), rad."""
    values, cosine, sine = values.clone(), torch.cos(angle), torch.sin(angle)
    for k in firsts:
        x, y = values[:, k].clone(), values[:, k + 1].clone()
        values[:, k], values[:, k + 1] = cosine * x - sine * y, sine * x + cosine * y
    return values
