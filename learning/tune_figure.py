"""Figure of a hyperparameter search."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.view.plot import pyplot
from tactip_twin.tactip_model.errors import TactipError

PARAMETERS = (
    ("conv_layers", False),
    ("filters", True),
    ("dense_layers", False),
    ("dense_units", True),
    ("activation", False),
    ("batch_norm", False),
    ("dropout", False),
    ("l1", True),
    ("l2", True),
    ("batch_size", True),
)
"""Parameters in the figure, each with whether its axis is logarithmic."""


def plot_search(results: Sequence[dict[str, Any]], path: Path, startup: int) -> None:
    """Plot the loss by trial and each parameter by the rank of its loss to a PNG file, with the best trial marked.

    Args:
        results: Results of the trials.
        path: Output file.
        startup: Number of random trials; a vertical line marks their end.

    Raises:
        TactipError: If no trial has a loss.
    """
    plt = pyplot()
    good = sorted((r for r in results if r["status"] == "ok"), key=lambda r: r["trial"])
    if not good:
        raise TactipError("all trials failed or were pruned: see the reasons in results.jsonl")
    losses = np.array([r["loss"] for r in good])
    rank = np.argsort(np.argsort(losses)) + 1
    best = int(losses.argmin())
    figure, axes = plt.subplots(3, 4, figsize=(15, 9))
    axis = axes[0, 0]
    trials = np.array([r["trial"] for r in good])
    axis.semilogy(trials, losses, ".", color="0.5", ms=4)
    axis.semilogy(trials, np.minimum.accumulate(losses), "-", color="C0", lw=1.2)
    axis.semilogy(trials[best], losses[best], "o", color="C3")
    axis.axvline(startup - 0.5, color="0.8", lw=0.8)
    axis.set(xlabel="trial", ylabel="validation loss", title=f"best {losses[best]:.4g}, trial {trials[best]}")
    for axis, (name, logarithmic) in zip(axes.ravel()[1:], PARAMETERS, strict=False):
        values = [r["network"][name] for r in good]
        ticks = sorted(set(values)) if isinstance(values[0], str | bool) else None
        numbers = np.array([ticks.index(v) for v in values] if ticks else values, float)
        axis.plot(rank, numbers, ".", color="0.5", ms=4)
        axis.plot(rank[best], numbers[best], "o", color="C3")
        if ticks:
            axis.set_yticks(range(len(ticks)), [str(t) for t in ticks])
        if logarithmic:
            axis.set_yscale("log", base=10 if name in ("l1", "l2") else 2)
        axis.set(xlabel="rank of its loss", title=name)
    axes[2, 3].axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=90, metadata={"Software": None})
    plt.close(figure)
