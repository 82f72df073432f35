"""Which learned tips draw the contacts of a training, by the kind of its set."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.drawn_contacts import ContactSource, configuration_of, down_to_the_surface
from tactip_twin.learning.drawn_slides import SlideSource
from tactip_twin.sim.fast_tip.fast_tip import FastTip, any_materials, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.labels import COMPONENTS, Task
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.tactip_model.errors import TactipError

DrawingTip = FastTip | SlidingTip
"""A learned tip of single presses, or one that slides and knows curved surfaces."""


def drawing_tips(samples: Samples, path: Path | None = None) -> tuple[DrawingTip, ...]:
    """Return the learned tips that draw contacts like those of a set: one, and beside it the tip of any materials where the
    set has contacts that the first does not know.

    Args:
        samples: Samples of the set.
        path: File of the first tip; None for the shipped one of the set's sensor and task.

    Raises:
        TactipError: There is none, the file is of another kind, or the set is not simulated.
    """
    c = configuration_of(samples)
    task: Task = "edge" if samples.labels.task == "edge" else "surface"
    if c.needs_sliding_tip:
        return (read_sliding_tip(path or shipped_sliding_tip(task, c.design.name)),)
    randomized = not c.mechanics_randomization.is_identity
    tip = read_fast_tip(path or shipped_fast_tip(task, c.design.name, randomized))
    corners = from_mm_deg(c.pose.bounds().T)
    if tip.materials is not None or not tip.outside(corners, np.zeros((2, 6))).any():
        return (tip,)
    other = read_fast_tip(any_materials(task))
    try:
        other.check_design(c.design)
    except TactipError:
        return (tip,)
    return tip, other


def contact_source(samples: Samples, tips: Sequence[DrawingTip], device: str = "cpu") -> ContactSource | SlideSource:
    """Return the source of contacts like those of a set. Raises TactipError if the tips cannot draw them."""
    if isinstance(tips[0], SlidingTip):
        return SlideSource(samples, tips[0], device)
    return ContactSource(samples, [tip for tip in tips if isinstance(tip, FastTip)], device)


def not_drawn(samples: Samples, tips: Sequence[DrawingTip]) -> list[str]:
    """Return a line for each component of the pose whose range no tip of single presses knows to its ends."""
    known = [down_to_the_surface(tip).ranges for tip in tips if isinstance(tip, FastTip)]
    if not known:
        return []
    least, most = (to_mm_deg(end[:6]) for end in (np.min(known, 0)[:, 0], np.max(known, 0)[:, 1]))
    lines = []
    for k, (low, high) in enumerate(configuration_of(samples).pose.bounds()):
        if COMPONENTS[k] == "Rz" and samples.labels.task == "edge":  # a tip that knows edges knows them at any yaw
            continue
        if low < least[k] - _ROUNDING or high > most[k] + _ROUNDING:
            what = f"{COMPONENTS[k]} from {low:g} to {high:g}, but the learned tips know {least[k]:g} to {most[k]:g} only"
            lines.append(f"the set in {samples.folder} has {what}: no other contacts are drawn")
    return lines


_ROUNDING = 1e-6
"""Distance that a range may reach beyond another because of rounding, mm or degrees."""


def digest_of(tips: Sequence[DrawingTip]) -> str:
    """Return the checksums of tips, in hex, joined by plus signs."""
    return "+".join(tip.digest for tip in tips)
