"""Training of a learned tip on data sets that keep their meshes (`tactip dataset make --keep-mesh`)."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.learning.fast_tip_settings import FastTipSettings
from tactip_twin.learning.fast_tip_start import perceptron_of, started_from
from tactip_twin.learning.tip_networks import Perceptron, train_network, train_networks, turned_pairs
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import sample_contact
from tactip_twin.sim.dataset.format import labels_sha256, read_configuration, read_meta, read_rows
from tactip_twin.sim.dataset.mesh_states import read_mesh_states
from tactip_twin.sim.fast_tip.fast_tip import REFERENCE_YOUNG_PA, FastTip, PinDecoder, read_fast_tip, write_fast_tip
from tactip_twin.sim.fast_tip.features import COUNT, features, mirrored, pairs
from tactip_twin.sim.fast_tip.materials import material_inputs, mechanics_of
from tactip_twin.sim.fast_tip.measures import MEASURE_MIRROR, MEASURE_PAIRS, MEASURES, measures_of
from tactip_twin.sim.fast_tip.network import Network
from tactip_twin.sim.fast_tip.skin_field import Modes, SkinSampler
from tactip_twin.sim.labels import LABELS, SHEARS, Task
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_json
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import PinReader

_CHUNK = 500
"""Number of skins that are sampled at once."""


@dataclass(frozen=True)
class TipContacts:
    """Contacts of sets with kept meshes. (k contacts)"""

    configuration: Configuration
    """Configuration of the first set."""
    poses: np.ndarray
    """(k, 6) m and rad."""
    shears: np.ndarray
    """(k, 6) m and rad."""
    harmonics: np.ndarray
    """(k, rings, 6, orders) complex64, deformation of the skin (SkinSampler.harmonics), in the sensor's axes."""
    measures: np.ndarray
    """(k, MEASURES)."""
    skins: np.ndarray
    """(k, s, 3) float32 m, vertices of the skin."""
    materials: np.ndarray
    """(k, 6), materials.INPUTS of each contact's tip. If they vary, the forces are those on a gel of
    REFERENCE_YOUNG_PA."""

    @property
    def knows_materials(self) -> bool:
        """Whether the materials vary from contact to contact."""
        return not self.configuration.mechanics_randomization.is_identity

    @property
    def task(self) -> Task:
        """Task of the contacts."""
        return "edge" if self.configuration.task == "edge" else "surface"

    def __len__(self) -> int:
        return len(self.poses)

    def first(self, count: int) -> "TipContacts":
        """Return the first `count` contacts; all for 0."""
        return dataclasses.replace(self, **{name: getattr(self, name)[: count or None] for name in _COLUMNS})

    def chosen(self, which: np.ndarray) -> "TipContacts":
        """Return the contacts for which `which` (k,) bool holds."""
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in _COLUMNS})


_COLUMNS = ("poses", "shears", "harmonics", "measures", "skins", "materials")
"""Fields of TipContacts with a row for each contact."""


def read_contacts(folders: Sequence[Path]) -> TipContacts:
    """Read contacts of one task and tip.

    Raises:
        TactipError: A set is not simulated, has no meshes, lies on curved surfaces, or differs from the first in task,
            fidelity, shape or materials.
    """
    require(len(folders) > 0, "the number of training sets", len(folders), "at least one (name their folders)")
    parts = [_read_set(Path(folder)) for folder in folders]
    first = parts[0].configuration
    for folder, part in zip(folders, parts, strict=True):
        _check_same_tip(part, parts[0], folder, folders[0])
    return TipContacts(first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS})


def _check_same_tip(part: TipContacts, first: TipContacts, folder: Path, first_folder: Path) -> None:
    """Raise TactipError where contacts in a folder are not of the task, fidelity and tip of others."""
    a, b = part.configuration, first.configuration
    for name in ("task", "fidelity"):
        if getattr(a, name) != getattr(b, name):
            raise TactipError(f"{folder} has another {name} than {first_folder}: a tip is learned from sets of one {name}")
    if mechanics_of(a.design) != mechanics_of(b.design):
        raise TactipError(f"{folder} has a tip of another shape or other materials than {first_folder}")
    if part.knows_materials != first.knows_materials:
        raise TactipError(f"the materials vary in one of {folder} and {first_folder}, but not in the other")


def set_identity(folder: Path) -> dict[str, str | None]:
    """Return checksums of a set: of its configuration and of its labels."""
    meta = read_meta(folder)
    return {"digest": meta["digest"], "targets_sha256": labels_sha256(meta)}


