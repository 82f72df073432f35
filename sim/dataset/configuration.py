"""Configuration of a simulated data set: everything that decides its bytes, except for the versions of the libraries."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

from tactip_twin.sim.contact.fidelity import Fidelity
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.dataset.mechanics_randomization import MechanicsRandomization
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.dataset.symmetry import SYMMETRIES, Symmetry
from tactip_twin.tactip_model.design import Design

_WRITTEN_IF_NOT_DEFAULT = ("curvature_per_m", "uneven", "shard_samples", "first", "looks", "mechanics")
"""Fields added after version 1: written only where they differ from their default, so older sets keep their digest."""


@dataclass(frozen=True)
class Configuration:
    """Configuration of a simulated data set."""

    task: str
    """`surface` or `edge`."""
    split: str
    """`train`, `val` or `test`."""
    samples: int
    """Number of samples: contacts, times the symmetries and the images of each."""
    seed: int
    """Seed of the set; each contact spawns its own generator from it (sim/dataset/sampling.py)."""
    renderer: str
    """`pyrender` or `raster`."""
    design: Design
    """Sensor."""
    fidelity: Fidelity
    """Mesh, steps and tolerances, which trade the error of a contact for time."""
    pose: Ranges
    """Ranges of the labelled poses."""
    shear: Ranges
    """Ranges of the unlabelled shears."""
    bounds: QualityLimits = field(default_factory=QualityLimits)
    """Limits that a simulated contact must meet to become a sample."""
    symmetric: bool = False
    """Whether each contact makes a sample for every symmetry of its task (sim/dataset/symmetry.py)."""
    curvature_per_m: tuple[float, float] = (0.0, 0.0)
    """Range of both principal curvatures of the surface, 1/m, positive where convex; flat if both are 0. Not a label."""
    uneven: float = 0.0
    """Fraction of the surfaces whose curvature varies (sim/contact/curved_surface.py), 0 to 1. Not a label."""
    shard_samples: int = 10_000
    """Samples per shard: a larger set is a folder of shards (sim/dataset/shards.py)."""
    first: int = 0
    """Index of the first sample, where the set is a shard of a larger one."""
    looks: int = 1
    """Images of each contact: one at its pose, then one after each stride of a sliding path (sim/dataset/sliding.py)."""
    mechanics: MechanicsRandomization = field(default_factory=MechanicsRandomization)
    """Randomization of the tip's mechanics by contact (sim/dataset/mechanics_randomization.py); the optics stay the same."""

    @property
    def is_curved(self) -> bool:
        """Whether the surface is not flat."""
        return any(self.curvature_per_m)

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Symmetries that make samples of each contact."""
        return SYMMETRIES[self.task][: None if self.symmetric else 1]

    @property
    def samples_per_contact(self) -> int:
        """Number of samples of each contact."""
        return len(self.symmetries) * self.looks

    def as_json(self) -> dict[str, Any]:
        """Return the configuration as a JSON object."""
        values = dataclasses.asdict(self)
        for f in dataclasses.fields(self):
            if f.name in _WRITTEN_IF_NOT_DEFAULT and getattr(self, f.name) == _default(f):
                del values[f.name]
        return json.loads(json.dumps(values))

    def digest(self) -> str:
        """Return a checksum of the configuration, in hex."""
        return digest_of(self.as_json())


def _default(f: dataclasses.Field) -> Any:
    return f.default if f.default_factory is dataclasses.MISSING else f.default_factory()


def samples_per_contact(configuration: dict[str, Any]) -> int:
    """Return the number of samples of each contact for a configuration as a JSON object."""
    symmetries = len(SYMMETRIES[configuration["task"]]) if configuration.get("symmetric") else 1
    return symmetries * configuration.get("looks", 1)


def digest_of(configuration: dict[str, Any]) -> str:
    """Return a checksum, in hex, of a configuration as a JSON object."""
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
