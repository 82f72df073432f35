"""A learned tip that keeps its state: from the skin's deformation and a motion to the next deformation, on any object.

The state is the skin's deformation as coefficients of modes (skin_field.py), in label axes of the sensor. The next one
depends on it, on the motion since, on the pose on the object, and on how far the undeformed tip reaches into the object
(overlap.py). A tip that has just touched down has no deformation before; its motion is the shear. So a contact of a data
set is one step, and a slide is a sequence of steps. An ensemble of networks predicts the change of the coefficients; its
spread tells whether a prediction can be trusted. Another network predicts forces and the like.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tactip_twin.assets import FAST_TIPS
from tactip_twin.sim.fast_tip.archive import check_numbers, pack, unpack
from tactip_twin.sim.fast_tip.features import COUNT, features, mirrored, pairs
from tactip_twin.sim.fast_tip.materials import check_mechanics
from tactip_twin.sim.fast_tip.measures import MEASURES
from tactip_twin.sim.fast_tip.network import Network, network_of
from tactip_twin.sim.fast_tip.overlap import OverlapModes
from tactip_twin.sim.fast_tip.skin_field import RING_ANGLES, Modes
from tactip_twin.sim.labels import TASKS, Task
from tactip_twin.sim.pose import rotation_of
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

FORMAT, VERSION = "tactip-twin sliding tip", 1


@dataclass(frozen=True)
class Steps:
    """Steps of tips on objects, batched. (k steps)"""

    poses: np.ndarray
    """(k, 6) m and rad, labels after the step: poses in the contact frame of the place on the object."""
    motions: np.ndarray
    """(k, 6) m and rad, motion of the sensor in that frame, as a shear (sim/pose.before_shear); of a tip that has just
    touched down, the motion in contact."""
    overlaps: np.ndarray
    """(k, rings, orders) complex64, harmonics of the overlap after the step (overlap.overlap_harmonics)."""
    touched: np.ndarray
    """(k,) bool: whether the tip was in contact before the step."""


class Stepped(NamedTuple):
    """States after some steps. (k steps)"""

    states: np.ndarray
    """(k, n) complex64, coefficients of the modes, in label axes of the sensor."""
    measures: np.ndarray
    """(k, 8), MEASURES."""
    spread_m: np.ndarray
    """(k,) root mean square distance between the networks' fields and their mean, m."""
    trusted: np.ndarray
    """(k,) bool: whether a step is in the learned range and the networks agree."""


def motion_between(T_before: np.ndarray, T_after: np.ndarray, T_contact: np.ndarray) -> np.ndarray:
    """Return the motion (6,) m and rad of a sensor in a contact frame: of its apex, and its turn about the apex.

    Args:
        T_before, T_after: (4, 4), the sensor in the frame of the object.
        T_contact: (4, 4), the contact frame in the frame of the object.
    """
    R = T_contact[:3, :3].T
    turn = rotation_of(R @ T_after[:3, :3] @ T_before[:3, :3].T @ R.T)
    return np.concatenate([R @ (T_after[:3, 3] - T_before[:3, 3]), turn.as_rotvec()])


