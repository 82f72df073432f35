"""Markdown page of an evaluation, with tables and figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.evaluate import Evaluation, outside, tables
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Model
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.learning.uncertainty import band_text, uncertainty
from tactip_twin.sim.view.plot import COLORS, figure_of, save_figure
from tactip_twin.tactip_model.files import write_file

_SMOOTHING = 0.08
"""Standard deviation of the Gaussian that smooths errors along a label, as a fraction of the label's range."""


def write_evaluation(evaluation: Evaluation, samples: Samples, model: Model, folder: str | Path) -> None:
    """Write evaluation.json, evaluation.md and its figures to a folder. Raises OSError."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    record = evaluation.figures | tables(evaluation, samples, model.labels)
    record["data"] = {"folder": samples.folder.name, "digest": samples.dataset.meta.get("digest")}
    write_file(folder / "evaluation.json", (json.dumps(record, indent=1) + "\n").encode())
    write_file(folder / "evaluation.md", markdown(record, model.labels).encode())
    _plot_errors(evaluation, samples, model.labels, folder / "errors.png")
    _plot_frames(evaluation, samples, model.labels, worst(evaluation, model.labels, 8), folder / "worst.png")
    if evaluation.deviations is not None:
        _plot_uncertainty(record, model.labels, folder / "uncertainty.png")
        order = np.argsort(uncertainty(evaluation.deviations, model.labels.scale), kind="stable")
        _plot_frames(evaluation, samples, model.labels, np.concatenate([order[:4], order[-4:]]), folder / "certain.png")


def markdown(record: dict[str, Any], labels: Labels) -> str:
    """Return the Markdown page of the record in evaluation.json."""
    units = dict(zip(labels.names, labels.units, strict=True))
    lines = [
        f"# Evaluation of a {record['task']} model on {record['samples']} samples",
        "",
        f"{record['parameters']} parameters; {record['latency_ms']:.2f} ms per image on one CPU thread.",
        "",
        "| component | mean absolute error | RMSE | bias | 95th percentile | maximum | labels outside the trained range |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, unit in units.items():
        row = [f"{record[key][name]:.3f} {unit}" for key in ("mae", "rmse", "bias", "p95", "greatest")]
        row.append(f"{100 * record['labels_outside'][name]:.1f} %")
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    constant = [name for name, varies in record["varies"].items() if not varies]
    if constant:
        lines += ["", f"The figure leaves out {', '.join(constant)}, which hardly varies in this set."]
    lines += [
        "",
        "Top: prediction against label, with the smoothed mean and standard deviation of the error. Labels outside ",
    ]
    lines[-1] += "the range in which the network was trained are orange, and their background is grey."
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
    return "\n".join(lines + _beside_the_pose(record) + _uncertainty(record, units)) + "\n"


def _beside_the_pose(record: dict[str, Any]) -> list[str]:
    """Return the lines on shear, force, slip and contact; none if the network or the set has none."""
    lines, units = [], {q.name: q.unit for q in QUANTITIES}
    if "quantities" in record:
        lines += ["", "## Shear, force and slip", "", "| quantity | mean absolute error |", "|---|---|"]
        lines += [f"| {name} | {value:.3f} {units[name]} |" for name, value in record["quantities"].items()]
    if "contact" in record:
        c = record["contact"]
        line = f"Contact: {100 * c['missed_fraction']:.1f} % of {c['samples_in_contact']} contacts missed"
        if c["samples_without"]:
            line += f", {100 * c['false_fraction']:.1f} % of {c['samples_without']} images without contact taken for one"
        lines += ["", f"{line}."]
    return lines


def _uncertainty(record: dict[str, Any], units: dict[str, str]) -> list[str]:
    """Return the lines on standard deviations; none if the network has none. units: unit by component of the pose."""
    if "reliability" not in record:
        return []
    lines = ["", "## Standard deviations", "", "![uncertainty](uncertainty.png)", ""]
    lines += ["Fraction of the labels inside of the interval of each probability about the estimate:", ""]
    names = list(record["reliability"][0]["coverage"])
    lines += ["| probability | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 1)]
    for row in record["reliability"]:
        lines.append(f"| {row['level']:.0%} | " + " | ".join(f"{100 * row['coverage'][n]:.1f} %" for n in names) + " |")
    lines += ["", "Mean absolute errors of what is kept when the least certain estimates are left out:", ""]
    lines += ["| left out | " + " | ".join(units) + " |", "|" + "---|" * (len(units) + 1)]
    for row in record["rejection"]:
        lines.append(f"| {row['left_out']:.0%} | " + " | ".join(f"{row['mae'][n]:.3f} {u}" for n, u in units.items()) + " |")
    if "by_force" in record:
        lines += ["", "By normal force: mean absolute error, and the labels inside of the 68 % and 95 % intervals:", ""]
        lines += force_table(record["by_force"], units)
    return [*lines, "", "The four most certain estimates, and the four least certain:", "", "![certain](certain.png)"]


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
    """Plot predictions by label and errors by shear, of the components that vary; of all if none does."""
    varying = [i for i, name in enumerate(labels.names) if evaluation.figures["varies"][name]] or range(len(labels.names))
    k, beyond = len(varying), outside(samples.targets, labels)
    figure, axes = figure_of(2, k, (3.6 * k, 6.6))
    translation = np.linalg.norm(samples.shears[:, :3], axis=1)
    for i, component in enumerate(varying):
        name, unit = labels.names[component], labels.units[component]
        target, error = samples.targets[:, component], evaluation.errors[:, component]
        at = np.linspace(target.min(), target.max(), 60)
        mean, deviation = _smoothed(target, error, at, _SMOOTHING * max(np.ptp(target), 1e-9))
        for marked, color in ((False, "0.7"), (True, COLORS[4])):
            chosen = beyond[:, component] == marked
            axes[i].plot(target[chosen], (target + error)[chosen], ".", color=color, ms=2)
        low, high = axes[i].get_xlim()
        for start, end in ((low, labels.low[component]), (labels.high[component], high)):
            if beyond[:, component].any() and start < end:
                axes[i].axvspan(start, end, color="0.95", lw=0, zorder=0)
        axes[i].set_xlim(low, high)
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


def force_table(rows: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[str]:
    """Return the lines of a Markdown table of errors and coverage by normal force.

    Args:
        rows: Rows of uncertainty.by_force.
        units: Unit by component.
    """
    lines = ["| normal force, N | contacts | " + " | ".join(units) + " |", "|" + "---|" * (len(units) + 2)]
    for row in rows:
        cells = [
            f"{row['mae'][n]:.3f} {u} ({100 * row['coverage_68'][n]:.0f} %, {100 * row['coverage_95'][n]:.0f} %)"
            for n, u in units.items()
        ]
        lines.append(f"| {band_text(row)} | {row['samples']} | " + " | ".join(cells) + " |")
    return lines


def _plot_uncertainty(record: dict[str, Any], labels: Labels, path: Path) -> None:
    """Plot coverage over probability, error over what is left out, and error over force, of the pose's components."""
    figure, axes = figure_of(1, 3, (13, 4.0))
    for name, unit, color in zip(labels.names, labels.units, COLORS, strict=False):
        rows = record["reliability"]
        axes[0].plot([r["level"] for r in rows], [r["coverage"][name] for r in rows], "o-", color=color, ms=3, label=name)
        rows = record["rejection"]
        axes[1].plot([r["left_out"] for r in rows], [r["mae"][name] / rows[0]["mae"][name] for r in rows], "o-", color=color)
        rows = record.get("by_force", [])
        at = range(len(rows))
        axes[2].plot(at, [r["mae"][name] for r in rows], "o-", color=color, label=f"{name}, {unit}")
        # The mean absolute value of a normal variable is 0.8 of its deviation.
        axes[2].plot(at, [np.sqrt(2 / np.pi) * r["deviation"][name] for r in rows], "--", color=color, lw=0.8)
    axes[0].plot([0.5, 1], [0.5, 1], color="k", lw=0.6)
    axes[0].set(xlabel="probability of the interval", ylabel="fraction of labels inside")
    axes[0].legend(fontsize=8)
    axes[1].set(xlabel="fraction of estimates left out", ylabel="error / error of all", ylim=(0, None))
    axes[2].set(xlabel="normal force, N", ylabel="mean absolute error, mm or ° (dashed: expected)", yscale="log")
    axes[2].set_xticks(range(len(record.get("by_force", []))))
    axes[2].set_xticklabels(
        [f"{r['from_N']:g}–{r['to_N']:g}" if r["to_N"] else f"> {r['from_N']:g}" for r in record.get("by_force", [])]
    )
    axes[2].legend(fontsize=8)
    save_figure(figure, path)


def worst(evaluation: Evaluation, labels: Labels, count: int) -> np.ndarray:
    """Return the indices (count,) of the samples with the largest errors over the scales, the largest first."""
    return np.argsort(-((evaluation.errors / labels.scale) ** 2).sum(1))[:count]


def _plot_frames(evaluation: Evaluation, samples: Samples, labels: Labels, chosen: np.ndarray, path: Path) -> None:
    """Plot eight samples with indices `chosen`, with label and prediction, and deviations if there are any."""
    figure, axes = figure_of(2, 4, (12, 6.2 + 0.3 * len(labels.names)))
    for axis in axes:
        axis.axis("off")
    for axis, i in zip(axes, chosen, strict=False):
        axis.imshow(samples.images[i], cmap="gray", interpolation="nearest")
        lines = []
        for k, (name, unit) in enumerate(zip(labels.components, labels.units, strict=True)):
            lines.append(f"{name} {samples.targets[i, k]:.1f}, predicted {evaluation.predictions[i, k]:.1f}")
            lines[-1] += f" {unit}" if evaluation.deviations is None else f" ± {evaluation.deviations[i, k]:.2g} {unit}"
        axis.set_title("\n".join(lines), fontsize=8)
    save_figure(figure, path)
