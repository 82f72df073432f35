"""Training of a sliding tip on data sets with sliding paths and kept meshes (`tactip dataset make --snapshots-per-contact N
--keep-mesh`)."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from tqdm import tqdm

from tactip_twin.learning.fast_tip_training import set_identity
from tactip_twin.learning.sliding_paths import SlidingPaths, check_same_tip, read_paths
from tactip_twin.learning.sliding_tip_settings import SlidingTipSettings
from tactip_twin.learning.tip_networks import Perceptron, train_network, train_networks, turned_pairs
from tactip_twin.sim.fast_tip.fast_tip import PinDecoder
from tactip_twin.sim.fast_tip.features import COUNT, features, mirrored, pairs
from tactip_twin.sim.fast_tip.materials import mechanics_of
from tactip_twin.sim.fast_tip.measures import MEASURE_MIRROR, MEASURE_PAIRS, MEASURES
from tactip_twin.sim.fast_tip.network import Network
from tactip_twin.sim.fast_tip.overlap import OverlapModes
from tactip_twin.sim.fast_tip.skin_field import Modes
from tactip_twin.sim.fast_tip.sliding_tip import Inputs, SlidingTip, Stepped, read_sliding_tip, write_sliding_tip
from tactip_twin.sim.labels import Task
from tactip_twin.sim.parallel.file_lock import locked
from tactip_twin.sim.parallel.resume import check_resumable
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_json
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import PinReader

SLIDING_TIP = "sliding_tip.npz"
"""File of the sliding tip in the folder of its training."""

_SETTINGS, _LOCK = "settings.json", "lock"

_MIN_SCALE = 0.01
"""Smallest scale of a coefficient, relative to the largest: small modes are not learned relative to their own size, which
would be noise."""

_MAX_GRADIENT = 5.0
"""Largest norm of a gradient; rollouts through wrong early networks have larger ones."""


class _Plan:
    """Everything that the networks of a sliding tip share: modes, scales, and the paths as tensors in axes of the task.

    On an edge, these axes are parallel to it; on a surface, they are the sensor's. (p paths, n states)
    """

    def __init__(self, paths: SlidingPaths, settings: SlidingTipSettings) -> None:
        """Find the modes and the scales of some paths."""
        self.settings = settings
        self.task: Task = paths.task
        shape = paths.poses.shape[:2]
        values, yaw = features(self.task, paths.poses.reshape(-1, 6), paths.motions.reshape(-1, 6))
        harmonics = paths.harmonics.reshape(-1, *paths.harmonics.shape[2:])
        harmonics = harmonics * np.exp(1j * np.multiply.outer(yaw, np.arange(harmonics.shape[-1])))[:, None, None]
        overlaps = paths.overlaps.reshape(-1, *paths.overlaps.shape[2:])
        overlaps = overlaps * np.exp(1j * np.multiply.outer(yaw, np.arange(overlaps.shape[-1])))[:, None]
        good = paths.good.reshape(-1)
        self.modes = Modes.fit(harmonics[good], settings.modes)
        self.overlap_modes = OverlapModes.fit(overlaps[good], settings.overlap_modes)
        coefficients, overlap = self.modes.coefficients(harmonics), self.overlap_modes.coefficients(overlaps)
        self.inputs = Inputs(self.task, len(self.overlap_modes.orders), min(settings.state_modes, len(self.modes.orders)))
        raw = self.inputs.pack(values, overlap, coefficients, np.ones(len(values)))
        extents = self.inputs.extents(raw[good])
        self.extents = np.stack([extents.min(0), extents.max(0)], 1)
        size = np.sqrt((np.abs(coefficients[good]) ** 2).mean(0))
        self.coefficient_scale = np.tile(np.maximum(size, _MIN_SCALE * size.max()), 2).astype(np.float32)
        self.center, self.scale = self._scales(values[good], overlap[good])
        measures = paths.measures.reshape(-1, len(MEASURES))
        self.measure_center, self.measure_scale = _measure_scales(self.task, measures[good])
        self.values = _tensor(values.reshape(*shape, -1))
        self.overlap = torch.tensor(overlap.astype(np.complex64).reshape(*shape, -1))
        self.coefficients = torch.tensor(coefficients.astype(np.complex64).reshape(*shape, -1))
        self.measures = _tensor(((measures - self.measure_center) / self.measure_scale).reshape(*shape, -1))
        self.yaw, self.good = _tensor(yaw.reshape(shape)), torch.tensor(paths.good)
        self.orders, self.overlap_orders = _tensor(self.modes.orders), _tensor(self.overlap_modes.orders)
        self._mirror, self._measure_mirror = _tensor(mirrored(self.task)), _tensor(MEASURE_MIRROR)
        self._center, self._scale = _tensor(self.center), _tensor(self.scale)
        self.to_mm = _tensor(self.coefficient_scale)
        # By Parseval's theorem: orders above 0 count twice.
        self.weight = _tensor(np.where(np.tile(self.modes.orders, 2) > 0, 2.0, 1.0))
        self.windows = {length: self._windows(length) for length in (1, settings.rollout)}

    def _scales(self, values: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what inputs are centred by and divided by, so that turns and mirrors commute with both."""
        center, scale = np.zeros(self.inputs.count), np.ones(self.inputs.count)
        first = slice(0, COUNT[self.task])
        center[first] = np.where(mirrored(self.task) < 0, 0, values.mean(0))
        scale[first] = np.sqrt(((values - center[first]) ** 2).mean(0))
        for k in pairs(self.task) if self.task == "surface" else []:
            center[k : k + 2] = 0
            scale[k : k + 2] = np.sqrt((values[:, k : k + 2] ** 2).mean())
        scale[self.inputs.overlap] = np.tile(np.sqrt((np.abs(overlap) ** 2).mean(0)), 2)
        count = len(self.coefficient_scale) // 2
        scale[self.inputs.state] = np.tile(self.coefficient_scale[:count][: self.inputs.state_modes], 2)
        return center, np.where(scale > 1e-6, scale, 1.0)

    def _windows(self, length: int) -> torch.Tensor:
        """Return path and first state (w, 2) of the runs of `length` good states."""
        good = self.good.unfold(1, length, 1).all(-1)
        # The state before must be good, too, unless the tip has just touched down.
        good[:, 1:] &= self.good[:, : good.shape[1] - 1]
        return good.nonzero()

    def sample(self, length: int, generator: torch.Generator) -> "_Batch":
        """Return a batch of runs of `length` states, each turned and mirrored at random."""
        windows = self.windows[length]
        size = self.settings.batch
        path, first = windows[torch.randint(len(windows), (size,), generator=generator)].T
        angle = torch.zeros(size)
        if self.task == "surface":
            angle = 2 * torch.pi * torch.rand(size, generator=generator)
        flip = torch.rand(size, 1, generator=generator) < 0.5
        return _Batch(self, path, first, angle, flip, generator)


