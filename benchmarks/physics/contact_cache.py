"""Contacts simulated once and kept in a folder, so an interrupted measurement resumes where it stopped.

The key of a cached contact is a digest of everything that determines it: contact, design, fidelity and the simulation's own
code. Each contact is simulated right after the same contact at `standard`, so the ratio of their times depends neither on
the machine nor on its other load.
"""

import hashlib
import io
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.benchmarks.physics.contact_cases import Case
from tactip_twin.sim.contact.fidelity import FIDELITIES, Fidelity
from tactip_twin.sim.contact.record import Contact, QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.stimuli import Stimulus
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named

DESIGN = "nominal-127"

_TIMINGS = ("seconds", "standard_seconds", "cost", "milliseconds")
"""Entries of a result that differ from run to run."""

_CODE = (
    "tactip_model/mesh.py",
    "tactip_model/soft_body.py",
    "tactip_model/pins.py",
    "sim/pose.py",
    "sim/contact/stimuli.py",
)
_CODE += ("sim/contact/scene.py", "sim/contact/simulator.py", "sim/contact/record.py")
"""Files that determine a contact, together with the numbers of design and fidelity."""


@dataclass(frozen=True)
class CachedContact:
    """What is kept of a contact."""

    pin_tips: np.ndarray
    """(p, 3) pin tips, m."""
    directions: np.ndarray
    """(p, 3) unit vectors from the pins' roots to their tips."""
    force_n: float
    """Normal force, N."""
    penetration_m: float
    """Maximum penetration, m."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    imbalance: float
    """Norm of the unbalanced force over that of the contact force, -."""
    violations: int
    """Number of QualityLimits that the record fails."""
    steps: int
    """Number of time steps."""
    freedom: int
    """Degrees of freedom of the tip."""
    model_bytes: int
    """Size of MuJoCo's model and data, including the maximum that the contact used of the arena, bytes."""
    seconds: float
    """CPU time of the contact, s."""
    standard_seconds: float
    """CPU time of the same contact at `standard` just before it, s."""


class UncorrectedSimulator(ContactSimulator):
    """Simulator of contacts without De Saxcé's correction (Scene.step): sliding skin is lifted."""

    def __init__(self, design: Design, stimulus: str | Stimulus, fidelity: Fidelity) -> None:
        """As ContactSimulator."""
        super().__init__(design, stimulus, fidelity)
        self.scene._lift = np.zeros_like


@dataclass(frozen=True)
class Variant:
    """Settings to simulate contacts with."""

    fidelity: Fidelity
    """Mesh, contact model, motion, solver."""
    lowered: bool = True
    """Whether De Saxcé's correction is applied, as it is for data sets."""


STANDARD = Variant(FIDELITIES["standard"])


class ContactCache:
    """Contacts of the 127-pin tip, simulated or read from a folder."""

    def __init__(self, folder: str | Path, log: Callable[[str], None] = lambda text: None) -> None:
        """Open a cache.

        Args:
            folder: Created when it is needed.
            log: Called with the name of each contact that is about to be simulated.
        """
        self._folder, self._log = Path(folder), log
        self._simulators: dict[tuple[str, bool], tuple[Variant, ContactSimulator]] = {}

    def __call__(self, case: Case, variant: Variant) -> CachedContact:
        """Return the contact of a case at a variant. Raises TactipError if it cannot be simulated."""
        path = self._folder / f"{self._key(case, variant)}.npz"
        if path.exists():
            return _unpacked(path.read_bytes())
        self._log(f"{case.name}: {variant.fidelity.name}")
        contact = self._simulate(case, variant)
        self._folder.mkdir(parents=True, exist_ok=True)
        write_file(path, _packed(contact))
        return contact

    def forget(self) -> None:
        """Delete the cached contacts: the next measurement simulates all of them again."""
        for path in self._folder.glob("*.npz"):
            path.unlink()

    def _key(self, case: Case, variant: Variant) -> str:
        # The same contact under two names is one.
        fidelity = asdict(variant.fidelity) | {"name": ""}
        parts = [case.stimulus, case.pose_mm_deg, case.shear_mm_deg, fidelity, variant.lowered]
        parts += [asdict(design_named(DESIGN)), code_sum()]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]

    def _simulator(self, stimulus: str, variant: Variant) -> ContactSimulator:
        """Return the simulator of a stimulus at a variant. Per stimulus, `standard` and the last other one are kept."""
        slot = stimulus, variant == STANDARD
        if slot not in self._simulators or self._simulators[slot][0] != variant:
            kind = ContactSimulator if variant.lowered else UncorrectedSimulator
            self._simulators[slot] = variant, kind(design_named(DESIGN), stimulus, variant.fidelity)
        return self._simulators[slot][1]

    def _simulate(self, case: Case, variant: Variant) -> CachedContact:
        simulator, standard = self._simulator(case.stimulus, variant), self._simulator(case.stimulus, STANDARD)
        pose, shear = case.si()
        _, standard_seconds = (None, 0.0) if variant == STANDARD else timed(standard, pose, shear)
        contact, seconds = timed(simulator, pose, shear)
        model, data = simulator.scene.model, simulator.scene.data
        return CachedContact(
            pin_tips=contact.pin_tips,
            directions=contact.directions,
            force_n=contact.normal_force_n,
            penetration_m=contact.penetration_m,
            speed_m_s=contact.speed_m_s,
            imbalance=contact.imbalance,
            violations=len(contact.violations(QualityLimits())),
            steps=contact.steps,
            freedom=int(model.nv) - 6,  # the stimulus has six
            model_bytes=int(mujoco.mj_sizeModel(model) + data.nbuffer + data.maxuse_arena),
            seconds=seconds,
            standard_seconds=standard_seconds or seconds,
        )


def timed(simulator: ContactSimulator, pose: ArrayLike, shear: ArrayLike) -> tuple[Contact, float]:
    """Simulate a contact; return it and its CPU time, s."""
    start = time.process_time()
    contact = simulator.simulate(pose, shear)
    return contact, time.process_time() - start


@cache
def code_sum() -> str:
    """Return a digest of what determines a contact besides its configuration: the simulation's code and MuJoCo's version."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256(mujoco.mj_versionString().encode())
    for file in _CODE:
        digest.update((root / file).read_bytes())
    return digest.hexdigest()


def _packed(contact: CachedContact) -> bytes:
    stream, numbers = io.BytesIO(), asdict(contact)
    arrays = {name: numbers.pop(name) for name in ("pin_tips", "directions")}
    np.savez(stream, numbers=json.dumps(numbers), **arrays)
    return stream.getvalue()


def _unpacked(data: bytes) -> CachedContact:
    with np.load(io.BytesIO(data)) as file:
        return CachedContact(pin_tips=file["pin_tips"], directions=file["directions"], **json.loads(str(file["numbers"])))


def without_timings(result: Any) -> Any:
    """Return a JSON result without the entries that differ from run to run."""
    if isinstance(result, dict):
        return {k: without_timings(v) for k, v in result.items() if k not in _TIMINGS}
    return [without_timings(v) for v in result] if isinstance(result, list) else result
