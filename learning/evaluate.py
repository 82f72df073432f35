"""Evaluation of a model on a set: errors by component, label and shear, worst samples and latency."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples, check_compatible
from tactip_twin.learning.image_check import design_of, image_check, recorded_design
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import Estimates, Model
from tactip_twin.learning.posenet import parameter_count
from tactip_twin.learning.quantities import forces_of
from tactip_twin.learning.uncertainty import by_force, by_rejection, contact_figures, negative_log_likelihood, reliability
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins

BINS = 10
"""Number of bins of a label or of the shear's magnitude."""

WORST = 8
"""Number of worst samples that are reported."""

_LATENCY_CALLS = 60


_MIN_SPREAD = 0.02
"""Minimum standard deviation of a label that varies, as a fraction of its maximum."""


@dataclass(frozen=True)
class Evaluation:
    """Predictions and errors of a model on a set of n samples with k components."""

    predictions: np.ndarray
    """(n, k), mm and degrees."""
    errors: np.ndarray
    """(n, k), prediction minus label, mm and degrees."""
    deviations: np.ndarray | None
    """(n, k) estimated standard deviations, mm and degrees; None if the network has none."""
    figures: dict[str, Any]
    """Figures that `tactip evaluate --json` prints, as JSON."""


def check_same_pins(model: Model, samples: Samples, at_rest: int = 0) -> None:
    """Check that the images of a model's training and of a set show about as many pins.

    Args:
        model: The model.
        samples: The set.
        at_rest: Number of pins in the set's neutral image; 0 if there is none.

    Raises:
        TactipError: If the numbers of pins differ by more than a fifth. A training that does not record its design passes,
            and so do grey frames, in which pins cannot be counted.
    """
    learned = _pin_count(design_of(model))
    shown = _pin_count(recorded_design(samples.dataset.meta["configuration"])) or at_rest or _detected_pins(samples)
    if learned and shown and abs(shown - learned) > _MAX_PIN_DIFFERENCE * learned:
        raise TactipError(
            f"the images in {samples.folder} show {shown} pins, but the network was trained on images of {learned}, so its "
            "predictions are meaningless; add --any-sensor to evaluate it anyway"
        )


_MAX_PIN_DIFFERENCE = 0.2
"""Fraction by which the numbers of pins may differ: pins merge or leave the image. An estimate [?]."""

_DETECTION_FRAMES = 20
"""Number of images in which the pins of an imported set are detected."""


def _pin_count(design: Design | None) -> int:
    """Return the number of pins of a design; 0 if there is none."""
    return 0 if design is None else len(neutral_pins(design)[0])


def _detected_pins(samples: Samples) -> int:
    """Return the median number of pins that are detected in _DETECTION_FRAMES images of a set; 0 if they are grey."""
    if samples.grey:
        return 0
    chosen = np.unique(np.linspace(0, len(samples) - 1, _DETECTION_FRAMES).astype(int))
    return int(np.median([len(find_blobs(samples.images[i]).centres) for i in chosen]))


MAX_OUTSIDE_FRACTION = 0.05
"""Fraction of predictions far outside the learned range above which a network does not suit a set. An estimate [?]."""

_FAR = 0.25
"""Distance from the learned range, as a fraction of its width, beyond which a prediction is far outside [?]."""


def _outside_fraction(predictions: np.ndarray, labels: Labels) -> float:
    """Return the fraction of predictions (n, k) of which a component lies far outside the learned range."""
    low, high = np.array(labels.low), np.array(labels.high)
    margin = _FAR * (high - low)
    return float(((predictions < low - margin) | (predictions > high + margin)).any(1).mean())


def outside(targets: np.ndarray, labels: Labels) -> np.ndarray:
    """Return which labels (n, k) lie outside the range in which a network was trained, (n, k) bool."""
    margin = 1e-6 * labels.scale
    return (targets < np.array(labels.low) - margin) | (targets > np.array(labels.high) + margin)


