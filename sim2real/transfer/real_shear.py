"""A network's shear on real frames, compared with the part of the commanded move that each frame shows.

Cameras lag, so many frames show the tip amid its move or before it. How much of the move a frame shows follows from all of
its pins together (calibration/moves.py), at the pose of its row. While the skin sticks, the effective shear is that part of
the move; so only short moves are compared.
"""

from typing import Any

import numpy as np

from tactip_twin.learning.data import Samples
from tactip_twin.learning.model import Model
from tactip_twin.sim.labels import SHEARS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.calibration.moves import FAST, best_fraction, can_predict, pin_pixels, predict_along
from tactip_twin.sim2real.transfer.sim_gap import detect_pins
from tactip_twin.tactip_model.design import Design

FRAMES = 300
"""Number of frames that are compared."""

MAX_MOVE_MM = 2.0
"""Maximum length of a move that is compared, mm: the skin of both published tips sticks about as far [M]."""

_MIN_SPREAD_MM = 0.3
"""Minimum standard deviation of a commanded component that is compared, mm [?]."""

_BAD_FIT, _MIN_FRAMES = 2.0, 20
"""Median distance of a frame's pins, in medians over all frames, above which it is left out; minimum number of frames."""


def real_shear(model: Model, samples: Samples, design: Design, seed: int = 0) -> dict[str, Any] | None:
    """Return how a network's effective shear agrees with the moves of a real set, as JSON.

    Args:
        model: The network.
        samples: Samples of a real set on a surface.
        design: Design of its sensor.
        seed: Seed of the choice of frames.

    Returns:
        Number of frames, median fraction of the move that they show, and for each component that varies: correlation,
        slope of estimated over shown shear, and mean absolute error, mm. None where there is nothing to compare: on an edge,
        for a network without quantities, a tip that no learned tip knows, or a set without shear.
    """
    names = [f"effective_shear_{axis}_mm" for axis in "xy"]
    if samples.labels.task != "surface" or not model.config.quantities or not can_predict(design):
        return None
    length = np.linalg.norm(samples.shears[:, :3], axis=1)
    short = np.flatnonzero(length <= MAX_MOVE_MM)
    varies = samples.shears[short, :2].std(0) > _MIN_SPREAD_MM if len(short) else np.zeros(2, bool)
    if not varies.any():
        return None
    order = np.random.default_rng(seed).permutation(short)[:FRAMES]
    chosen = samples.take(np.sort(order))
    poses, shears = from_mm_deg(chosen.dataset.poses[chosen.rows]), from_mm_deg(chosen.shears)
    along = pin_pixels(design, FAST, predict_along(design, list(zip(poses, shears, strict=True))))
    seen = detect_pins(design, chosen.images)
    known = np.isfinite(seen).any((1, 2))
    fractions, fitted, _ = best_fraction(along[known], seen[known])
    distance = np.nanmedian(np.linalg.norm(fitted - seen[known], axis=-1), 1)
    good = distance <= _BAD_FIT * np.median(distance)
    if good.sum() < _MIN_FRAMES:
        return None
    chosen, fractions = chosen.take(np.flatnonzero(known)[good]), fractions[good]
    means = model.estimate(chosen.images).means
    out: dict[str, Any] = {"frames": len(chosen), "shown_fraction": float(np.median(fractions))}
    for axis in np.flatnonzero(varies):
        estimated, shown = means[:, model.columns.index(names[axis])], fractions * chosen.shears[:, axis]
        slope, _ = np.polyfit(shown, estimated, 1)
        out[SHEARS[axis]] = {
            "correlation": float(np.corrcoef(shown, estimated)[0, 1]),
            "slope": float(slope),
            "mae_mm": float(np.abs(estimated - shown).mean()),
        }
    return out
