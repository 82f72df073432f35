"""Training contacts that the learned tip (sim/fast_tip/) draws anew at every epoch, so none is learned by heart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from tactip_twin.learning.data import Samples
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.learning.tactile_raster import TactileRaster
from tactip_twin.sim.contact.limits import exceeds_max_tilt
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS, FORCES, read_configuration
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder, Prediction
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.labels import SHEARS
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class DrawnContacts:
    """n predicted contacts."""

    pin_tips: np.ndarray
    """(n, p, 3) m, sensor frame."""
    directions: np.ndarray
    """(n, p, 3) unit, sensor frame."""
    images: torch.Tensor
    """(n, size, size) uint8, on the device."""
    targets: np.ndarray
    """(n, k) learned components, mm and degrees."""
    quantities: np.ndarray
    """(n, q) quantities.QUANTITIES."""


class ContactSource:
    """Source of contacts of the kind that a set has: its ranges, its sensor, its images."""

    def __init__(self, samples: Samples, tips: Sequence[FastTip], device: str = "cpu") -> None:
        """Prepare the prediction and the renderer.

        Args:
            samples: Samples of a simulated set.
            tips: Learned tips of the set's sensor. Each predicts the contacts that are outside of the ranges of those before
                it: the tip of one sensor may not know light contacts.
            device: Torch device of the images.

        Raises:
            TactipError: If the set is not simulated, its contacts press an object, its images are grey, or a tip belongs
                to another sensor or task.
        """
        configuration = configuration_of(samples)
        for tip in tips:
            check_source(samples, configuration, tip.task)
        if configuration.needs_sliding_tip:
            raise TactipError(
                f"a sliding tip must draw contacts like those in {samples.folder}, which slide or touch curved surfaces"
            )
        design = configuration.design
        self._randomization = configuration.mechanics_randomization
        for tip in tips:
            tip.check_design(design, randomized=not self._randomization.is_identity)
        self._design, self._tips = design, [down_to_the_surface(tip) for tip in tips]
        self._decoders = [PinDecoder(design, tip.modes) for tip in tips]
        self._labels, self._pose, self._shear = samples.labels, configuration.pose, configuration.shear
        self.raster = TactileRaster(design, device)
        """Renderer of the sensor's images."""

    def draw(self, count: int, rng: np.random.Generator) -> DrawnContacts:
        """Return `count` contacts.

        Motions that are too steep, or whose prediction cannot be trusted, are drawn again.

        Raises:
            TactipError: If contacts are missing after MAX_ROUNDS rounds of draws.
        """
        kept, missing = [], count
        for _ in range(MAX_ROUNDS):
            poses, shears = self._sample(self._pose, missing, rng), self._sample(self._shear, missing, rng)
            gentle = ~exceeds_max_tilt(poses, shears)
            if not gentle.any():
                continue
            poses, shears = poses[gentle], shears[gentle]
            for kept_poses, kept_shears, predicted in self._predict(poses, shears, rng):
                good = predicted.trusted
                measured = predicted.effective_shears, predicted.forces_n, predicted.slip_fractions
                quantities = columns_of(kept_shears, *measured)
                targets = self._labels.of(to_mm_deg(kept_poses))
                kept.append([a[good] for a in (predicted.pin_tips, predicted.directions, targets, quantities)])
                missing -= int(good.sum())
            if not missing:
                tips, directions, targets, quantities = (np.concatenate(parts) for parts in zip(*kept, strict=True))
                return DrawnContacts(tips, directions, self.raster.render(tips, directions), targets, quantities)
        raise too_few()

    def _predict(
        self, poses: np.ndarray, shears: np.ndarray, rng: np.random.Generator
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Prediction]]:
        """Yield poses and shears (k, 6) that a tip knows the ranges of, and what it predicts; each contact once, with
        mechanics that are drawn for each where the set's are."""
        randomized = not self._randomization.is_identity
        mechanics = self._randomization.sample_many(self._design, len(poses), rng) if randomized else {}
        waiting = np.ones(len(poses), bool)
        for tip, decoder in zip(self._tips, self._decoders, strict=True):
            known = np.flatnonzero(waiting & ~tip.outside(poses, shears))
            waiting[known] = False
            if randomized:
                own = {name: values[known] for name, values in mechanics.items()}
                yield poses[known], shears[known], tip.predict_each(decoder, poses[known], shears[known], own)
            else:
                materials = material_inputs(self._design.materials)
                yield poses[known], shears[known], tip.predict(decoder, poses[known], shears[known], materials)

    def _sample(self, ranges: Ranges, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return uniform samples (count, 6), m and rad."""
        low, high = ranges.bounds().T
        return from_mm_deg(low + (high - low) * rng.random((count, 6)))


def down_to_the_surface(tip: FastTip) -> FastTip:
    """Return a tip of any materials so that it is trusted down to a depth of zero; another tip as it is.

    The tips of any materials learned depths from 0.2 mm, and are as accurate on lighter contacts
    (tests/learning/test_drawn_contacts.py). Without these in training, networks read light contacts as deeper than they are.
    """
    if tip.materials is None:
        return tip
    ranges = tip.ranges.copy()
    ranges[2, 1] = max(ranges[2, 1], 0.0)
    return replace(tip, ranges=ranges)


def columns_of(
    shears: np.ndarray, effective_shears: np.ndarray, forces_n: np.ndarray, slip_fractions: np.ndarray
) -> np.ndarray:
    """Return QUANTITIES (n, q) of contacts from shears (n, 6) and effective ones (n, 6), m and rad, forces (n, 3), N, and
    slipping fractions (n,)."""
    columns = dict(zip(SHEARS, to_mm_deg(shears).T, strict=True))
    columns |= dict(zip(EFFECTIVE_SHEARS, to_mm_deg(effective_shears)[:, [0, 1, 5]].T, strict=True))
    columns |= dict(zip(FORCES, forces_n.T, strict=True)) | {"slip_fraction": slip_fractions}
    return np.stack([columns[q.name] for q in QUANTITIES], 1)


MAX_ROUNDS = 100
"""Number of rounds of draws, after which the rest is not expected any more."""


def configuration_of(samples: Samples) -> Configuration:
    """Return the configuration of a set whose contacts are to be drawn. Raises TactipError if it is not simulated."""
    if not samples.dataset.simulated:
        raise TactipError(
            f"contacts can be drawn for simulated sets only, but the set in {samples.folder} has no pins: "
            "set drawn_contacts to 0"
        )
    return read_configuration(samples.dataset.meta, samples.folder)


def check_source(samples: Samples, configuration: Configuration, task: str) -> None:
    """Raise TactipError unless a learned tip of a task can draw contacts of the kind that a set has."""
    c, where = configuration, f"the set in {samples.folder}"
    varied = c.needs_sliding_tip and not c.mechanics_randomization.is_identity
    unfit = {"an object": c.object is not None, "slides of tips with varied mechanics": varied}
    for what in (name for name, present in unfit.items() if present):
        raise TactipError(f"contacts with {what}, as {where} has, cannot be drawn: set drawn_contacts to 0")
    if samples.size != c.design.image.size_px:
        raise TactipError(f"{where} has images of {samples.size} px, but its design makes {c.design.image.size_px} px")
    if task != samples.labels.task:
        raise TactipError(f"the learned tip that draws contacts must be for {samples.labels.task!r}, got one for {task!r}")


def too_few() -> TactipError:
    """Return the error of draws that are hardly ever trusted."""
    return TactipError("contacts cannot be drawn: the learned tip can predict hardly any of those in the set's ranges")