def _read_set(folder: Path) -> TipContacts:
    meta = read_meta(folder)
    configuration = read_configuration(meta, folder)
    if configuration.is_curved:
        raise TactipError(f"the set in {folder} has curved surfaces, which a fast tip cannot learn: teach a sliding tip")
    each = configuration.samples_per_contact
    states = read_mesh_states(folder, meta).by_contact()
    # The first sample of a contact is the contact as simulated.
    rows = {int(row["index"]) // each: row for row in read_rows(folder, meta) if int(row["index"]) % each == 0}
    numbers = [number for number in states if number in rows]
    if not numbers:
        raise TactipError(f"the set in {folder} has no contacts")
    mesh = build_mesh(configuration.design.shape, configuration.fidelity.mesh)
    skins = np.array([states[number][1, : mesh.surface_count] for number in numbers])
    sampler = SkinSampler(mesh)
    harmonics = np.concatenate([sampler.harmonics(skins[k : k + _CHUNK]) for k in range(0, len(skins), _CHUNK)])

    def cells(columns: Sequence[str]) -> np.ndarray:
        return np.array([[float(rows[number][column]) for column in columns] for number in numbers])

    poses, shears = from_mm_deg(cells(LABELS)), from_mm_deg(cells(SHEARS))
    in_sensor = cells(("force_x_N", "force_y_N", "force_z_N"))
    designs = [sample_contact(configuration, number).design for number in numbers]
    materials = np.array([material_inputs(design.materials) for design in designs])
    if not configuration.mechanics_randomization.is_identity:
        stiffness = np.array([design.materials.gel_young_pa for design in designs]) / REFERENCE_YOUNG_PA
        in_sensor /= stiffness[:, None]
    measures = measures_of(poses, in_sensor, cells(MEASURES[3:]))
    return TipContacts(configuration, poses, shears, harmonics, measures, skins, materials)


class _Batches:
    """Random batches of contacts as tensors, turned and mirrored."""

    def __init__(
        self, task: Task, inputs: np.ndarray, coefficients: np.ndarray, measures: np.ndarray, orders: np.ndarray
    ) -> None:
        """Take inputs (n, width), coefficients (n, modes) complex, measures (n, MEASURES) and orders (modes,)."""
        self.width = inputs.shape[1]
        """Number of inputs: the features, and the materials if they vary."""
        self._pairs = pairs(task) if task == "surface" else []
        factors = np.concatenate([mirrored(task), np.ones(self.width - COUNT[task])])
        self._mirror = torch.tensor(factors, dtype=torch.float32)
        self._inputs = torch.tensor(inputs, dtype=torch.float32)
        self._coefficients = torch.tensor(coefficients.astype(np.complex64))
        self._measures = torch.tensor(measures, dtype=torch.float32)
        self._orders = torch.tensor(orders, dtype=torch.float32)

    def sample(self, size: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return inputs (size, COUNT), coefficients (size, 2 modes) and measures (size, MEASURES)."""
        chosen = torch.randint(len(self._inputs), (size,), generator=generator)
        inputs, coefficients, measures = self._inputs[chosen], self._coefficients[chosen], self._measures[chosen]
        if self._pairs:
            angle = 2 * torch.pi * torch.rand(size, generator=generator)
            inputs = turned_pairs(inputs, self._pairs, angle)
            measures = turned_pairs(measures, MEASURE_PAIRS, angle)
            coefficients = coefficients * torch.polar(torch.ones(1), -angle[:, None] * self._orders)
        flip = torch.rand(size, 1, generator=generator) < 0.5
        inputs = torch.where(flip, inputs * self._mirror, inputs)
        measures = torch.where(flip, measures * _MEASURE_MIRROR, measures)
        coefficients = torch.where(flip, coefficients.conj(), coefficients)
        return inputs, torch.cat([coefficients.real, coefficients.imag], 1), measures


_MEASURE_MIRROR = torch.tensor(MEASURE_MIRROR, dtype=torch.float32)


class _Plan:
    """Everything that the networks of a learned tip share: modes, scales and batches."""

    def __init__(self, contacts: TipContacts, settings: FastTipSettings, start: FastTip | None) -> None:
        """Find the modes and the scales of some contacts, or take those of a learned tip to start from."""
        task = contacts.task
        values, yaw = features(task, contacts.poses, contacts.shears)
        if contacts.knows_materials:
            values = np.concatenate([values, contacts.materials], 1)
        orders = np.arange(contacts.harmonics.shape[-1])
        canonical = contacts.harmonics * np.exp(1j * np.multiply.outer(yaw, orders))[:, None, None]
        self.start = start
        if start is None:
            self.modes = Modes.fit(canonical, settings.modes)
            self.center, self.scale = _scales(task, values)
            self.measure_center, self.measure_scale = _measure_scales(contacts.measures, task)
        else:
            self.modes, self.center, self.scale = start.modes, start.center, start.scale
            self.measure_center, self.measure_scale = start.measure_center, start.measure_scale
        coefficients = self.modes.coefficients(canonical)
        both = np.concatenate([coefficients.real, coefficients.imag], 1)
        # Small modes are not learned relative to their own size, which would be noise.
        scale = np.maximum(both.std(0), 0.01 * both.std(0).max()).astype(np.float32)
        self.coefficient_scale = scale if start is None else start.coefficient_scale
        inputs, measures = (
            (values - self.center) / self.scale,
            (contacts.measures - self.measure_center) / self.measure_scale,
        )
        self.batches = _Batches(task, inputs, coefficients, measures, self.modes.orders)
        # By Parseval's theorem: orders above 0 count twice.
        self._weight = torch.tensor(np.where(np.tile(self.modes.orders, 2) > 0, 2.0, 1.0), dtype=torch.float32)
        self._to_mm = torch.tensor(self.coefficient_scale)

    def outputs(self, of_measures: bool) -> int:
        """Return the number of outputs of a network of coefficients, or of measures."""
        return len(MEASURES) if of_measures else 2 * len(self.modes.orders)

    def loss(self, of_measures: bool, outputs: torch.Tensor, targets: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the loss of a batch: the mean square distance of the fields, mm^2, or a robust error of the measures."""
        coefficients, measures = targets
        if of_measures:
            return torch.nn.functional.smooth_l1_loss(outputs, measures, beta=0.1)
        return ((outputs * self._to_mm - coefficients).square() * self._weight).sum(1).mean()


def train_fast_tip(
    folders: Sequence[Path],
    validation: Path,
    settings: FastTipSettings,
    out: Path,
    log: Callable[[str], None] = print,
    quiet: bool = False,
    init_from: FastTip | None = None,
) -> FastTip:
    """Train a learned tip, or resume its training after the last finished network.

    Args:
        folders: Sets to learn from, of one task and tip, made with --keep-mesh.
        validation: Another such set, from which the limit of trust is chosen and whose errors are recorded.
        settings: Settings.
        out: Folder of the training; FAST_TIP in it is the learned tip.
        log: Callback for messages to the user.
        quiet: Whether to hide the progress bar.
        init_from: Learned tip of the same task and shape with the initial weights, whose modes and layers replace those of
            the settings; random weights if None.

    Raises:
        TactipError: A set cannot be used, `init_from` does not fit, or the folder holds something else.
        Interrupted: Ctrl-C.
    """
    contacts, held_out = read_contacts(folders).first(settings.contacts), read_contacts([validation])
    _check_same_tip(held_out, contacts, validation, folders[0])
    record = {
        "train": [set_identity(folder) for folder in folders],
        "validation": set_identity(validation),
        "settings": dataclasses.asdict(settings),
        "torch": torch.__version__,
    }
    start = None
    if init_from is not None:
        known = contacts.materials if contacts.knows_materials else None
        start = started_from(init_from, contacts.task, contacts.configuration.design, known)
        record["initial_weights"] = init_from.digest
    path = out / _SETTINGS
    recorded = read_json(path) if path.exists() else None
    check_resumable(out, "learned tip", recorded, record, (_LOCK,))
    out.mkdir(parents=True, exist_ok=True)
    with locked(out / _LOCK, f"teaching a tip in {out}"):
        if recorded is None:
            write_file(path, json.dumps(record, indent=1).encode())
        if (out / FAST_TIP).exists():
            log(f"the tip in {out} is taught already")
            return read_fast_tip(out / FAST_TIP)
        plan = _Plan(contacts, settings, start)
        networks = train_networks(partial(_train, plan, settings), settings.members + 1, settings.steps, out, quiet)
        tip = FastTip(
            task=contacts.task,
            mechanics=mechanics_of(contacts.configuration.design, contacts.knows_materials),
            modes=plan.modes,
            center=plan.center,
            scale=plan.scale,
            networks=tuple(networks[:-1]),
            coefficient_scale=plan.coefficient_scale,
            measure_network=networks[-1],
            measure_center=plan.measure_center,
            measure_scale=plan.measure_scale,
            ranges=_ranges(contacts.configuration),
            max_spread_m=np.inf,
            provenance={},
            materials=_range_of(contacts.materials) if contacts.knows_materials else None,
        )
        _, spread = tip.coefficients(held_out.poses, held_out.shears, held_out.materials)
        tip = dataclasses.replace(tip, max_spread_m=float(np.quantile(spread, settings.trusted_fraction)))
        provenance = record | {"contacts": len(contacts), "errors": fast_tip_errors(tip, held_out)}
        tip = dataclasses.replace(tip, provenance=provenance)
        write_fast_tip(tip, out / FAST_TIP)
        return read_fast_tip(out / FAST_TIP)


FAST_TIP = "fast_tip.npz"
"""File of the learned tip in the folder of its training."""

_SETTINGS, _LOCK = "settings.json", "lock"


def _ranges(configuration: Configuration) -> np.ndarray:
    """Return the ranges (12, 2) of pose and shear of a set, m and rad."""
    return np.concatenate([from_mm_deg(ranges.bounds().T).T for ranges in (configuration.pose, configuration.shear)])


def _range_of(values: np.ndarray) -> np.ndarray:
    """Return low and high (k, 2) of values (n, k)."""
    return np.stack([values.min(0), values.max(0)], 1)


def fast_tip_errors(tip: FastTip, contacts: TipContacts) -> dict[str, float]:
    """Return the errors of a learned tip on simulated contacts that it has not seen.

    Args:
        tip: Learned tip.
        contacts: Contacts of the same task and tip.

    Returns:
        pins_mm, pins_p95_mm: mean and 95th percentile of the distance between pin tips; worst_contact_mm: largest mean of a
        contact; trusted: fraction of trusted contacts; pins_trusted_mm: mean over those; force: sum of the errors of the
        normal force over the sum of forces; effective_shear_mm, slip_fraction: mean absolute errors.
    """
    c = contacts.configuration
    pins, _ = PinReader(c.design, build_mesh(c.design.shape, c.fidelity.mesh)).read(contacts.skins)
    design = c.design
    if contacts.knows_materials:  # forces as in the measures; the skin's modulus is an input
        materials = dataclasses.replace(design.materials, gel_young_pa=REFERENCE_YOUNG_PA, skin_young_pa=REFERENCE_YOUNG_PA)
        design = dataclasses.replace(design, materials=materials)
    found = tip.predict(PinDecoder(design, tip.modes), contacts.poses, contacts.shears, contacts.materials)
    distance = 1e3 * np.linalg.norm(found.pin_tips - pins, axis=-1)
    force = np.exp(contacts.measures[:, 0])
    shear = np.linalg.norm(1e3 * found.effective_shears[:, :2] - contacts.measures[:, 3:5], axis=1)
    return {
        "pins_mm": float(distance.mean()),
        "pins_p95_mm": float(np.percentile(distance, 95)),
        "worst_contact_mm": float(distance.mean(1).max()),
        "trusted": float(found.trusted.mean()),
        "pins_trusted_mm": float(distance[found.trusted].mean()),
        "force": float(np.abs(found.normal_forces_n - force).sum() / force.sum()),
        "effective_shear_mm": float(shear.mean()),
        "slip_fraction": float(np.abs(found.slip_fractions - contacts.measures[:, 6]).mean()),
    }


def _scales(task: Task, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what inputs (n, width) are centred by and divided by, so that turns and mirrors commute with both."""
    center, scale = values.mean(0), values.std(0)
    for k in pairs(task):
        if task == "surface":
            center[k], scale[k : k + 2] = 0, np.sqrt((scale[k : k + 2] ** 2).mean())
    center[: COUNT[task]][mirrored(task) < 0] = 0
    if task == "surface":
        for k in pairs(task):
            center[k : k + 2] = 0
    return center, np.where(scale > 1e-6, scale, 1.0)


def _measure_scales(measures: np.ndarray, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """The same for measures (n, MEASURES)."""
    center, scale = measures.mean(0), measures.std(0)
    center[MEASURE_MIRROR < 0] = 0
    if task == "surface":
        for k in MEASURE_PAIRS:
            center[k : k + 2], scale[k : k + 2] = 0, np.sqrt((scale[k : k + 2] ** 2).mean())
    return center, np.where(scale > 1e-6, scale, 1.0)


def _train(plan: _Plan, settings: FastTipSettings, member: int, bar: "tqdm[NoReturn]") -> Network:
    """Train one network and return it.

    Args:
        plan: What the networks share.
        settings: Settings.
        member: Number of the network, which is part of its seed; the last is that of measures.
        bar: Progress bar, which advances with each step.
    """
    of_measures = member == settings.members
    sizes = plan.batches.width, settings.width, settings.layers, plan.outputs(of_measures)

    def network() -> Perceptron:
        if plan.start is None:
            return Perceptron(*sizes)
        ensemble = plan.start.networks
        return perceptron_of(plan.start.measure_network if of_measures else ensemble[member % len(ensemble)])

    def loss(network: Perceptron, generator: torch.Generator, step: int) -> torch.Tensor:
        inputs, *targets = plan.batches.sample(settings.batch, generator)
        return plan.loss(of_measures, network(inputs), (targets[0], targets[1]))

    return train_network(network, loss, settings, settings.seed * 1000 + member, bar)
