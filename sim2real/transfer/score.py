"""Errors of a network on samples of a real set."""

from typing import Any, Protocol

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import Estimates
from tactip_twin.learning.uncertainty import coverage
from tactip_twin.sim2real.transfer.linear_errors import linear_errors

MIN_SPREAD = 0.02
"""Minimum standard deviation of a label that varies, as a fraction of its maximum."""

INTERVALS = (0.68, 0.95)
"""Probabilities of the intervals whose coverage is reported."""


class Estimator(Protocol):
    """Anything that estimates components from tactile images, such as a Model."""

    def estimate(self, images: np.ndarray) -> Estimates:
        """Return estimates, components first, in mm and degrees, from images (n, size, size)."""
        ...


def score(model: Estimator, samples: Samples) -> dict[str, Any]:
    """Return the errors of a network on samples of a real set: mae, rmse, bias, and mae without the depth's offset.

    A rig's depth has an offset of some tenths of a millimetre: for the depth only, the median error is also taken out
    (`mae_zeroed`). A set gives no errors of components that do not vary in it; `varies` tells which do. `linear` is the
    linear part of the errors (linear_errors.py); `coverage_68` and `coverage_95` are the fractions of labels inside of the
    network's intervals of that probability, if it has standard deviations.
    """
    estimates, count = model.estimate(samples.images), len(samples.labels.components)
    predictions = samples.labels.unwrapped(estimates.means[:, :count], samples.targets)
    errors = predictions - samples.targets
    names = samples.labels.names
    zeroed = errors - np.where([name == "pose_z" for name in names], np.median(errors, 0), 0.0)

    varies = samples.targets.std(0) > MIN_SPREAD * samples.labels.scale

    def by_name(values: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    inside = {}
    if estimates.deviations is not None:
        deviations = estimates.deviations[:, :count]
        inside = {f"coverage_{100 * level:.0f}": by_name(coverage(errors, deviations, level)) for level in INTERVALS}
    return {
        "samples": len(samples),
        "mae": by_name(np.abs(errors).mean(0)),
        "mae_zeroed": by_name(np.abs(zeroed).mean(0)),
        "rmse": by_name(np.sqrt((errors**2).mean(0))),
        "bias": by_name(errors.mean(0)),
        "varies": {name: bool(v) for name, v in zip(names, varies, strict=True)},
        "linear": linear_errors(predictions, samples),
        **inside,
    }
