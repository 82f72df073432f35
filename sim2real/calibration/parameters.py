"""The parameters of a calibration: quantities of a sensor and its rig that frames determine."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from tactip_twin.sim2real.calibration.rig import Rig
from tactip_twin.tactip_model.design import MAX_LAYOUT_RADIUS, Design, Materials, Optics, Pins


@dataclass(frozen=True)
class SensorOnRig:
    """A sensor on a rig."""

    design: Design
    """The sensor."""
    rig: Rig
    """Rig that took its frames."""


@dataclass(frozen=True)
class Parameter:
    """A fitted quantity."""

    name: str
    """Name in reports and in the state of a run."""
    unit: str
    """Unit of its value: m, Pa, deg, widths (of the image), or - if dimensionless."""
    low: float
    """Minimum, in its unit."""
    high: float
    """Maximum, in its unit."""
    step: float
    """Step of the finite differences; of the value's logarithm if `logarithmic`."""
    prior: tuple[float, float] | None
    """Mean and standard deviation before any frame is used (the latter of the logarithm if `logarithmic`), or None."""
    part: Literal["rig", "optics", "pins", "materials"]
    """Part of the SensorOnRig that it belongs to."""
    attribute: str
    """Field of that part."""
    item: int | None = None
    """Index in the field, if it is a tuple."""
    logarithmic: bool = False
    """Whether step and prior apply to the value's logarithm, for quantities known to within a factor."""
    mechanical: bool = True
    """Whether contacts must be simulated again when it changes."""
    searched: bool = False
    """Whether it is found by search: where skin changes between sticking and slipping, a frame's fraction jumps, so
    gradients mislead."""

    def read(self, twin: SensorOnRig) -> float:
        """Return its value in a SensorOnRig."""
        value = getattr(self._part_of(twin), self.attribute)
        return float(value if self.item is None else value[self.item])

    def write(self, twin: SensorOnRig, value: float) -> SensorOnRig:
        """Return the SensorOnRig with this value, clipped to the bounds."""
        written: Any = float(np.clip(value, self.low, self.high))
        if self.item is not None:
            whole = list(getattr(self._part_of(twin), self.attribute))
            whole[self.item] = written
            written = tuple(whole)
        part = replace(self._part_of(twin), **{self.attribute: written})
        if self.part == "rig":
            return replace(twin, rig=part)
        return replace(twin, design=replace(twin.design, **{self.part: part}))

    def moved(self, twin: SensorOnRig, amount: float) -> SensorOnRig:
        """Return the SensorOnRig with this parameter moved by `amount` of its steps."""
        value = self.read(twin)
        return self.write(twin, value * np.exp(amount * self.step) if self.logarithmic else value + amount * self.step)

    def prior_residual(self, twin: SensorOnRig) -> float:
        """Return how far the value is from its prior, in standard deviations; 0 without a prior."""
        if self.prior is None:
            return 0.0
        value, (mean, deviation) = self.read(twin), self.prior
        return (np.log(value / mean) if self.logarithmic else value - mean) / deviation

    def _part_of(self, twin: SensorOnRig) -> Rig | Optics | Pins | Materials:
        return twin.rig if self.part == "rig" else getattr(twin.design, self.part)


_FREE_MARGIN = 0.99
"""Largest distance of free pins from the axis, in the largest that a design may have: a new fit moves them a little."""

UNKNOWN_CAMERA = np.array([1.0, 0.0, 0.0]), np.array([0.01, 0.004, 0.004])
"""Zoom and drift (3,), and their standard deviations (3,), if reflections do not show them."""


def parameters(design: Design, camera: tuple[np.ndarray, np.ndarray] = UNKNOWN_CAMERA) -> tuple[Parameter, ...]:
    """Return the parameters that pressed frames determine.

    Args:
        design: Design to start from.
        camera: Prior of zoom and drift: mean and standard deviation, (3,) each.
    """
    # Lag and friction can explain the same frames, so frames alone hardly determine the three friction parameters.
    # Their priors come from a load cell (0.55 to 0.7) and from the mean shifts under 25 shears of a real tip, which a
    # kinetic fraction of 0.5 to 0.6 after 1 mm fits best (benchmarks/learning/real_comparison.py).
    searched = partial(Parameter, logarithmic=True, searched=True)
    zoom, x, y = zip(*camera, strict=True)
    pitch = design.pins.pitch_m
    widest = MAX_LAYOUT_RADIUS * design.shape.radius_m / design.pins.rings
    if design.pins.layout == "free":
        outermost = np.linalg.norm(design.pins.as_built_m, axis=1).max()
        widest = float(_FREE_MARGIN * pitch * MAX_LAYOUT_RADIUS * design.shape.radius_m / outermost)
    return (
        Parameter("azimuth", "deg", -360, 360, 2.0, None, "rig", "azimuth_deg"),
        Parameter("depth_zero", "m", -2e-3, 2e-3, 0.1e-3, (0.0, 0.5e-3), "rig", "depth_zero_m"),
        Parameter("tcp_behind_apex", "m", -0.06, 0.06, 1.5e-3, (0.0, 20e-3), "rig", "tcp_behind_apex_m"),
        Parameter("tilt_zero_x", "deg", -5, 5, 0.8, (0.0, 2.0), "rig", "tilt_zero_deg", 0),
        Parameter("tilt_zero_y", "deg", -5, 5, 0.8, (0.0, 2.0), "rig", "tilt_zero_deg", 1),
        searched("friction", "-", 0.1, 1.0, 0.15, (0.6, 0.1), "materials", "friction"),
        searched("kinetic_fraction", "-", 0.2, 1.0, 0.15, (0.55, 0.15), "materials", "kinetic_fraction"),
        searched("slip_weakening", "m", 0.3e-3, 10e-3, 0.25, (1e-3, 0.3), "materials", "slip_weakening_m"),
        Parameter("skin_young", "Pa", 1e5, 5e6, 0.25, (0.6e6, 0.4), "materials", "skin_young_pa", logarithmic=True),
        Parameter("gel_young", "Pa", 3e3, 2e5, 0.25, (2e4, 0.4), "materials", "gel_young_pa", logarithmic=True),
        Parameter("pin_length", "m", 0.8e-3, 4e-3, 0.1e-3, (2e-3, 0.5e-3), "pins", "length_m", mechanical=False),
        Parameter(
            "pitch", "m", 0.7 * pitch, widest, 0.02, (pitch, 0.05), "pins", "pitch_m", logarithmic=True, mechanical=False
        ),
        Parameter("camera_height", "m", 2e-3, 40e-3, 0.5e-3, (8e-3, 4e-3), "optics", "camera_height_m", mechanical=False),
        Parameter("zoom", "-", 0.95, 1.05, 0.001, zoom, "optics", "zoom", mechanical=False),
        Parameter("drift_x", "widths", -0.02, 0.02, 0.001, x, "optics", "drift", 0, mechanical=False),
        Parameter("drift_y", "widths", -0.02, 0.02, 0.001, y, "optics", "drift", 1, mechanical=False),
    )
