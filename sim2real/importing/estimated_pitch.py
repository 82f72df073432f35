"""Pitch of the pins of a real tip, which its neutral image cannot tell from the lens, estimated from pressed frames.

Pins that are closer together lie farther from the clamped rim of the skin, so the outer ones move more. For each pitch that
is tried, the lens shows the pins where the neutral image has them, and the learned tip explains the frames as well as it
can, with the most likely materials. A parabola through the squared distances tells which pitch explains them best.
"""

from collections.abc import Callable, Sequence

import numpy as np

from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.estimated_contacts import ContactModel, contact_model, pins_of_some
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.neutral_image import widest_spacing, with_spacing

_STEP = 0.05
"""Step of the factors of the pitch that are tried, in logarithms [?]."""

_MAX_STEPS = 5
"""Largest number of steps to each side [?]."""


def with_estimated_pitch(
    design: Design, blobs: Sequence[np.ndarray], task: Task, seed: int = 0
) -> tuple[Design, dict[str, float]]:
    """Return a design with the pitch that explains the pins of some frames best, whatever their poses; and the distance of
    detected and simulated pins, px of 256, by the factor of each pitch that was tried.

    Args:
        design: The design, fitted to the sensor's neutral image.
        blobs: (n) centres (k, 2) of the blobs of frames of presses, px of 256.
        task: Their stimulus.
        seed: Seed of the choice of frames.

    Raises:
        TactipError: If too few frames show their pins.
    """
    rng = np.random.default_rng(seed)
    pins = pins_of_some(blobs, design, rng)
    factor, found = most_likely_pitch(design, pins, task, rng, contact_model(design, pins, task, rng))
    return with_spacing(design, factor), {f"{tried:.3f}": px for tried, px in found.items()}


def most_likely_pitch(
    design: Design, pins: np.ndarray, task: Task, rng: np.random.Generator, model: ContactModel
) -> tuple[float, dict[float, float]]:
    """Return the factor of a design's pitch that explains pins best, and their distance, px of 256, by the factor of each
    pitch that was tried.

    Args:
        design: The design.
        pins: (n, p, 2) px of 256, from some_of or pins_of_some.
        task: Stimulus of the frames.
        rng: Generator for contact_model.
        model: Its result for the design and these pins.
    """
    widest = min(_MAX_STEPS, int(np.log(widest_spacing(design)) / _STEP))

    def apart_px(step: int) -> float:
        if step == 0:
            return model.after_px
        return contact_model(with_spacing(design, _factor(step)), pins, task, rng, model).after_px

    step, found = lowest(apart_px, -_MAX_STEPS, widest)
    return _factor(step), {_factor(k): px for k, px in sorted(found.items())}


def _factor(step: float) -> float:
    """Return the factor of the pitch after a number of steps."""
    return float(np.exp(step * _STEP))


def lowest(values: Callable[[int], float], low: int, high: int) -> tuple[float, dict[int, float]]:
    """Return where a positive function of the whole numbers from `low` to `high` is lowest, and its values that were needed.

    The search goes downhill from 0, and a parabola through squared values tells the place between whole numbers. There must
    be at least three of these, 0 among them.
    """
    found = {0: values(0)}
    while True:
        best = min(found, key=found.__getitem__)
        middle = min(max(best, low + 1), high - 1)
        around = range(middle - 1, middle + 2)
        if found.keys() >= set(around):
            break
        found |= {k: values(k) for k in around if k not in found}
    before, here, after = (found[k] ** 2 for k in around)
    bend = before - 2 * here + after
    vertex = middle + 0.5 * (before - after) / bend if bend > 0 else best
    return float(np.clip(vertex, min(found), max(found))), found
