"""Training contacts that the learned tip (sim/fast_tip/) draws anew at every epoch, so none is learned by heart."""

from dataclasses import dataclass

import numpy as np
import torch

from tactip_twin.learning.data import Samples
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.learning.tactile_raster import TactileRaster
from tactip_twin.sim.contact.limits import exceeds_max_tilt
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS, FORCES, read_configuration
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder, Prediction, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.labels import SHEARS, Task
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

    def __init__(self, samples: Samples, tip: FastTip, device: str = "cpu") -> None:
        """Prepare the prediction and the renderer.

        Args:
            samples: Samples of a simulated set.
            tip: Learned tip of the set's sensor.
            device: Torch device of the images.

        Raises:
            TactipError: If the set's contacts are not single presses on a flat surface or a straight edge, its
                images are grey, or the tip belongs to another sensor or task.
        """
        meta, where = samples.dataset.meta, f"the set in {samples.folder}"
        if not samples.dataset.simulated:
            raise TactipError(
                f"contacts can be drawn for simulated sets only, but {where} has no pins: set drawn_contacts to 0"
            )
        configuration = read_configuration(meta, samples.folder)
        _check(configuration, where)
        design, task = configuration.design, samples.labels.task
        if samples.size != design.image.size_px:
            raise TactipError(f"{where} has images of {samples.size} px, but its design makes {design.image.size_px} px")
        if tip.task != task:
            raise TactipError(f"the learned tip that draws contacts must be for {task!r}, got one for {tip.task!r}")
        self._randomization = configuration.mechanics_randomization
        tip.check_design(design, randomized=not self._randomization.is_identity)
        self._design, self._tip, self._decoder = design, tip, PinDecoder(design, tip.modes)
        self._labels, self._pose, self._shear = samples.labels, configuration.pose, configuration.shear
        self.raster = TactileRaster(design, device)
        """Renderer of the sensor's images."""

    def draw(self, count: int, rng: np.random.Generator) -> DrawnContacts:
        """Return `count` contacts.

        Motions that are too steep, or whose prediction cannot be trusted, are drawn again.

        Raises:
            TactipError: If contacts are missing after _MAX_ROUNDS rounds of draws.
        """
        kept, missing = [], count
        for _ in range(_MAX_ROUNDS):
            poses, shears = self._sample(self._pose, missing, rng), self._sample(self._shear, missing, rng)
            gentle = ~exceeds_max_tilt(poses, shears)
            if not gentle.any():
                continue
            poses, shears = poses[gentle], shears[gentle]
            predicted = self._predict(poses, shears, rng)
            good = predicted.trusted
            columns = dict(zip(SHEARS, to_mm_deg(shears).T, strict=True))
            columns |= dict(zip(EFFECTIVE_SHEARS, to_mm_deg(predicted.effective_shears)[:, [0, 1, 5]].T, strict=True))
            columns |= dict(zip(FORCES, predicted.forces_n.T, strict=True)) | {"slip_fraction": predicted.slip_fractions}
            quantities = np.stack([columns[q.name] for q in QUANTITIES], 1)
            targets = self._labels.of(to_mm_deg(poses))
            kept.append([a[good] for a in (predicted.pin_tips, predicted.directions, targets, quantities)])
            missing -= int(good.sum())
            if not missing:
                tips, directions, targets, quantities = (np.concatenate(parts) for parts in zip(*kept, strict=True))
                return DrawnContacts(tips, directions, self.raster.render(tips, directions), targets, quantities)
        raise TactipError("contacts cannot be drawn: the learned tip can predict hardly any of those in the set's ranges")

    def _predict(self, poses: np.ndarray, shears: np.ndarray, rng: np.random.Generator) -> Prediction:
        """Predict contacts (k, 6), (k, 6), with mechanics that are drawn for each where the set's are."""
        if self._randomization.is_identity:
            return self._tip.predict(self._decoder, poses, shears, material_inputs(self._design.materials))
        mechanics = self._randomization.sample_many(self._design, len(poses), rng)
        return self._tip.predict_each(self._decoder, poses, shears, mechanics)

    def _sample(self, ranges: Ranges, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return uniform samples (count, 6), m and rad."""
        low, high = ranges.bounds().T
        return from_mm_deg(low + (high - low) * rng.random((count, 6)))


_MAX_ROUNDS = 100
"""Number of rounds of draws, after which the rest is not expected any more."""


def shipped_tip_for(samples: Samples) -> FastTip:
    """Return the shipped learned tip of a set's sensor and task. Raises TactipError if there is none."""
    configuration = read_configuration(samples.dataset.meta, samples.folder)
    task: Task = "edge" if samples.labels.task == "edge" else "surface"
    randomized = not configuration.mechanics_randomization.is_identity
    return read_fast_tip(shipped_fast_tip(task, configuration.design.name, randomized))


def _check(configuration: Configuration, where: str) -> None:
    """Raise TactipError unless the contacts of a set are of the kind that the learned tip of single presses knows."""
    c = configuration
    unfit = {"an object": c.object is not None, "curved surfaces": c.is_curved, "sliding paths": c.snapshots_per_contact > 1}
    for what in (name for name, present in unfit.items() if present):
        raise TactipError(
            f"contacts can be drawn for single presses on a flat surface or an edge only, but {where} has {what}: "
            "set drawn_contacts to 0"
        )
