"""The frames of a real set that a calibration fits or is tested on, with their pins."""

from dataclasses import dataclass, field

import numpy as np

from tactip_twin.sim2real.calibration.real_set import RealSet
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import reference_pixels
from tactip_twin.tactip_model.pin_detection import PinMatcher, find_blobs


@dataclass
class Frames:
    """Some frames of a real set, with their pins. (n frames, p pins)"""

    indices: np.ndarray
    """(n,) int: rows of the set."""
    pins_px: np.ndarray
    """(n, p, 2) float: detected pins, px of a 256 px image; NaN where one is not detected."""
    commands: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """n pairs of pose and move, (6,) each, m and rad, in the rig's frame."""
    tap: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """(6,), m and rad."""


def sample_frames(real: RealSet, matcher: PinMatcher, odd: bool, count: int, rng: np.random.Generator) -> Frames:
    """Sample frames from a real set's odd or even rows, detect their pins, and leave out frames with too few.

    Args:
        real: The set.
        matcher: Matcher of pins, in px of the frames.
        odd: Whether the odd rows are sampled, or the even ones.
        count: Number of frames, fewer where the set has fewer.
        rng: Generator of the sample.

    Raises:
        TactipError: If the set is too small, or in many frames pins are not detected.
    """
    rows = np.arange(len(real.files))[1 if odd else 0 :: 2]
    if len(rows) < 10:
        raise TactipError(f"a calibration needs at least 20 frames, got {len(real.files)} in {real.folder}")
    indices = np.sort(rng.choice(rows, min(count, len(rows)), replace=False))
    width = real.neutral.shape[1]
    pins = np.array([reference_pixels(matcher.match(find_blobs(real.frame(i))), width) for i in indices])
    detected = np.isfinite(pins[..., 0]).mean(1)
    good = detected > 0.9
    if good.mean() < 0.7:
        worst = real.files[indices[detected.argmin()]]
        raise TactipError(
            f"fewer than 90 % of the pins were detected in {(~good).sum()} of {len(good)} frames, for example {worst}"
        )
    kept = indices[good]
    return Frames(kept, pins[good], [(real.poses[i], real.moves[i]) for i in kept], real.tap)
