"""Figure of a hyperparameter search."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.view.plot import COLORS, figure_of, log_axis, save_figure
from tactip_twin.tactip_model.errors import TactipError

PARAMETERS = {
    "conv_layers": ("convolutional layers", False),
    "filters": ("filters", True),
    "dense_layers": ("dense layers", False),
    "dense_units": ("units per dense layer", True),
    "activation": ("activation", False),
    "batch_norm": ("batch normalization", False),
    "dropout": ("dropout", False),
    "l1": ("L1 penalty", True),
    "l2": ("L2 penalty", True),
    "batch_size": ("batch size", True),
}
"""Titles of the parameters in the figure, and whether their axes are logarithmic."""

_WORDS = {"True": "yes", "False": "no", "relu": "ReLU", "elu": "ELU"}
"""Titles of values."""


def plot_search(results: Sequence[dict[str, Any]], path: Path, random_trials: int) -> None:
    """Plot the loss by trial and each parameter by the rank of its loss to a PNG file, with the best trial marked.

    Args:
        results: Results of the trials.
        path: Output file.
        random_trials: Number of random trials; a vertical line marks their end.

    Raises:
        TactipError: If no trial has a loss.
    """
    good = sorted((r for r in results if r["status"] == "ok"), key=lambda r: r["trial"])
    if not good:
        raise TactipError("all trials failed or were pruned: see the reasons in results.jsonl")
    losses = np.array([r["loss"] for r in good])
    rank = np.argsort(np.argsort(losses)) + 1
    best = int(losses.argmin())
    figure, axes = figure_of(3, 4, (13, 8))
    axis = axes[0]
    trials = np.array([r["trial"] for r in good])
    axis.plot(trials, losses, ".", color="0.5")
    axis.plot(trials, np.minimum.accumulate(losses), "-", color=COLORS[0], lw=1.2)
    axis.plot(trials[best], losses[best], "o", color=COLORS[1])
    axis.axvline(random_trials - 0.5, color="0.6", lw=0.8)
    log_axis(axis, "y")
    axis.set(xlabel="trial", ylabel="validation loss", title=f"best {losses[best]:.4g}, trial {trials[best]}")
    for axis, (name, (title, logarithmic)) in zip(axes[1:], PARAMETERS.items(), strict=False):
        values = [r["network"][name] for r in good]
        named = isinstance(values[0], str | bool)
        ticks = sorted(set(values)) if named or isinstance(values[0], int) else None
        numbers = np.array([ticks.index(v) for v in values] if named and ticks else values, float)
        axis.plot(rank, numbers, ".", color="0.5")
        axis.plot(rank[best], numbers[best], "o", color=COLORS[1])
        if logarithmic:
            axis.set_yscale("log")
        if ticks:
            axis.set_yticks(range(len(ticks)) if named else ticks, [_WORDS.get(str(t), str(t)) for t in ticks])
            axis.minorticks_off()
        axis.set(xlabel="rank of the loss", ylabel=title)
    for axis in axes[1 + len(PARAMETERS) :]:
        axis.axis("off")
    save_figure(figure, path)
