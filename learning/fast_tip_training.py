"""Training of a learned tip on data sets that keep their meshes (`tactip dataset make --keep-mesh`)."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_rows
from tactip_twin.sim.dataset.mesh_states import read_mesh_states
from tactip_twin.sim.fast_tip.fast_tip import MEASURES, MIN_FORCE_N, FastTip, Network, mechanics_of
from tactip_twin.sim.fast_tip.features import COUNT, features, mirrored, pairs
from tactip_twin.sim.fast_tip.skin_field import Modes, SkinSampler
from tactip_twin.sim.labels import LABELS, SHEARS, Task
from tactip_twin.sim.pose import FACING, from_mm_deg
from tactip_twin.tactip_model.bounds import check, within
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import build_mesh

_CHUNK = 500
"""Number of skins that are sampled at once."""


@dataclass(frozen=True)
class FastTipSettings:
    """Settings of the training of a learned tip."""

    modes: int = within(1, 500, default=70)
    """Number of modes of the skin's deformation."""
    width: int = within(8, 2048, default=256)
    """Units per layer."""
    layers: int = within(1, 10, default=3)
    """Residual layers."""
    members: int = within(1, 10, default=3)
    """Networks of the ensemble."""
    steps: int = within(1, 1000000, default=20000)
    """Training steps of each network."""
    batch: int = within(1, 65536, default=512)
    """Contacts per step, each turned and mirrored at random."""
    learning_rate: float = within(1e-6, 1, default=3e-3)
    """Highest learning rate of a one-cycle schedule."""
    weight_decay: float = within(0, 1, default=1e-4)
    """Weight decay of AdamW."""
    trusted_fraction: float = within(0, 1, default=0.98)
    """Fraction of the validation contacts whose spread is below the limit of trust."""
    seed: int = within(0, 2**31, default=0)
    """Seed of the initial weights and batches."""

    def __post_init__(self) -> None:
        check(self)


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

    def __len__(self) -> int:
        return len(self.poses)