def evaluate(model: Model, samples: Samples) -> Evaluation:
    """Evaluate a model on samples. Raises TactipError if their tasks or images differ."""
    check_compatible(samples, model.labels.task, model.size, model.grey, "the model")
    estimates = model.estimate(samples.images)
    k = len(model.labels.names)
    predictions = model.labels.unwrapped(estimates.means[:, :k], samples.targets)
    check = image_check(model)
    unlike = check.of(samples.images) if check else (None, "")
    errors = predictions - samples.targets
    names = model.labels.names

    def by_name(values: np.ndarray) -> dict[str, float]:
        """Return values (k,) by component."""
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
        "varies": {
            n: bool(v) for n, v in zip(names, samples.targets.std(0) > _MIN_SPREAD * model.labels.scale, strict=True)
        },
        "labels_outside": by_name(outside(samples.targets, model.labels).mean(0)),
        "outside_fraction": _outside_fraction(predictions, model.labels),
        "unlike_image_fraction": unlike[0],
        "unlike_in": unlike[1],
        "latency_ms": latency_ms(model),
        "parameters": parameter_count(model.net),
    }
    deviations = None if estimates.deviations is None else estimates.deviations[:, :k]
    return Evaluation(predictions, errors, deviations, figures | _of_quantities(model, samples, estimates))


def _of_quantities(model: Model, samples: Samples, estimates: Estimates) -> dict[str, Any]:
    """Return the figures of what a network estimates beside the pose, and of its deviations, as JSON; empty if nothing."""
    names, k, out = list(model.columns), len(model.labels.names), {}
    targets = np.concatenate([samples.targets, samples.quantities], 1)[:, : len(names)]
    errors = model.labels.unwrapped(estimates.means, targets) - targets
    known = np.asarray(np.isfinite(errors).any(0))
    if known[k:].any():
        chosen = [i for i in range(k, len(names)) if known[i]]
        out["quantities"] = {names[i]: float(np.nanmean(np.abs(errors[:, i]))) for i in chosen}
    forces = forces_of(samples.quantities)
    if estimates.contact is not None and np.isfinite(forces).any():
        out["contact"] = contact_figures(estimates.contact, forces)
    if estimates.deviations is None:
        return out
    seen = [i for i in range(len(names)) if known[i]]
    shown, of_shown, deviations = [names[i] for i in seen], errors[:, seen], estimates.deviations[:, seen]
    out["reliability"] = reliability(of_shown, deviations, shown)
    out["nll"] = dict(zip(shown, map(float, negative_log_likelihood(of_shown, deviations)), strict=True))
    out["rejection"] = by_rejection(errors[:, :k], estimates.deviations[:, :k], model.labels.scale, names[:k])
    normal = samples.dataset.measures["normal_force_N"][samples.rows]
    if np.isfinite(normal).all():
        out["by_force"] = by_force(of_shown, deviations, normal, shown)
    return out


def tables(evaluation: Evaluation, samples: Samples, labels: Labels) -> dict[str, Any]:
    """Return the errors by label and by shear, and the worst samples, as JSON."""
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


def binned(values: np.ndarray, absolute: np.ndarray, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return mean absolute errors in BINS bins with equal numbers of samples.

    Args:
        values: (n,) values by which the samples are sorted.
        absolute: (n, k) absolute errors.
        names: Names of the k components.

    Returns:
        A dict per bin: mean value, ends, count, and the mean error of each component with its standard error.
    """
    order = np.argsort(values, kind="stable")
    rows = []
    for part in np.array_split(order, min(BINS, len(order))):
        errors = absolute[part]
        deviation = errors.std(0, ddof=1) / np.sqrt(len(part)) if len(part) > 1 else np.full(len(names), np.nan)
        rows.append(
            {
                "mean": float(values[part].mean()),
                "from": float(values[part].min()),
                "to": float(values[part].max()),
                "samples": len(part),
                "mae": {n: float(x) for n, x in zip(names, errors.mean(0), strict=True)},
                "standard_error": {n: float(x) for n, x in zip(names, deviation, strict=True) if np.isfinite(x)},
            }
        )
    return rows


def _rounded(values: np.ndarray) -> list[float]:
    """Return values rounded to five significant digits."""
    return [float(f"{x:.5g}") for x in values]


def latency_ms(model: Model) -> float:
    """Return the median time, ms, from one image to its pose, with one thread on a CPU."""
    image, times = np.zeros((1, model.size, model.size), np.uint8), []
    for _ in range(_LATENCY_CALLS):
        start = time.perf_counter()
        model.predict(image)
        times.append(time.perf_counter() - start)
    return float(1e3 * np.median(times[_LATENCY_CALLS // 6 :]))
