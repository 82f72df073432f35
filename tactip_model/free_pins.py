"""Positions of pins that lie on no known lattice, from the neutral image.

The image alone cannot tell the lens from the layout. Of the lenses between those of the two nominal presets, and a little
beyond, the one is taken that makes the spacing of the pins most even, because designers space pins evenly in plan view. The
outermost pin lies where that of the presets' lattices lies.
"""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.optics import REFERENCE_PX
from tactip_twin.tactip_model.presets import NOMINAL, PINS_EXTENT_M

_LENSES = np.linspace(-0.5, 1.5, 81)
"""Lenses to try: 0 is that of the first nominal preset, 1 that of the second."""

_MIN_PINS = 12
"""Smallest number of pins whose spacing tells something [?]."""

_MAX_SCATTER = 0.15
"""Largest standard deviation of the logarithm of the pins' spacing: 0.02 to 0.06 for hexagons, square arrays, rings and
spirals with pins 0.08 mm off their places, at least 0.23 for 200 sets of random points [M]."""

_MAX_DISTANCE = 2.0
"""Distance from which a spot is not a pin of the pattern, in median spacings [?]."""

_MIN_DISTANCE = 0.5
"""Distance below which one of two spots is not a pin, in median distances from the nearest spot: 0.34 to 0.38 for light at
the rim, at least 0.72 for pins [M]."""


def with_free_pins(design: Design, blobs: np.ndarray) -> tuple[Design, np.ndarray]:
    """Return a design with the lens and the pins of a neutral image, and the blobs (p, 2) that are pins.

    Args:
        design: Design whose other dimensions are kept.
        blobs: (n, 2) px of a 256 px image, white spots.

    Raises:
        TactipError: The spots are too few, or not spaced as pins are.
    """
    if len(blobs) >= _MIN_PINS:
        blobs = _pattern(blobs)
    if len(blobs) < _MIN_PINS:
        raise TactipError(f"the neutral image must show at least {_MIN_PINS} pins, got {len(blobs)}")
    hull = cv2.moments(cv2.convexHull(blobs.astype(np.float32)))
    middle = np.array([hull["m10"], hull["m01"]]) / hull["m00"]
    away = blobs - middle
    radius_px = np.linalg.norm(away, axis=1)
    lenses = [_radial_map(lens, radius_px.max()) for lens in _LENSES]
    places = [away * (_inverse(lens, radius_px) / np.maximum(radius_px, 1e-9))[:, None] for lens in lenses]
    scatters = [float(np.std(np.log(_spacing(p)))) for p in places]
    best = int(np.argmin(scatters))
    if scatters[best] > _MAX_SCATTER:
        raise TactipError(
            f"the neutral image must show pins, but its {len(blobs)} white spots are unevenly spaced: their distances "
            f"differ by {100 * scatters[best]:.0f} % (pins: at most {100 * _MAX_SCATTER:.0f} %)"
        )
    pitch = float(np.clip(np.median(cKDTree(places[best]).query(places[best], 2)[0][:, 1]), 0.5e-3, 10e-3))
    pins = replace(
        design.pins,
        layout="free",
        rings=int(np.clip(PINS_EXTENT_M / pitch, 1, 20)),
        pitch_m=pitch,
        rotation_deg=0.0,
        diameter_m=min(design.pins.diameter_m, pitch),
        rim_diameter_m=min(design.pins.rim_diameter_m, pitch),
        as_built_m=tuple((float(x), float(y)) for x, y in places[best]),
    )
    optics = replace(
        design.optics,
        neutral_radius=tuple(float(c * pitch**power) for c, power in zip(lenses[best], _POWERS, strict=True)),
        centre=tuple(float(c) for c in (middle + 0.5) / REFERENCE_PX),
        camera_offset_m=(0.0, 0.0),
        zoom=1.0,
        drift=(0.0, 0.0),
    )
    return replace(design, pins=pins, optics=optics), blobs


def _pattern(blobs: np.ndarray) -> np.ndarray:
    """Return the blobs (p, 2) of (n, 2) that are neither far from all others, nor light beside a pin: of two that are too
    close, the outer one goes."""
    near = _spacing(blobs)
    blobs = blobs[near < _MAX_DISTANCE * np.median(near)]
    distance, other = cKDTree(blobs).query(blobs, 2)
    away = np.linalg.norm(blobs - np.median(blobs, 0), axis=1)
    close = distance[:, 1] < _MIN_DISTANCE * np.median(distance[:, 1])
    return blobs[~(close & (away >= away[other[:, 1]]))]


_POWERS = np.array([1, 3, 5])


def _radial_map(lens: float, radius_px: float) -> np.ndarray:
    """Return the coefficients (3,) of a lens: px of 256 per first, third and fifth power of the distance from the axis, m.

    Args:
        lens: The lens, between those of the presets.
        radius_px: Radius at which it shows the outermost pins, px of 256.
    """
    maps = [n.optics.neutral_radius / n.pins.pitch_m**_POWERS for n in NOMINAL.values()]
    first, second = (c / (c @ PINS_EXTENT_M**_POWERS) for c in maps)
    return radius_px * ((1 - lens) * first + lens * second)


def _inverse(coefficients: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return the distances (n,) from the axis, m, that a lens shows at radii (n,), px of 256."""
    table = np.linspace(0, PINS_EXTENT_M, 2000)
    return np.interp(radius_px, table[:, None] ** _POWERS @ coefficients, table)


def _spacing(points: np.ndarray) -> np.ndarray:
    """Return the mean distance (n,) of points (n, 2) from their two nearest neighbours."""
    return cKDTree(points).query(points, 3)[0][:, 1:].mean(1)
