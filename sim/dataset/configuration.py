"""Configuration of a simulated data set: everything that decides its bytes, except for the versions of the libraries."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.dataset.mechanics_randomization import MechanicsRandomization
from tactip_twin.sim.dataset.options import DatasetOptions
from tactip_twin.sim.dataset.pressed_object import PressedObject
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.dataset.symmetry import SYMMETRIES, Symmetry
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.design_file import design_as_dict

REQUIRED_KEYS = ("task", "split", "samples", "seed", "renderer", "design", "fidelity", "pose", "shear")
"""Keys that a file must have: what decides a set's samples is not left to today's defaults."""


@dataclass(frozen=True, kw_only=True)
class Configuration(DatasetOptions):
    """Configuration of a simulated data set."""

    task: str
    """`surface` or `edge`."""
    split: str
    """`train`, `val` or `test`."""
    design: Design
    """Sensor."""
    pose: Ranges = field()
    """Ranges of the labelled poses: those of the task in the paper are in POSE_RANGES."""
    fidelity: Fidelity
    """Mesh, steps and tolerances, which trade the error of a contact for time."""
    bounds: QualityLimits = field(default_factory=QualityLimits)
    """Limits that a simulated contact must meet to become a sample."""
    first: int = 0
    """Index of the first sample, if the set is a shard of a larger one."""
    fast_tip: str = ""
    """Checksum of the learned tip (sim/fast_tip) that predicts the contacts, with simulated ones where it cannot be trusted;
    empty: all are simulated."""
    corrected: bool = False
    """Whether the simulation corrects the predicted contacts (sim/fast_tip/corrected_contacts.py)."""
    object: PressedObject | None = None
    """Object that is pressed on (sim/dataset/pressed_object.py); None: the flat surface or the edge."""
    mechanics_randomization: MechanicsRandomization = field(default_factory=MechanicsRandomization)
    """Randomization of the tip's mechanics by contact (sim/dataset/mechanics_randomization.py); the optics stay the same."""

    @property
    def is_curved(self) -> bool:
        """Whether the surface of some contacts is not flat."""
        return any(self.curvature_per_m) or self.rough_fraction > 0

    @property
    def needs_sliding_tip(self) -> bool:
        """Whether a learned tip must be one that slides (sim/fast_tip/sliding_tip.py), which also knows curved surfaces."""
        return self.snapshots_per_contact > 1 or self.is_curved

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Symmetries that make samples of each contact."""
        return SYMMETRIES[self.task][: None if self.augment_symmetry else 1]

    @property
    def samples_per_contact(self) -> int:
        """Number of samples of each contact."""
        return len(self.symmetries) * self.snapshots_per_contact

    def as_json(self) -> dict[str, Any]:
        """Return the configuration as a JSON object; what only some sets have is left out in others."""
        values = json.loads(json.dumps(dataclasses.asdict(self) | {"design": design_as_dict(self.design)}))
        for name in ("fast_tip", "corrected", "object", "rough_fraction"):
            if not values[name]:
                del values[name]
        if self.mechanics_randomization.gel_compressibility == 1:
            del values["mechanics_randomization"]["gel_compressibility"]
        return values

    def digest(self) -> str:
        """Return a checksum of the configuration, in hex."""
        return digest_of(self.as_json())


def samples_per_contact(configuration: dict[str, Any]) -> int:
    """Return the number of samples of each contact for a configuration as a JSON object."""
    symmetries = len(SYMMETRIES[configuration["task"]]) if configuration["augment_symmetry"] else 1
    return symmetries * configuration["snapshots_per_contact"]


def has_grey_images(configuration: dict[str, Any]) -> bool:
    """Return whether a simulated or imported set has grey images, for its configuration as a JSON object."""
    design = configuration.get("design")
    image = design.get("image") if isinstance(design, dict) else configuration.get("layout")
    return isinstance(image, dict) and image.get("grey") is True


def digest_of(configuration: dict[str, Any]) -> str:
    """Return a checksum, in hex, of a configuration as a JSON object."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