def read_contacts(folders: Sequence[Path]) -> TipContacts:
    """Read contacts of one task and tip.

    Raises:
        TactipError: A set is not simulated, has no meshes, lies on curved surfaces, or differs from the first in task,
            fidelity, shape or materials.
    """
    parts = [_read_set(Path(folder)) for folder in folders]
    first = parts[0].configuration
    for folder, part in zip(folders, parts, strict=True):
        for name in ("task", "fidelity"):
            if getattr(part.configuration, name) != getattr(first, name):
                raise TactipError(f"{folder} has another {name} than {folders[0]}: a tip is learned from sets of one {name}")
        if mechanics_of(part.configuration.design) != mechanics_of(first.design):
            raise TactipError(f"{folder} has a tip of another shape or other materials than {folders[0]}")
    names = ("poses", "shears", "harmonics", "measures", "skins")
    return TipContacts(first, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _read_set(folder: Path) -> TipContacts:
    meta = read_meta(folder)
    configuration = read_configuration(meta, folder)
    if configuration.is_curved or not configuration.mechanics_randomization.is_identity:
        raise TactipError(f"the set in {folder} has curved surfaces or randomized mechanics, which a tip cannot learn yet")
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
    force = Rotation.from_rotvec(poses[:, 3:]).apply(in_sensor @ FACING)
    normal = np.maximum(force[:, 2:], MIN_FORCE_N)
    measures = np.concatenate([np.log(normal), force[:, :2] / normal, cells(MEASURES[3:])], 1)
    return TipContacts(configuration, poses, shears, harmonics, measures, skins)


class _Batches:
    """Random batches of contacts as tensors, turned and mirrored."""

    def __init__(
        self, task: Task, inputs: np.ndarray, coefficients: np.ndarray, measures: np.ndarray, orders: np.ndarray
    ) -> None:
        """Take inputs (n, COUNT), coefficients (n, modes) complex, measures (n, MEASURES) and orders (modes,)."""
        self.width = COUNT[task]
        """Number of inputs."""
        self._pairs = pairs(task) if task == "surface" else []
        self._mirror = torch.tensor(mirrored(task), dtype=torch.float32)
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
            inputs = _turned(inputs, self._pairs, angle)
            measures = _turned(measures, _MEASURE_PAIRS, angle)
            coefficients = coefficients * torch.polar(torch.ones(1), -angle[:, None] * self._orders)
        flip = torch.rand(size, 1, generator=generator) < 0.5
        inputs = torch.where(flip, inputs * self._mirror, inputs)
        measures = torch.where(flip, measures * _MEASURE_MIRROR, measures)
        coefficients = torch.where(flip, coefficients.conj(), coefficients)
        return inputs, torch.cat([coefficients.real, coefficients.imag], 1), measures


_MEASURE_PAIRS = [1, 3]
"""Positions in MEASURES of the first component of each pair (x, y)."""

_MEASURE_MIRROR = torch.tensor([1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0])
"""Factors of a mirror in the plane of x and z on MEASURES."""


def _turned(values: torch.Tensor, firsts: Sequence[int], angle: torch.Tensor) -> torch.Tensor:
    """Return values (n, …) whose pairs are turned by angles (n,), rad."""
    values, cosine, sine = values.clone(), torch.cos(angle), torch.sin(angle)
    for k in firsts:
        x, y = values[:, k].clone(), values[:, k + 1].clone()
        values[:, k], values[:, k + 1] = cosine * x - sine * y, sine * x + cosine * y
    return values


class _Perceptron(torch.nn.Module):
    """The torch version of fast_tip.Network."""

    def __init__(self, inputs: int, width: int, layers: int, outputs: int) -> None:
        super().__init__()
        sizes = [(inputs, width), *[(width, width)] * layers, (width, outputs)]
        self.layers = torch.nn.ModuleList([torch.nn.Linear(*size) for size in sizes])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        hidden = torch.nn.functional.silu(self.layers[0](x))
        for layer in self.layers[1:-1]:
            hidden = hidden + torch.nn.functional.silu(layer(hidden))
        return self.layers[-1](hidden)

    def exported(self) -> Network:
        """Return the network for numpy."""
        weights = []
        for layer in self.layers:
            weights += [layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()]
        return Network(tuple(weights))


def train_fast_tip(
    contacts: TipContacts, validation: TipContacts, settings: FastTipSettings, log: Callable[[str], None] = print
) -> FastTip:
    """Train a learned tip.

    Args:
        contacts: Contacts to learn from.
        validation: Other contacts of the same tip, from which the limit of trust is chosen.
        settings: Settings.
        log: Called with a line of progress for each network.

    Raises:
        TactipError: The validation contacts are of another task or tip.
    """
    c = contacts.configuration
    if validation.configuration.task != c.task or mechanics_of(validation.configuration.design) != mechanics_of(c.design):
        raise TactipError("the validation set must have the task, shape and materials of the training set")
    values, yaw = features(c.task, contacts.poses, contacts.shears)
    orders = np.arange(contacts.harmonics.shape[-1])
    canonical = contacts.harmonics * np.exp(1j * np.multiply.outer(yaw, orders))[:, None, None]
    modes = Modes.fit(canonical, settings.modes)
    coefficients = modes.coefficients(canonical)
    center, scale = _scales(c.task, values)
    inputs = (values - center) / scale
    both = np.concatenate([coefficients.real, coefficients.imag], 1)
    # Small modes are not learned relative to their own size, which would be noise.
    coefficient_scale = np.maximum(both.std(0), 0.01 * both.std(0).max()).astype(np.float32)
    measure_center, measure_scale = _measure_scales(contacts.measures, c.task)
    batches = _Batches(c.task, inputs, coefficients, (contacts.measures - measure_center) / measure_scale, modes.orders)
    weight = torch.tensor(np.where(np.tile(modes.orders, 2) > 0, 2.0, 1.0), dtype=torch.float32)
    to_mm = torch.tensor(coefficient_scale)

    def field_loss(outputs: torch.Tensor, coefficients: torch.Tensor, measures: torch.Tensor) -> torch.Tensor:
        return ((outputs * to_mm - coefficients).square() * weight).sum(1).mean()

    def measure_loss(outputs: torch.Tensor, coefficients: torch.Tensor, measures: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.smooth_l1_loss(outputs, measures, beta=0.1)

    networks = [
        _train(batches, 2 * settings.modes, field_loss, settings, k, settings.width, log) for k in range(settings.members)
    ]
    measure_network = _train(batches, len(MEASURES), measure_loss, settings, settings.members, settings.width, log)
    ranges = np.concatenate([c.pose.bounds(), c.shear.bounds()])
    tip = FastTip(
        task=c.task,  # type: ignore[arg-type]
        mechanics=mechanics_of(c.design),
        modes=modes,
        center=center,
        scale=scale,
        networks=tuple(networks),
        coefficient_scale=coefficient_scale,
        measure_network=measure_network,
        measure_center=measure_center,
        measure_scale=measure_scale,
        ranges=from_mm_deg(ranges.reshape(2, 6, 2).swapaxes(1, 2)).swapaxes(1, 2).reshape(12, 2),
        max_spread_m=np.inf,
        provenance={},
    )
    _, spread = tip.coefficients(validation.poses, validation.shears)
    provenance = {
        "contacts": len(contacts),
        "fidelity": c.fidelity.name,
        "settings": dataclasses.asdict(settings),
    }
    return dataclasses.replace(
        tip, max_spread_m=float(np.quantile(spread, settings.trusted_fraction)), provenance=provenance
    )


def _scales(task: Task, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what features (n, COUNT) are centred by and divided by, so that turns and mirrors commute with both."""
    center, scale = values.mean(0), values.std(0)
    for k in pairs(task):
        if task == "surface":
            center[k], scale[k : k + 2] = 0, np.sqrt((scale[k : k + 2] ** 2).mean())
    center[mirrored(task) < 0] = 0
    if task == "surface":
        for k in pairs(task):
            center[k : k + 2] = 0
    return center, np.where(scale > 1e-6, scale, 1.0)


def _measure_scales(measures: np.ndarray, task: Task) -> tuple[np.ndarray, np.ndarray]:
    """The same for measures (n, MEASURES)."""
    center, scale = measures.mean(0), measures.std(0)
    center[_MEASURE_MIRROR.numpy() < 0] = 0
    if task == "surface":
        for k in _MEASURE_PAIRS:
            center[k : k + 2], scale[k : k + 2] = 0, np.sqrt((scale[k : k + 2] ** 2).mean())
    return center, np.where(scale > 1e-6, scale, 1.0)


_Loss = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


def _train(
    batches: _Batches,
    outputs: int,
    loss: _Loss,
    settings: FastTipSettings,
    member: int,
    width: int,
    log: Callable[[str], None],
) -> Network:
    """Train one network and return it."""
    start = time.perf_counter()
    generator = torch.Generator().manual_seed(settings.seed * 1000 + member)
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed * 1000 + member)
        network = _Perceptron(batches.width, width, settings.layers, outputs)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.learning_rate, total_steps=settings.steps, pct_start=0.1
    )
    value = torch.tensor(0.0)
    for _ in range(settings.steps):
        inputs, coefficients, measures = batches.sample(settings.batch, generator)
        value = loss(network(inputs), coefficients, measures)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        schedule.step()
    log(f"network {member}: loss {float(value.detach()):.4g} after {time.perf_counter() - start:.0f} s")
    return network.exported()