class Inputs:
    """Layout of the inputs of a network: features of pose and motion, overlap, state before, and whether there was one."""

    def __init__(self, task: Task, overlap_modes: int, state_modes: int) -> None:
        """Take the task, and the numbers of modes of the overlap and of the state."""
        self.task: Task = task
        self.overlap_modes, self.state_modes = overlap_modes, state_modes
        first = COUNT[task]
        self.overlap = slice(first, first + 2 * overlap_modes)
        """Real, then imaginary parts of the overlap."""
        self.state = slice(self.overlap.stop, self.overlap.stop + 2 * state_modes)
        """Real, then imaginary parts of the state."""
        self.count = self.state.stop + 1
        """Number of inputs; the last is 1 after contact, 0 otherwise."""

    def pack(self, values: np.ndarray, overlap: np.ndarray, state: np.ndarray, touched: np.ndarray) -> np.ndarray:
        """Return inputs (k, count) of features (k, COUNT), coefficients of the overlap and of the state, and `touched`."""
        state = state[:, : self.state_modes]
        parts = values, overlap.real, overlap.imag, state.real, state.imag, touched[:, None]
        return np.concatenate(parts, 1).astype(np.float32)

    def extents(self, inputs: np.ndarray) -> np.ndarray:
        """Return the quantities (k, e) of inputs (k, count) whose range is learned; turns and mirrors do not change them."""
        first, columns = 0, []
        for k in pairs(self.task):
            mirror = mirrored(self.task)
            columns += [np.abs(inputs[:, j]) if mirror[j] < 0 else inputs[:, j] for j in range(first, k)]
            columns.append(np.hypot(inputs[:, k], inputs[:, k + 1]))
            first = k + 2
        columns.append(np.abs(inputs[:, first]))
        half = self.overlap.start + self.overlap_modes
        columns += list(np.hypot(inputs[:, self.overlap.start : half], inputs[:, half : self.overlap.stop]).T)
        return np.stack(columns, 1)

    @cached_property
    def can_vanish(self) -> np.ndarray:
        """Which quantities (e,) bool of `extents` are sizes of a tilt or a motion. Zero is amid their learned range, but no
        training path has it exactly."""
        count = self.extents(np.zeros((1, self.count))).shape[1]
        scalars = {"surface": (0, 3), "edge": (0, 1, 4)}[
            self.task
        ]  # position across an edge, depth, motion along the normal
        return np.array([k < count - self.overlap_modes and k not in scalars for k in range(count)])


