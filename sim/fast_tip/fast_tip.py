"""Prediction of contacts by the learned tip, and its file.

An ensemble of small networks maps a contact's features to the coefficients of the skin's modes. Their mean is the
prediction, and their spread tells whether it can be trusted. A second network predicts forces and the like.
"""

import hashlib
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.assets import FAST_TIPS
from tactip_twin.sim.fast_tip.archive import check_numbers, pack, unpack
from tactip_twin.sim.fast_tip.features import COUNT, features, without_yaw
from tactip_twin.sim.fast_tip.materials import (
    INPUTS,
    are_learned,
    check_inputs,
    check_mechanics,
    inputs_of,
    material_inputs,
    nearest_learned,
)
from tactip_twin.sim.fast_tip.measures import MEASURES, forces_and_patch
from tactip_twin.sim.fast_tip.network import Network, network_of
from tactip_twin.sim.fast_tip.skin_field import RING_ANGLES, Modes
from tactip_twin.sim.labels import TASKS, Task
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.pins import neutral_pins, pin_lever_m

FORMAT, VERSION = "tactip-twin learned tip", 1


def any_materials(task: Task) -> Path:
    """Return the file of the shipped tip of a task that knows any materials."""
    return FAST_TIPS / f"{task}-any-materials.npz"


REFERENCE_YOUNG_PA = 1e4
"""Young's modulus of the gel, Pa, for which a tip that knows any materials learns its forces."""


@dataclass(frozen=True)
class Prediction:
    """Predicted contacts. (k contacts, p pins, n modes)"""

    coefficients: np.ndarray
    """(k, n) complex64 coefficients of the skin's modes, sensor frame."""
    pin_tips: np.ndarray
    """(k, p, 3) m, sensor frame."""
    directions: np.ndarray
    """(k, p, 3) unit, sensor frame."""
    normal_forces_n: np.ndarray
    """(k,) N, force of the object on the tip along the outward normal."""
    tangential_forces_n: np.ndarray
    """(k,) N, magnitude of the rest of that force."""
    forces_n: np.ndarray
    """(k, 3) N, that force in the sensor frame."""
    effective_shears: np.ndarray
    """(k, 6) m and rad, in the axes of a label."""
    slip_fractions: np.ndarray
    """(k,) -."""
    contact_areas_m2: np.ndarray
    """(k,) m^2."""
    spread_m: np.ndarray
    """(k,) root mean square distance between the networks' fields and their mean, m."""
    trusted: np.ndarray
    """(k,) bool: whether a contact is in the learned ranges and the networks agree."""


