"""Contacts played and kept in a folder, so that a measurement that is stopped goes on where it was.

What is kept is known by everything that it follows from: contact, design, fidelity and the simulation's own code. Each
contact is played right after the same contact at `standard`: the ratio of their times hangs neither on the machine nor
on what else it does.
"""

import hashlib
import io
import json
import time
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from tactip_twin.sim.contact.fidelity import FIDELITIES, Fidelity
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named

DESIGN = "nominal-127"

_TIMINGS = ("seconds", "standard_seconds", "cost", "milliseconds")
"""Entries that differ from run to run."""

_CODE = (
    "tactip_model/mesh.py",
    "tactip_model/soft_body.py",
    "tactip_model/pins.py",
    "sim/pose.py",
    "sim/contact/stimuli.py",
)
_CODE += ("sim/contact/scene.py", "sim/contact/simulator.py", "sim/contact/record.py")
"""The files that decide a contact, with the numbers of design and fidelity."""


@dataclass(frozen=True)
class Played:
    """What is kept of a contact."""

    tips: np.ndarray
    """(p, 3) float, m."""
    directions: np.ndarray
    """(p, 3) float, unit."""
    force_n: float
    """Normal force, N."""
    penetration_m: float
    """Greatest penetration, m."""
    speed_m_s: float
    """Speed of the fastest vertex, m/s."""
    imbalance: float
    """Force left over, of the contact force, -."""
    faults: int
    """QualityLimits that the record does not keep."""
    steps: int
    """Time steps."""
    freedom: int
    """Degrees of freedom of the tip."""
    model_bytes: int
    """Bytes of MuJoCo's model and data, with the most that the contact used of the arena."""
    seconds: float
    """CPU time of the process for the contact, s."""
    standard_seconds: float
    """The same of the contact at `standard` just before it, s."""


class UncorrectedSimulator(ContactSimulator):
    """Plays contacts without De Saxcé's correction (Scene.step): what slides is lifted."""

    def __init__(self, design, stimulus, fidelity):
        """As ContactSimulator."""
        super().__init__(design, stimulus, fidelity)
        self.scene._lift = np.zeros_like


@dataclass(frozen=True)
class Variant:
    """A way to play contacts."""

    fidelity: Fidelity
    """Mesh, contact model, motion, solver."""
    lowered: bool = True
    """With De Saxcé's correction, as data sets are."""


STANDARD = Variant(FIDELITIES["standard"])


class Plays:
    """Plays contacts of the 127-pin tip, or finds them played."""

    def __init__(self, folder, said=lambda text: None):
        """folder: Path, made when needed. said: called with the name of what is being played."""
        self._folder, self._said = Path(folder), said
        self._players = {}

    def __call__(self, case, variant):
        """The Played of a Case and a Variant. Raises TactipError where it cannot be played."""
        path = self._folder / f"{self._key(case, variant)}.npz"
        if path.exists():
            return _unpacked(path.read_bytes())
        self._said(f"{case.name}: {variant.fidelity.name}")
        played = self._play(case, variant)
        self._folder.mkdir(parents=True, exist_ok=True)
        write_file(path, _packed(played))
        return played

    def forget(self):
        """Remove what is kept: the next measurement plays all anew."""
        for path in self._folder.glob("*.npz"):
            path.unlink()

    def _key(self, case, variant):
        # Names are for people: the same contact under two names is one.
        fidelity = asdict(variant.fidelity) | {"name": ""}
        parts = [case.stimulus, case.pose_mm_deg, case.shear_mm_deg, fidelity, variant.lowered]
        parts += [asdict(design_named(DESIGN)), code_sum()]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]

    def _player(self, stimulus, variant):
        """A player of a stimulus at a Variant. Of each stimulus, `standard` and the last other one are kept."""
        slot = stimulus, variant == STANDARD
        if slot not in self._players or self._players[slot][0] != variant:
            kind = ContactSimulator if variant.lowered else UncorrectedSimulator
            self._players[slot] = variant, kind(design_named(DESIGN), stimulus, variant.fidelity)
        return self._players[slot][1]

    def _play(self, case, variant):
        player, standard = self._player(case.stimulus, variant), self._player(case.stimulus, STANDARD)
        pose, shear = case.si()
        _, standard_seconds = (None, 0.0) if variant == STANDARD else _timed(standard, pose, shear)
        contact, seconds = _timed(player, pose, shear)
        model, data = player.scene.model, player.scene.data
        return Played(
            tips=contact.tips,
            directions=contact.directions,
            force_n=contact.normal_force_n,
            penetration_m=contact.penetration_m,
            speed_m_s=contact.speed_m_s,
            imbalance=contact.imbalance,
            faults=len(contact.faults(QualityLimits())),
            steps=contact.steps,
            freedom=int(model.nv) - 6,  # the stimulus has six
            model_bytes=int(mujoco.mj_sizeModel(model) + data.nbuffer + data.maxuse_arena),
            seconds=seconds,
            standard_seconds=standard_seconds or seconds,
        )


def _timed(player, pose, shear):
    """A player's Contact and its CPU time, s."""
    start = time.process_time()
    contact = player.play(pose, shear)
    return contact, time.process_time() - start


@cache
def code_sum():
    """Digest (str) of what a contact follows from beside its configuration: the simulation's code and MuJoCo's version."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256(mujoco.mj_versionString().encode())
    for file in _CODE:
        digest.update((root / file).read_bytes())
    return digest.hexdigest()


def _packed(played):
    """Bytes of a Played."""
    stream, numbers = io.BytesIO(), asdict(played)
    arrays = {name: numbers.pop(name) for name in ("tips", "directions")}
    np.savez(stream, numbers=json.dumps(numbers), **arrays)
    return stream.getvalue()


def _unpacked(data):
    with np.load(io.BytesIO(data)) as file:
        return Played(tips=file["tips"], directions=file["directions"], **json.loads(str(file["numbers"])))


def without_timings(result):
    """A result (of dicts, lists and numbers) without the entries that differ from run to run."""
    if isinstance(result, dict):
        return {k: without_timings(v) for k, v in result.items() if k not in _TIMINGS}
    return [without_timings(v) for v in result] if isinstance(result, list) else result
