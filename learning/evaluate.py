"""How well a model reads poses: errors by component, by label, by shear; worst cases; and what an answer costs."""

import time
from dataclasses import dataclass

import numpy as np

from tactip_twin.learning.data import check_alike
from tactip_twin.learning.posenet import parameter_count

BINS = 10
"""Bins of a label or of the size of the shear."""

WORST = 8
"""Samples that are named as the worst."""

_LATENCY_CALLS = 60


@dataclass(frozen=True)
class Evaluation:
    """A model on a set. (n samples, k components)"""

    predictions: np.ndarray
    """(n, k), mm and degrees."""
    errors: np.ndarray
    """(n, k), prediction minus label, mm and degrees."""
    figures: dict
    """What `tactip evaluate --json` prints, and tables beside it."""


def evaluate(model, samples):
    """Evaluate a Model on Samples. Returns an Evaluation.

    Raises TactipError where the two are of different tasks or image sizes.
    """
    check_alike(samples, model.labels.task, model.size, "the model")
    predictions = model.predict(samples.images)
    errors = predictions - samples.targets
    names = model.labels.names

    def by_name(values):
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    figures = {
        "task": model.labels.task,
        "samples": len(samples),
        "mae": by_name(np.abs(errors).mean(0)),
        "rmse": by_name(np.sqrt((errors**2).mean(0))),
        "bias": by_name(errors.mean(0)),
        "p95": by_name(np.quantile(np.abs(errors), 0.95, axis=0)),
        "greatest": by_name(np.abs(errors).max(0)),
        "loss": float(((errors / model.labels.scale) ** 2).sum(1).mean()),
        "latency_ms": latency_ms(model),
        "parameters": parameter_count(model.net),
    }
    return Evaluation(predictions, errors, figures)


def tables(evaluation, samples, labels):
    """Errors against each label, against shear, and the worst samples: a dict (JSON) of an Evaluation on its Samples."""
    absolute = np.abs(evaluation.errors)
    sizes = {"shear_mm": np.linalg.norm(samples.shears[:, :3], axis=1)}
    sizes["shear_deg"] = np.linalg.norm(samples.shears[:, 3:], axis=1)
    against = {name: samples.targets[:, i] for i, name in enumerate(labels.names)} | sizes
    worst = np.argsort(-((evaluation.errors / labels.scale) ** 2).sum(1))[:WORST]
    return {
        "against": {name: binned(values, absolute, labels.names) for name, values in against.items()},
        "worst": [
            {
                "image": samples.dataset.images[i],
                "label": _rounded(samples.targets[i]),
                "prediction": _rounded(evaluation.predictions[i]),
                "shear": _rounded(samples.shears[i]),
            }
            for i in worst
        ],
    }


def binned(values, absolute, names):
    """Mean absolute errors over BINS bins of equally many samples.

    values: (n,), by which they are sorted. absolute: (n, k). names: k str. Returns a list of dict: the bin's mean value, its
    ends, its count, and the mean error of each component with its standard error.
    """
    order = np.argsort(values, kind="stable")
    rows = []
    for part in np.array_split(order, min(BINS, len(order))):
        some = absolute[part]
        deviation = some.std(0, ddof=1) / np.sqrt(len(part)) if len(part) > 1 else np.full(len(names), np.nan)
        rows.append(
            {
                "mean": float(values[part].mean()),
                "from": float(values[part].min()),
                "to": float(values[part].max()),
                "samples": len(part),
                "mae": {n: float(x) for n, x in zip(names, some.mean(0), strict=True)},
                "standard_error": {n: float(x) for n, x in zip(names, deviation, strict=True) if np.isfinite(x)},
            }
        )
    return rows


def _rounded(values):
    return [float(f"{x:.5g}") for x in values]


def latency_ms(model):
    """Median time (float), ms, from one image to its pose, with one thread on a CPU."""
    image, times = np.zeros((1, model.size, model.size), np.uint8), []
    for _ in range(_LATENCY_CALLS):
        start = time.perf_counter()
        model.predict(image)
        times.append(time.perf_counter() - start)
    return float(1e3 * np.median(times[_LATENCY_CALLS // 6 :]))