@dataclass(frozen=True)
class SlidingTip:
    """A learned tip that keeps its state, for one task."""

    task: Task
    """`surface` or `edge`."""
    mechanics: dict[str, Any]
    """Shape and materials of the tip that it learned (materials.mechanics_of)."""
    modes: Modes
    """Modes of the skin's deformation."""
    overlap_modes: OverlapModes
    """Modes of the overlap."""
    state_modes: int
    """Number of modes of the state before that the networks see, the largest."""
    center: np.ndarray
    """(inputs,) subtracted from the inputs."""
    scale: np.ndarray
    """(inputs,) that they are divided by."""
    networks: tuple[Network, ...]
    """Networks from scaled inputs to changes of the coefficients over `coefficient_scale`."""
    coefficient_scale: np.ndarray
    """(2 modes,) mm: real parts, then imaginary parts."""
    measure_network: Network
    """Network from scaled inputs to MEASURES over their scale."""
    measure_center: np.ndarray
    """(measures,)."""
    measure_scale: np.ndarray
    """(measures,)."""
    extents: np.ndarray
    """(e, 2) low and high of Inputs.extents in the training sets."""
    max_spread_m: float
    """Largest spread of a prediction that is trusted, m."""
    provenance: dict[str, Any]
    """Training sets, settings and errors, as JSON."""

    @cached_property
    def inputs(self) -> Inputs:
        """Layout of the networks' inputs."""
        return Inputs(self.task, len(self.overlap_modes.orders), self.state_modes)

    def check_design(self, design: Design) -> None:
        """Raise TactipError if a design has another shape or other materials than those learned."""
        check_mechanics(self.mechanics, design)

    def step(self, steps: Steps, states: np.ndarray) -> "Stepped":
        """Return the states after some steps.

        Args:
            steps: The steps.
            states: (k, n) complex, coefficients of the modes before.
        """
        values, yaw = features(self.task, steps.poses, steps.motions)
        before = self.modes.turned(np.where(steps.touched[:, None], states, 0), -yaw)
        overlap = self.overlap_modes.turned(self.overlap_modes.coefficients(steps.overlaps), -yaw)
        raw = self.inputs.pack(values, overlap, before, steps.touched)
        scaled = ((raw - self.center) / self.scale).astype(np.float32)
        outputs = np.stack([network(scaled) for network in self.networks]) * self.coefficient_scale
        count, mean = len(self.modes.orders), outputs.mean(0)
        spread = field_rms_m(outputs - mean, self.modes.orders)
        extents = self.inputs.extents(raw)
        low = np.where(self.inputs.can_vanish, 0.0, self.extents[:, 0])
        inside = ((extents >= low) & (extents <= self.extents[:, 1])).all(1)
        measures = self.measure_network(scaled) * self.measure_scale + self.measure_center
        after = self.modes.turned(before + mean[:, :count] + 1j * mean[:, count:], yaw).astype(np.complex64)
        return Stepped(after, measures, spread, inside & (spread <= self.max_spread_m))

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the file, by name."""
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {
            "orders": self.modes.orders.astype(np.int64),
            "profiles": self.modes.profiles.astype(np.float32),
            "overlap_orders": self.overlap_modes.orders.astype(np.int64),
            "overlap_profiles": self.overlap_modes.profiles.astype(np.float32),
        }
        for k, network in enumerate((*self.networks, self.measure_network)):
            arrays |= network.arrays(f"network{k}")
        return arrays

    @cached_property
    def digest(self) -> str:
        """Checksum of the file, in hex."""
        return hashlib.sha256(self.to_bytes()).hexdigest()

    def to_bytes(self) -> bytes:
        """Return the content of a file."""
        names = ("task", "mechanics", "state_modes", "max_spread_m", "provenance")
        description = {name: getattr(self, name) for name in names} | {"networks": len(self.networks)}
        return pack(FORMAT, VERSION, description, self._arrays)


_ARRAYS = ("center", "scale", "coefficient_scale", "measure_center", "measure_scale", "extents")


def field_rms_m(differences: np.ndarray, orders: np.ndarray) -> np.ndarray:
    """Return the root mean square (k,), m, over members and skin, of differences of coefficients.

    Args:
        differences: (members, k, 2 n) mm, real parts, then imaginary parts.
        orders: (n,) of the modes.
    """
    # By Parseval's theorem, weighted by area: orders above 0 count twice.
    weight = np.where(np.tile(orders, 2) > 0, 2.0, 1.0) / np.sin(RING_ANGLES).sum()
    return 1e-3 * np.sqrt(((differences**2).mean(0) * weight).sum(1))


def shipped_sliding_tip(task: Task, design: str) -> Path:
    """Return the file of the shipped sliding tip of a task and a design. Raises TactipError if there is none."""
    path = FAST_TIPS / f"{task}-{design}-sliding.npz"
    if not path.exists():
        raise TactipError(f"there is no shipped sliding tip for {task} and {design}: teach one with `tactip sliding-tip`")
    return path


def write_sliding_tip(tip: SlidingTip, path: Path) -> None:
    """Write a sliding tip to a file. Raises OSError."""
    write_file(path, tip.to_bytes())


def read_sliding_tip(path: str | Path) -> SlidingTip:
    """Read a sliding tip from a file. Raises TactipError if the file is none, or was altered."""
    about, arrays = unpack(path, FORMAT, VERSION)
    try:
        task, members, count = about["task"], about["networks"], len(arrays["orders"])
        if task not in TASKS:
            raise ValueError(f"the task must be one of {', '.join(TASKS)}, got {task!r:.40}")
        if members < 2:
            raise ValueError(f"it must have at least 2 networks, got {members}: a single one has no spread")
        if not 0 < about["state_modes"] <= count:
            raise ValueError(f"state_modes must be from 1 to {count}, got {about['state_modes']}")
        inputs = Inputs(task, len(arrays["overlap_orders"]), about["state_modes"])
        sizes = [2 * count] * members + [len(MEASURES)]
        networks = [network_of(arrays, f"network{k}", inputs.count, size) for k, size in enumerate(sizes)]
        shapes = {
            "center": (inputs.count,),
            "scale": (inputs.count,),
            "coefficient_scale": (2 * count,),
            "measure_center": (len(MEASURES),),
            "measure_scale": (len(MEASURES),),
            "extents": (inputs.extents(np.zeros((1, inputs.count))).shape[1], 2),
        }
        check_numbers(arrays, shapes)
        tip = SlidingTip(
            task=task,
            mechanics=about["mechanics"],
            modes=Modes(arrays["orders"], arrays["profiles"].astype(float)),
            overlap_modes=OverlapModes(arrays["overlap_orders"], arrays["overlap_profiles"].astype(float)),
            state_modes=about["state_modes"],
            networks=tuple(networks[:-1]),
            measure_network=networks[-1],
            max_spread_m=float(about["max_spread_m"]),
            provenance=about["provenance"],
            **{name: arrays[name] for name in _ARRAYS},
        )
        tip.modes.check()
        tip.overlap_modes.check()
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise TactipError(f"{path} holds no sliding tip: {error}") from error
    return tip
