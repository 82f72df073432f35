"""Markdown page of an evaluation, with tables and figures."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.evaluate import Evaluation, tables
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.files import write_file

_SMOOTHING = 0.08
"""Standard deviation of the Gaussian that smooths errors along a label, as a fraction of the label's range."""


def write_evaluation(evaluation: Evaluation, samples: Samples, model: Model, folder: str | Path) -> None:
    """Write evaluation.json, evaluation.md, errors.png and worst.png to a folder. Raises OSError."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    record = evaluation.figures | tables(evaluation, samples, model.labels)
    record["data"] = {"folder": samples.folder.name, "digest": samples.dataset.meta.get("digest")}
    write_file(folder / "evaluation.json", (json.dumps(record, indent=1) + "\n").encode())
    write_file(folder / "evaluation.md", markdown(record, model.labels).encode())
    _plot_errors(evaluation, samples, model.labels, folder / "errors.png")
    _plot_worst(evaluation, samples, model.labels, folder / "worst.png")


def markdown(record: dict[str, Any], labels: Labels) -> str:
    """Return the Markdown page of the record in evaluation.json."""
    units = dict(zip(labels.names, labels.units, strict=True))
    lines = [
        f"# Evaluation of a {record['task']} model on {record['samples']} samples",
        "",
        f"{record['parameters']} parameters; {record['latency_ms']:.2f} ms per image on one CPU thread.",
        "",
        "| component | mean absolute error | RMSE | bias | 95th percentile | maximum |",
        "|---|---|---|---|---|---|",
    ]
    for name, unit in units.items():
        row = [f"{record[key][name]:.3f} {unit}" for key in ("mae", "rmse", "bias", "p95", "greatest")]
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    lines += ["", "Top: prediction against label, with the smoothed mean and standard deviation of the error."]
    lines += ["Bottom: absolute error against shear, with its smoothed mean.", ""]
    lines += ["![errors](errors.png)", "", "## Mean absolute error by shear", ""]
    for key, title in (("shear_mm", "shear translation, mm"), ("shear_deg", "shear rotation, °")):
        rows = record["against"][key]
        lines += [f"| {title} | " + " | ".join(f"{r['from']:.1f}–{r['to']:.1f}" for r in rows) + " |"]
        lines += ["|" + "---|" * (len(rows) + 1)]
        lines += [f"| {n}, {u} | " + " | ".join(f"{r['mae'][n]:.3f}" for r in rows) + " |" for n, u in units.items()]
        lines.append("")
    lines += ["## Worst samples", "", "| image | label | prediction | shear, mm and ° |", "|---|---|---|---|"]
    for w in record["worst"]:
        cells = (" ".join(f"{x:.2f}" for x in w[key]) for key in ("label", "prediction", "shear"))
        lines.append(f"| {w['image']} | " + " | ".join(cells) + " |")
    lines += ["", "![worst](worst.png)"]
    return "\n".join(lines) + "\n"


def _smoothed(values: np.ndarray, errors: np.ndarray, at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and standard deviation of errors along values, smoothed by a Gaussian kernel.

    Args:
        values: (n,) values.
        errors: (n,) errors.
        at: (m,) values at which to evaluate.
        width: Standard deviation of the kernel, in the unit of the values.

    Returns:
        Mean (m,) and standard deviation (m,).
    """
    weight = np.exp(-0.5 * ((at[:, None] - values) / width) ** 2)
    weight /= weight.sum(1, keepdims=True)
    mean = weight @ errors
    return mean, np.sqrt(np.maximum(weight @ errors**2 - mean**2, 0))


def _plot_errors(evaluation: Evaluation, samples: Samples, labels: Labels, path: Path) -> None:
    """Plot predictions by label and errors by shear."""
    k = len(labels.names)
    figure, axes = figure_of(2, k, (3.6 * k, 6.6))
    translation = np.linalg.norm(samples.shears[:, :3], axis=1)
    for i, (name, unit) in enumerate(zip(labels.names, labels.units, strict=True)):
        target, error = samples.targets[:, i], evaluation.errors[:, i]
        at = np.linspace(target.min(), target.max(), 60)
        mean, deviation = _smoothed(target, error, at, _SMOOTHING * max(np.ptp(target), 1e-9))
        axes[i].plot(target, target + error, ".", color="0.7", ms=2)
        axes[i].fill_between(at, at + mean - deviation, at + mean + deviation, color=COLORS[0], alpha=0.4, lw=0)
        axes[i].plot(at, at + mean, color=COLORS[0], lw=1.2)
        axes[i].plot(at, at, color="k", lw=0.6)
        axes[i].set(xlabel=f"{name}, {unit}", ylabel=f"prediction, {unit}", title=f"MAE {np.abs(error).mean():.3f} {unit}")
        at = np.linspace(translation.min(), translation.max(), 60)
        mean, _ = _smoothed(translation, np.abs(error), at, _SMOOTHING * max(np.ptp(translation), 1e-9))
        axes[k + i].plot(translation, np.abs(error), ".", color="0.7", ms=2)
        axes[k + i].plot(at, mean, color=COLORS[1], lw=1.5)
        axes[k + i].set(
            xlabel="shear translation, mm", ylabel=f"absolute error, {unit}", ylim=(0, np.quantile(np.abs(error), 0.99))
        )
    save_figure(figure, path)


def _plot_worst(evaluation: Evaluation, samples: Samples, labels: Labels, path: Path) -> None:
    """Plot the worst samples, with label and prediction."""
    worst = np.argsort(-((evaluation.errors / labels.scale) ** 2).sum(1))[:8]
    figure, axes = figure_of(2, 4, (12, 6.6))
    for axis in axes:
        axis.axis("off")
    for axis, i in zip(axes, worst, strict=False):
        axis.imshow(samples.images[i], cmap="gray", interpolation="nearest")
        label = " ".join(f"{x:.1f}" for x in samples.targets[i])
        prediction = " ".join(f"{x:.1f}" for x in evaluation.predictions[i])
        axis.set_title(f"label {label}\npredicted {prediction}", fontsize=8)
    save_figure(figure, path)
