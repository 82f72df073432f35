"""The nominal design of a sensor whose neutral image is all that is known: a lattice that the image shows, or free pins."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tactip_twin.tactip_model.design import Design, Pins
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import MAX_EXTRA, MIN_PIN_FRACTION, NeutralFit, fit_neutral
from tactip_twin.tactip_model.pin_detection import MIN_AREA_PX, count_small_spots, find_blobs
from tactip_twin.tactip_model.pins import LATTICES
from tactip_twin.tactip_model.presets import NOMINAL, PINS_EXTENT_M, nearest_nominal

_MAX_OFF_LATTICE = 0.15
"""Largest rms distance of the pins from a lattice that they are on, in their median spacing: 0.04 and 0.05 on two real tips,
up to 0.09 on simulated ones with pins 0.08 mm off it, 0.21 on rings at other angles than the lattice's [M]."""

_MAX_SMALL = 0.05
"""Largest ratio of the numbers of spots that are too small and of pins, where no lattice tells the number of pins [?]."""

_DIAMETER = 0.3
"""Diameter of pins that are not known yet, in pitches: that of the calibrated 127-pin tip [M]. Trainings correct it by the
white area of the neutral image."""


def sensor_of(image: np.ndarray) -> Design:
    """Return the nominal design of the sensor that made a neutral image.

    Args:
        image: (h, w) uint8, binary, pins white.

    Returns:
        A design whose pins lie on the lattice that explains the image; without one, their layout is `free`. Its other
        dimensions are those of the nominal preset with the most similar number of pins.

    Raises:
        TactipError: The image is not square, does not show pins, or shows some of them too small.
    """
    count = len(find_blobs(image).centres)
    for nominal, _, fit in _fits(image, count):
        if off_lattice(fit) < _MAX_OFF_LATTICE:
            return nominal
    small = count_small_spots(image)
    if small > _MAX_SMALL * count:
        raise TactipError(
            f"the neutral image shows {count} pins, and {small} white spots of less than {MIN_AREA_PX} px, which may be "
            "pins, too: use larger frames, or another --threshold"
        )
    design, _ = fit_neutral(free_sensor(count), image)
    return replace(design, name=f"free-{len(design.pins.as_built_m)}")


def fit_lattice(image: np.ndarray, count: float) -> tuple[Design, NeutralFit] | None:
    """Return the fit of the lattice of about `count` pins that explains a binary image (h, w) uint8 best; None if there is
    none. The first that explains it well is taken."""
    best: tuple[Design, NeutralFit] | None = None
    for _, design, fit in _fits(image, count):
        if best is None or fit.lattice_px < best[1].lattice_px:
            best = design, fit
        if off_lattice(fit) < _MAX_OFF_LATTICE:
            break
    return best


def _fits(image: np.ndarray, count: float) -> Iterator[tuple[Design, Design, NeutralFit]]:
    """Yield nominal design and fit of each lattice of about `count` pins that a binary image (h, w) uint8 can show."""
    for nominal in lattices_of(count):
        try:
            design, fit = fit_neutral(nominal, image)
        except TactipError:  # not on this lattice
            continue
        yield nominal, design, fit


def free_sensor(count: float) -> Design:
    """Return a nominal design with free pins, whose positions a fit takes from an image, for about `count` pins."""
    nominal = NOMINAL[nearest_nominal(count)]
    pins = replace(nominal.pins, layout="free", as_built_m=((0.0, 0.0),))
    return replace(nominal, name="free", pins=pins)


def lattices_of(count: float) -> Iterator[Design]:
    """Yield the nominal designs with lattices of about `count` pins, presets first."""
    others: list[Design] = []
    for rings in range(2, 21):
        size = len(LATTICES["hexagonal"](rings))
        if not MIN_PIN_FRACTION * size <= count <= MAX_EXTRA * size:
            continue
        for layout in LATTICES:
            presets = [n for n in NOMINAL.values() if (n.pins.layout, n.pins.rings) == (layout, rings)]
            yield from presets
            if not presets:
                pins = Pins(layout, rings, PINS_EXTENT_M / rings)
                others.append(with_pins(NOMINAL[nearest_nominal(size)], pins, f"{layout}-{size}"))
    yield from others


def with_pins(design: Design, pins: Pins, name: str) -> Design:
    """Return a design with other pins, of the pitch, layout and offsets of `pins`; lens and lengths of pins are kept."""
    ratio = pins.pitch_m / design.pins.pitch_m
    c1, c3, c5 = design.optics.neutral_radius
    sized = replace(
        pins,
        length_m=design.pins.length_m,
        diameter_m=_DIAMETER * pins.pitch_m,
        rim_diameter_m=_DIAMETER * pins.pitch_m,
    )
    optics = replace(design.optics, neutral_radius=(c1 * ratio, c3 * ratio**3, c5 * ratio**5))
    return replace(design, name=name, pins=sized, optics=optics)


def off_lattice(fit: NeutralFit) -> float:
    """Return the rms distance of the pins of a fit from their lattice, in their median spacing, -."""
    seen = fit.pins_px[np.isfinite(fit.pins_px[:, 0])]
    spacing = np.sort(np.linalg.norm(seen[:, None] - seen[None], axis=2), 1)[:, 1]
    return float(fit.lattice_px / np.median(spacing))