class _Batch:
    """Runs of states on paths, turned and mirrored. (b runs)"""

    def __init__(
        self,
        plan: _Plan,
        path: torch.Tensor,
        first: torch.Tensor,
        angle: torch.Tensor,
        flip: torch.Tensor,
        generator: torch.Generator,
    ) -> None:
        """Take paths and first states (b,), angles (b,), rad, and which are mirrored (b, 1)."""
        self._plan, self._path, self._first, self._angle, self._flip = plan, path, first, angle, flip
        self._on_surface = plan.task == "surface"
        self.touched = (first > 0).float()[:, None]
        """(b, 1): 1 where the tip was in contact before the first state."""
        before = self._moved(plan.coefficients[path, (first - 1).clamp(min=0)], plan.orders)
        before = self._turned_along(before, 0)
        count = before.shape[1]
        size = plan.settings.noise * torch.randn(len(path), 1, generator=generator)
        noise = torch.view_as_complex(torch.randn(len(path), count, 2, generator=generator))
        self.before = (before + size * noise * plan.to_mm[:count]) * self.touched
        """(b, modes) complex, with noise, the state before the first one, in its axes; 0 where there is none."""

    def _moved(self, coefficients: torch.Tensor, orders: torch.Tensor) -> torch.Tensor:
        """Turn and mirror coefficients (b, n) of modes with orders (n,)."""
        if self._on_surface:
            coefficients = coefficients * torch.polar(torch.ones(1), -self._angle[:, None] * orders)
        return torch.where(self._flip, coefficients.conj(), coefficients)

    def _turned_along(self, state: torch.Tensor, k: int) -> torch.Tensor:
        """Return a state (b, modes) in the axes of the state before as one in the axes of state k, which turn on an edge."""
        if self._on_surface:
            return state
        plan, now = self._plan, self._first + k
        turn = (plan.yaw[self._path, now] - plan.yaw[self._path, (now - 1).clamp(min=0)])[:, None]
        return state * torch.polar(torch.ones(1), torch.where(self._flip, -turn, turn) * plan.orders)

    def inputs(self, k: int, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the scaled inputs (b, count) of the step to state k, and the state (b, modes) before it in its axes."""
        plan, at = self._plan, (self._path, self._first + k)
        state = self._turned_along(state, k) if k else state
        values = plan.values[at]
        if self._on_surface:
            values = turned_pairs(values, pairs("surface"), self._angle)
        values = torch.where(self._flip, values * plan._mirror, values)
        overlap, seen = self._moved(plan.overlap[at], plan.overlap_orders), state[:, : plan.inputs.state_modes]
        touched = torch.ones_like(self.touched) if k else self.touched
        raw = torch.cat([values, overlap.real, overlap.imag, seen.real, seen.imag, touched], 1)
        return (raw - plan._center) / plan._scale, state

    def coefficients(self, k: int) -> torch.Tensor:
        """Return the true coefficients (b, modes) of state k."""
        return self._moved(self._plan.coefficients[self._path, self._first + k], self._plan.orders)

    def measures(self, k: int) -> torch.Tensor:
        """Return the true scaled measures (b, MEASURES) of state k."""
        measures = self._plan.measures[self._path, self._first + k]
        if self._on_surface:
            measures = turned_pairs(measures, MEASURE_PAIRS, self._angle)
        return torch.where(self._flip, measures * self._plan._measure_mirror, measures)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def _measure_scales(task: Task, measures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what measures (k, MEASURES) are centred by and divided by, so that turns and mirrors commute with both."""
    center, scale = np.where(MEASURE_MIRROR < 0, 0, measures.mean(0)), measures.std(0)
    for k in MEASURE_PAIRS if task == "surface" else []:
        center[k : k + 2], scale[k : k + 2] = 0, np.sqrt((measures[:, k : k + 2] ** 2).mean())
    return center, np.where(scale > 1e-6, scale, 1.0)


def _train(plan: _Plan, member: int, bar: "tqdm[NoReturn]") -> Network:
    """Train network `member` and return it; the last one is that of measures."""
    settings = plan.settings
    of_measures = member == settings.members
    count = len(plan.modes.orders)
    outputs = len(MEASURES) if of_measures else 2 * count
    rollouts_from = (1 - settings.rollout_fraction) * settings.steps

    def measure_loss(network: Perceptron, generator: torch.Generator, step: int) -> torch.Tensor:
        batch = plan.sample(1, generator)
        inputs, _ = batch.inputs(0, batch.before)
        return torch.nn.functional.smooth_l1_loss(network(inputs), batch.measures(0), beta=0.1)

    def loss(network: Perceptron, generator: torch.Generator, step: int) -> torch.Tensor:
        length = settings.rollout if step >= rollouts_from else 1
        batch = plan.sample(length, generator)
        state, losses = batch.before, []
        for k in range(length):
            inputs, before = batch.inputs(k, state)
            change = network(inputs) * plan.to_mm
            state = before + torch.complex(change[:, :count], change[:, count:])
            wrong = torch.view_as_real(state - batch.coefficients(k))
            losses.append((wrong.square().transpose(1, 2).flatten(1) * plan.weight).sum(1).mean())
        return torch.stack(losses).mean()

    def network() -> Perceptron:
        return Perceptron(plan.inputs.count, settings.width, settings.layers, outputs, skip=True)

    return train_network(network, measure_loss if of_measures else loss, settings, settings.seed * 1000 + member, bar)


def train_sliding_tip(
    folders: Sequence[Path],
    validation: Sequence[Path],
    settings: SlidingTipSettings,
    out: Path,
    log: Callable[[str], None] = print,
    quiet: bool = False,
) -> SlidingTip:
    """Train a sliding tip, or resume its training after the last finished network.

    Args:
        folders: Sets to learn from, of one task and tip, with sliding paths and kept meshes.
        validation: Other such sets, from which the limit of trust is chosen and whose errors are recorded.
        settings: Settings.
        out: Folder of the training; SLIDING_TIP in it is the sliding tip.
        log: Callback for messages to the user.
        quiet: Whether to hide the progress bar.

    Raises:
        TactipError: A set cannot be used, or the folder holds something else.
        Interrupted: Ctrl-C.
    """
    record = {
        "train": [set_identity(folder) for folder in folders],
        "validation": [set_identity(folder) for folder in validation],
        "settings": dataclasses.asdict(settings),
        "torch": torch.__version__,
    }
    path = out / _SETTINGS
    recorded = read_json(path) if path.exists() else None
    check_resumable(out, "sliding tip", recorded, record, (_LOCK,))
    if (out / SLIDING_TIP).exists():
        log(f"the sliding tip in {out} is taught already")
        return read_sliding_tip(out / SLIDING_TIP)
    # Before the folder is made, so a set that cannot be used leaves none.
    paths, held_out = read_paths(folders), read_paths(validation)
    check_same_tip(held_out.configuration, paths.configuration, validation[0], folders[0])
    out.mkdir(parents=True, exist_ok=True)
    with locked(out / _LOCK, f"teaching a sliding tip in {out}"):
        if recorded is None:
            write_file(path, json.dumps(record, indent=1).encode())
        plan = _Plan(paths, settings)
        networks = train_networks(partial(_train, plan), settings.members + 1, settings.steps, out, quiet)
        tip = SlidingTip(
            task=paths.task,
            mechanics=mechanics_of(paths.configuration.design),
            modes=plan.modes,
            overlap_modes=plan.overlap_modes,
            state_modes=plan.inputs.state_modes,
            center=plan.center,
            scale=plan.scale,
            networks=tuple(networks[:-1]),
            coefficient_scale=plan.coefficient_scale,
            measure_network=networks[-1],
            measure_center=plan.measure_center,
            measure_scale=plan.measure_scale,
            extents=plan.extents,
            max_spread_m=np.inf,
            provenance={},
        )
        spread = np.concatenate([one.spread_m for one in _single_steps(tip, held_out)])
        tip = dataclasses.replace(tip, max_spread_m=float(np.quantile(spread, settings.trusted_fraction)))
        provenance = record | {"states": int(plan.good.sum()), "errors": sliding_tip_errors(tip, held_out)}
        write_sliding_tip(dataclasses.replace(tip, provenance=provenance), out / SLIDING_TIP)
        return read_sliding_tip(out / SLIDING_TIP)


def _single_steps(tip: SlidingTip, paths: SlidingPaths) -> list[Stepped]:
    """Return the predicted steps of all paths to each of their states, from the true states before."""
    states = np.zeros((len(paths.poses), len(tip.modes.orders)), np.complex64)
    out = []
    for k in range(paths.poses.shape[1]):
        out.append(tip.step(paths.step(k), states))
        states = tip.modes.coefficients(paths.harmonics[:, k])
    return out


def sliding_tip_errors(tip: SlidingTip, paths: SlidingPaths) -> dict[str, float]:
    """Return the errors of a sliding tip on simulated paths that it has not seen.

    Args:
        tip: The sliding tip.
        paths: Paths of the same task and tip.

    Returns:
        Mean distances between pin tips, mm: touch_mm after touching down, step_mm after a step from the true state, slide_mm
        after each of a sequence of steps from touching down, last_mm after its last quarter, slide_p95_mm the 95th
        percentile of its contacts; force: sum of the errors of the normal force over the sum of forces, in the sequences;
        trusted: fraction of their steps that can be trusted; trusted_slide_mm: slide_mm of these.
    """
    c, good = paths.configuration, paths.good.T
    pins, _ = PinReader(c.design, build_mesh(c.design.shape, c.fidelity.mesh)).read(paths.skins.swapaxes(0, 1))
    decoder = PinDecoder(c.design, tip.modes)

    def apart(states: np.ndarray, k: int) -> np.ndarray:
        return 1e3 * np.linalg.norm(decoder(states)[0] - pins[k], axis=-1).mean(1)

    single = np.array([apart(one.states, k) for k, one in enumerate(_single_steps(tip, paths))])
    states, slid = np.zeros((len(paths.poses), len(tip.modes.orders)), np.complex64), []
    forces, trusted = [], []
    for k in range(len(good)):
        stepped = tip.step(paths.step(k), states)
        states = stepped.states
        slid.append(apart(states, k))
        forces.append(np.exp(stepped.measures[:, 0]))
        trusted.append(stepped.trusted)
    sliding, believed = np.array(slid), np.array(trusted) & good
    last, true = np.arange(len(good)) >= 0.75 * len(good), np.exp(paths.measures[..., 0].T)
    return {
        "touch_mm": float(single[0][good[0]].mean()),
        "step_mm": float(single[1:][good[1:]].mean()),
        "slide_mm": float(sliding[good].mean()),
        "last_mm": float(sliding[last][good[last]].mean()),
        "slide_p95_mm": float(np.percentile(sliding[good], 95)),
        "force": float(np.abs(np.array(forces) - true)[good].sum() / true[good].sum()),
        "trusted": float(believed.sum() / good.sum()),
        "trusted_slide_mm": float(sliding[believed].mean()),
    }