@dataclass(frozen=True)
class FastTip:
    """A learned tip for one task."""

    task: Task
    """`surface` or `edge`."""
    mechanics: dict[str, Any]
    """Shape and materials of the tip that it learned (materials.mechanics_of)."""
    modes: Modes
    """Modes of the skin's deformation."""
    center: np.ndarray
    """(features,) subtracted from the features."""
    scale: np.ndarray
    """(features,) that they are divided by."""
    networks: tuple[Network, ...]
    """Networks from scaled features to coefficients over `coefficient_scale`."""
    coefficient_scale: np.ndarray
    """(2 modes,) mm: real parts, then imaginary parts."""
    measure_network: Network
    """Network from scaled features to MEASURES over their scale."""
    measure_center: np.ndarray
    """(measures,)."""
    measure_scale: np.ndarray
    """(measures,)."""
    ranges: np.ndarray
    """(12, 2) low and high of pose and shear, m and rad, as of the training set."""
    max_spread_m: float
    """Largest spread of a prediction that is trusted, m."""
    provenance: dict[str, Any]
    """Training sets, settings and errors, as JSON."""
    materials: np.ndarray | None = None
    """(6, 2) low and high of materials.INPUTS in the training set; None if it knows the materials of one tip only."""

    def check_design(self, design: Design, randomized: bool = False) -> None:
        """Raise TactipError if a design has another shape or other materials than those learned.

        Args:
            design: The design.
            randomized: Whether its materials differ from contact to contact, so its own need not be known.
        """
        if randomized and self.materials is None:
            raise TactipError(
                "mechanics_randomization needs a learned tip of any materials, or simulated contacts: this learned tip "
                f"knows the materials of one tip only, on the task {self.task!r}"
            )
        check_mechanics(self.mechanics, design)
        if self.materials is not None and not randomized:
            check_inputs(material_inputs(design.materials), self.materials)

    def outside(self, poses: np.ndarray, shears: np.ndarray) -> np.ndarray:
        """Return whether contacts (k, 6), (k, 6) lie outside the learned ranges, (k,) bool."""
        beyond = self._beyond(poses, shears)
        if self.task == "edge" and beyond.any():
            # The tip is round, so any yaw is known: the sensor is turned about its own axis until it has none.
            beyond[beyond] = self._beyond(without_yaw(poses[beyond]), shears[beyond])
        return beyond

    def _beyond(self, poses: np.ndarray, shears: np.ndarray) -> np.ndarray:
        """Return whether poses and shears (k, 6), (k, 6) lie outside the ranges of the tip's training, (k,) bool."""
        both = np.concatenate([poses, shears], 1)
        return np.any((both < self.ranges[:, 0] - 1e-9) | (both > self.ranges[:, 1] + 1e-9), axis=1)

    def coefficients(
        self, poses: np.ndarray, shears: np.ndarray, materials: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients (k, n) complex64 of the skin's modes in the sensor's axes, and their spread (k,), m.

        Args:
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.
            materials: materials.INPUTS (6,), or (k, 6), of the tips; needed, and used, if it knows any materials.
        """
        scaled, yaw = self._scaled(poses, shears, materials)
        outputs = np.stack([network(scaled) for network in self.networks]) * self.coefficient_scale
        count = len(self.modes.orders)
        mean = outputs.mean(0)
        # By Parseval's theorem, weighted by area: orders above 0 count twice.
        weight = np.where(np.tile(self.modes.orders, 2) > 0, 2.0, 1.0) / np.sin(RING_ANGLES).sum()
        spread = 1e-3 * np.sqrt((((outputs - mean) ** 2).mean(0) * weight).sum(1))
        return self.modes.turned(mean[:, :count] + 1j * mean[:, count:], yaw), spread

    def predict(
        self, decoder: "PinDecoder", poses: np.ndarray, shears: np.ndarray, materials: np.ndarray | None = None
    ) -> Prediction:
        """Predict contacts.

        Args:
            decoder: Pins of the design.
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.
            materials: As of `coefficients`; (6,).
        """
        return self._predict(decoder, poses, shears, materials, decoder.gel_young_pa, 0.0)

    def predict_each(
        self, decoder: "PinDecoder", poses: np.ndarray, shears: np.ndarray, mechanics: Mapping[str, np.ndarray]
    ) -> Prediction:
        """Predict contacts of tips whose mechanics differ. Those with mechanics that it has not learned are not trusted.

        Args:
            decoder: Pins of one of the tips, whose pins differ from those of the others by their length alone.
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.
            mechanics: Fields (k,) of Materials by name, materials.VARIABLE, and length_m, the length of the pins.

        Raises:
            TactipError: If it knows the materials of one tip only.
        """
        if self.materials is None:
            raise TactipError(f"this learned tip knows the materials of one tip only, on the task {self.task!r}")
        materials = nearest_learned(inputs_of(mechanics), self.materials)
        longer_m = mechanics["length_m"] - decoder.length_m
        predicted = self._predict(decoder, poses, shears, materials, mechanics["gel_young_pa"], longer_m)
        return replace(predicted, trusted=predicted.trusted & are_learned(materials, self.materials).all(-1))

    def _predict(
        self,
        decoder: "PinDecoder",
        poses: np.ndarray,
        shears: np.ndarray,
        materials: np.ndarray | None,
        gel_young_pa: float | np.ndarray,
        longer_m: float | np.ndarray,
    ) -> Prediction:
        """Predict contacts with gels (k,) and pins (k,) longer than the decoder's."""
        poses, shears = np.asarray(poses, float), np.asarray(shears, float)
        coefficients, spread = self.coefficients(poses, shears, materials)
        tips, directions = decoder(coefficients, longer_m)
        scaled, _ = self._scaled(poses, shears, materials)
        measures = self.measure_network(scaled) * self.measure_scale + self.measure_center
        if self.materials is not None:
            measures[:, 0] += np.log(gel_young_pa / REFERENCE_YOUNG_PA)
        return Prediction(
            coefficients=coefficients,
            pin_tips=tips,
            directions=directions,
            **forces_and_patch(measures, poses),
            spread_m=spread,
            trusted=~self.outside(poses, shears) & (spread <= self.max_spread_m),
        )

    def _scaled(self, poses: np.ndarray, shears: np.ndarray, materials: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        values, yaw = features(self.task, poses, shears)
        if self.materials is not None:
            values = np.concatenate([values, np.broadcast_to(np.asarray(materials, float), (len(values), len(INPUTS)))], 1)
        return ((values - self.center) / self.scale).astype(np.float32), yaw

    @cached_property
    def digest(self) -> str:
        """Checksum of the file, in hex."""
        return hashlib.sha256(self.to_bytes()).hexdigest()

    def to_bytes(self) -> bytes:
        """Return the content of a file: an NPZ archive of the arrays, and a description as JSON."""
        description = {
            "task": self.task,
            "mechanics": self.mechanics,
            "max_spread_m": self.max_spread_m,
            "networks": len(self.networks),
            "provenance": self.provenance,
        }
        return pack(FORMAT, VERSION, description, self._arrays())

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the file, by name."""
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {
            "orders": self.modes.orders.astype(np.int64),
            "profiles": self.modes.profiles.astype(np.float32),
        }
        for k, network in enumerate((*self.networks, self.measure_network)):
            arrays |= network.arrays(f"network{k}")
        return arrays if self.materials is None else arrays | {"materials": self.materials}


_ARRAYS = ("center", "scale", "coefficient_scale", "measure_center", "measure_scale", "ranges")


class PinDecoder:
    """Pins of a design for coefficients of the skin's modes: linear maps, computed once."""

    gel_young_pa: float
    """Young's modulus of the design's gel, Pa."""
    length_m: float
    """Length of its pins, m."""

    def __init__(self, design: Design, modes: Modes) -> None:
        """Evaluate the modes at the design's pins."""
        _, self._directions = neutral_pins(design)
        self._moved, turned = modes.at(-self._directions)
        self._to_turns = turned.reshape(len(turned), -1).astype(np.float32)
        self._turned = turned
        self._set_mechanics(design)

    def with_mechanics(self, design: Design) -> "PinDecoder":
        """Return the decoder of a design with the same pins but for their length, and other materials, in a tenth of the
        time."""
        other = copy(self)
        other._set_mechanics(design)
        return other

    def _set_mechanics(self, design: Design) -> None:
        self.gel_young_pa, self.length_m = design.materials.gel_young_pa, design.pins.length_m
        self._tips, _ = neutral_pins(design)
        to_tips = self._moved - pin_lever_m(design) * self._turned
        self._to_tips = to_tips.reshape(len(to_tips), -1).astype(np.float32)

    def tips(self, coefficients: np.ndarray) -> np.ndarray:
        """Return pin tips (k, p, 3), m, sensor frame, for coefficients (k, n) complex, in half the time of a call."""
        return self._tips + (_parts(coefficients) @ self._to_tips).reshape(-1, *self._tips.shape)

    def __call__(self, coefficients: np.ndarray, longer_m: float | np.ndarray = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return pin tips (k, p, 3), m, and directions (k, p, 3) for coefficients (k, n) complex; sensor frame.

        Args:
            coefficients: (k, n).
            longer_m: Length by which the pins of each contact (k,) exceed those of the design, m.
        """
        tips, parts = self.tips(coefficients), _parts(coefficients)
        directions = self._directions - (parts @ self._to_turns).reshape(tips.shape)
        if np.any(longer_m):
            # A pin's tip moves with its root, plus its length times the change of the normal.
            tips += np.reshape(longer_m, (-1, 1, 1)) * directions
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return tips, directions


def _parts(coefficients: np.ndarray) -> np.ndarray:
    """Return the real and imaginary parts (k, 2 n) float32 of coefficients (k, n)."""
    return np.concatenate([coefficients.real, coefficients.imag], 1).astype(np.float32)


def shipped_fast_tip(task: Task, design: str, randomized: bool = False) -> Path:
    """Return the file of the shipped learned tip of a task and a design: its own, or that of any materials.

    Args:
        task: `surface` or `edge`.
        design: Name of the design.
        randomized: Whether the design's materials differ from contact to contact.
    """
    path = FAST_TIPS / f"{task}-{design}.npz"
    return any_materials(task) if randomized or not path.exists() else path


def write_fast_tip(tip: FastTip, path: Path) -> None:
    """Write a learned tip to a file. Raises OSError."""
    write_file(path, tip.to_bytes())


def read_fast_tip(path: str | Path) -> FastTip:
    """Read a learned tip from a file. Raises TactipError if the file is none, or was altered."""
    about, arrays = unpack(path, FORMAT, VERSION)
    try:
        task, count = about["task"], len(arrays["orders"])
        if task not in TASKS:
            raise ValueError(f"the task must be one of {', '.join(TASKS)}, got {task!r:.40}")
        if about["networks"] < 2:
            raise ValueError(f"it must have at least 2 networks, got {about['networks']}: a single one has no spread")
        known = arrays.get("materials")
        if known is not None and len(known) != len(INPUTS):
            raise ValueError(f"it must know {len(INPUTS)} materials, got {len(known)}: teach it again")
        outputs = [2 * count] * about["networks"] + [len(MEASURES)]
        inputs = COUNT[task] + (0 if known is None else len(INPUTS))
        networks = [network_of(arrays, f"network{k}", inputs, size) for k, size in enumerate(outputs)]
        tip = FastTip(
            task=task,
            mechanics=about["mechanics"],
            modes=Modes(arrays["orders"], arrays["profiles"].astype(float)),
            networks=tuple(networks[:-1]),
            measure_network=networks[-1],
            max_spread_m=float(about["max_spread_m"]),
            provenance=about["provenance"],
            materials=known,
            **{name: arrays[name] for name in _ARRAYS},
        )
        _check_shapes(tip)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise TactipError(f"{path} holds no learned tip: {error}") from error
    return tip


def _check_shapes(tip: FastTip) -> None:
    """Raise ValueError where the arrays of a learned tip do not fit together."""
    known = 0 if tip.materials is None else len(INPUTS)
    inputs, count = COUNT[tip.task] + known, len(tip.modes.orders)
    shapes = {
        "center": (inputs,),
        "scale": (inputs,),
        "coefficient_scale": (2 * count,),
        "measure_center": (len(MEASURES),),
        "measure_scale": (len(MEASURES),),
        "ranges": (12, 2),
    } | ({} if tip.materials is None else {"materials": (len(INPUTS), 2)})
    check_numbers({name: getattr(tip, name) for name in shapes}, shapes)
    tip.modes.check()
