"""Fit of a design to the neutral image: the camera's image of the undeformed tip.

Only the design's layout is known beforehand. The blobs give the pattern's middle, size and rotation; then the lens's radial
map, the camera's axis and the rotation are fitted together, and each pin's residual is its offset from the lattice. Pins of
a `free` layout are where the image shows them (free_pins.py).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares, linear_sum_assignment

from tactip_twin.tactip_model.design import MAX_LAYOUT_RADIUS, Design, Optics
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.free_pins import with_free_pins
from tactip_twin.tactip_model.optics import REFERENCE_PX, Lens
from tactip_twin.tactip_model.pin_detection import find_blobs, find_reflections
from tactip_twin.tactip_model.pins import LATTICES, neutral_pins, plan_positions

MIN_PIN_FRACTION = 0.95
"""Smallest fraction of the pins that must be detected."""

MAX_EXTRA = 1.2
"""Largest ratio of the numbers of white spots and of pins: some spots are light."""

_SYMMETRY_DEG = {"hexagonal": 60.0, "circular": 60.0}
"""Rotation under which a layout repeats, degrees. Of the equivalent rotations the one nearest to the design's is used."""


@dataclass(frozen=True)
class NeutralFit:
    """Pins detected in a neutral image, and the design's residuals."""

    pins_px: np.ndarray
    """(p, 2) float: detected position of each pin, px of a 256 px image; NaN where it is not detected."""
    before_px: float
    """Distance between detected pins and those of the design before the fit, rms over pins, px of 256; of
    free pins, those of the first guess."""
    lattice_px: float
    """Distance after fitting lens, camera and rotation, with the pins on the lattice; of free pins, that after the fit."""
    after_px: float
    """Distance after fitting each pin's offset from the lattice too."""


def reference_pixels(points: ArrayLike, width: int) -> np.ndarray:
    """Convert positions (..., 2), px of an image `width` px wide, to px of a 256 px one, both from a pixel's centre."""
    return (np.asarray(points, float) + 0.5) * REFERENCE_PX / width - 0.5


def neutral_px(design: Design) -> np.ndarray:
    """Return the positions (p, 2) of the design's undeformed pins, px of a 256 px image."""
    lens = Lens(design)
    return reference_pixels(lens.project(neutral_pins(design)[0]), lens.width)


def fit_neutral(design: Design, image: np.ndarray) -> tuple[Design, NeutralFit]:
    """Fit a design's optics and pins to a binary neutral image.

    Args:
        design: Design whose layout, number of pins and dimensions are kept; of a `free` layout, the number is the image's.
        image: (h, w) uint8, pins white.

    Returns:
        The fitted design (lens map, centre, camera offset, rotation, pin offsets, zoom 1) and the pins with residuals.

    Raises:
        TactipError: The image is not square, or its blobs are not the design's pins.
    """
    if image.shape[0] != image.shape[1]:
        raise TactipError(f"the neutral image must be square, got {image.shape[1]}×{image.shape[0]} px")
    blobs = reference_pixels(find_blobs(image).centres, image.shape[1])
    if design.pins.layout == "free":
        guess_of_free, seen = with_free_pins(design, blobs)
        fitted = with_pin_offsets(guess_of_free, seen)
        left = _rms(neutral_px(fitted), seen)
        return fitted, NeutralFit(seen, _rms(neutral_px(guess_of_free), seen), left, left)
    count = len(plan_positions(replace(design.pins, as_built_m=())))
    if not MIN_PIN_FRACTION * count <= len(blobs) <= MAX_EXTRA * count:
        raise TactipError(f"the neutral image must show the {count} pins of the design {design.name!r}, got {len(blobs)}")
    before = neutral_px(design)
    lattice = LATTICES[design.pins.layout](design.pins.rings)
    detected = 0
    for scale in _SCALES:
        guess, seen = _mapping(_first_guess(design, lattice, blobs, scale), lattice, blobs)
        known = np.isfinite(seen[:, 0])
        detected = int(known.sum())
        if known.mean() >= MIN_PIN_FRACTION:
            break
    else:
        raise TactipError(
            f"only {detected} of {count} pins of the design {design.name!r} were found in the neutral image: "
            "use an image of this tip without contact"
        )
    # This map treats the pins as flat; with the camera off the axis, the dome's height matters.
    try:
        fitted, on_lattice = fit_pins(_design_of(design, guess), seen)
    except TactipError as error:  # a value that no design has
        raise TactipError(
            f"no lens shows the pins of the design {design.name!r} as in the neutral image ({error}): use an image of this "
            "tip without contact"
        ) from error
    return fitted, NeutralFit(seen, _rms(before, seen), _rms(on_lattice, seen), _rms(neutral_px(fitted), seen))


def fit_pins(design: Design, seen: np.ndarray) -> tuple[Design, np.ndarray]:
    """Refine a design's optics and pins to the detected positions of its undeformed pins.

    Args:
        design: Design whose optics are close and whose zoom is 1.
        seen: Detected positions (p, 2), px of 256; NaN where a pin is not detected.

    Returns:
        The fitted design, and the positions (p, 2), px of 256, its pins would have on the lattice. Of free pins, only the
        positions are refined.
    """
    if design.pins.layout == "free":
        fitted = with_pin_offsets(design, seen)
        return fitted, neutral_px(fitted)
    known, optics, pins = np.isfinite(seen[:, 0]), design.optics, design.pins
    centre, offset = np.array(optics.centre) * REFERENCE_PX, np.array(optics.camera_offset_m) / pins.pitch_m
    guess = np.array([np.radians(pins.rotation_deg), *centre, *optics.neutral_radius, *offset])
    guess = least_squares(lambda p: (neutral_px(_design_of(design, p)) - seen)[known].ravel(), guess, x_scale=_SCALE).x
    fitted = _design_of(design, guess)
    return with_pin_offsets(fitted, seen), neutral_px(fitted)


_SCALES = (1.0, 0.97, 0.94, 0.91, 0.88, 0.85, 1.03)
"""Pattern sizes to try, relative to the size from the blobs' moments, which distant specks of light make too large."""


def _mapping(guess: np.ndarray, lattice: np.ndarray, blobs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the map (8,) from lattice to image, starting from a guess; return it and each pin's blob (p, 2)."""
    seen = np.full_like(lattice, np.nan)
    for _ in range(8):
        seen = _assigned(_mapped(guess, lattice), blobs)
        known = np.isfinite(seen[:, 0])
        found = least_squares(lambda p: (_mapped(p, lattice) - seen)[known].ravel(), guess, x_scale=_SCALE)  # noqa: B023
        if np.allclose(found.x, guess, atol=1e-9):
            break
        guess = found.x
    return guess, seen


_SECTORS = 72
"""Number of directions in which the reflections at the rim are tracked."""


def camera_change(
    neutral: np.ndarray, frames: Iterable[np.ndarray], centre_px: ArrayLike
) -> tuple[np.ndarray, np.ndarray] | None:
    """Estimate the camera's change since the neutral image from the reflections at the rim, which no contact moves.

    Args:
        neutral: The neutral image, binary (h, w) uint8.
        frames: Binary images of the same size.
        centre_px: Image of the camera's axis (2,), px.

    Returns:
        Zoom and drift (design.Optics) as an array (3,), and their standard deviation (3,) over single frames; None if there
        are reflections in less than a third of the directions.
    """
    centre = np.asarray(centre_px, float)
    width = neutral.shape[1]
    before = _rim(neutral, centre)
    bearing = (np.arange(_SECTORS) + 0.5) / _SECTORS * 2 * np.pi - np.pi
    found = []
    for frame in frames:
        now = _rim(frame, centre)
        both = np.isfinite(before) & np.isfinite(now)
        if both.sum() < _SECTORS / 3:
            continue
        slopes = np.stack([before, np.cos(bearing), np.sin(bearing)], 1)[both]
        # Reflections flicker at their ends, so outliers are removed once.
        change = np.linalg.lstsq(slopes, (now - before)[both], rcond=None)[0]
        left = np.abs(slopes @ change - (now - before)[both])
        good = left <= 3 * np.median(left) + 1e-9
        change = np.linalg.lstsq(slopes[good], (now - before)[both][good], rcond=None)[0]
        found.append([1 + change[0], change[1] / width, change[2] / width])
    if len(found) < 3:
        return None
    middle = np.median(found, 0)
    return middle, 1.4826 * np.median(np.abs(np.array(found) - middle), 0)


def _rim(image: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Return the reflections' mean distance from the centre in each direction (_SECTORS,), px; NaN where there are none."""
    y, x = np.nonzero(find_reflections(image))
    sector = ((np.arctan2(y - centre_px[1], x - centre_px[0]) + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    count = np.bincount(sector, minlength=_SECTORS)
    total = np.bincount(sector, np.hypot(x - centre_px[0], y - centre_px[1]), _SECTORS)
    return np.where(count >= 5, total / np.maximum(count, 1), np.nan)


# A guess: rotation (rad), centre x and y (px), c1, c3, c5 of Optics.neutral_radius, camera offset x and y (pitches).
_SCALE = np.array([0.01, 1.0, 1.0, 0.3, 0.03, 0.003, 0.1, 0.1])


def _mapped(guess: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Map the unrotated lattice (p, 2), in pitches, to the image (p, 2), px of 256, by a guess (8,)."""
    c, s = np.cos(guess[0]), np.sin(guess[0])
    off_axis = lattice @ np.array([[c, s], [-s, c]]) - guess[6:]
    u2 = (off_axis**2).sum(1, keepdims=True)
    return guess[1:3] - 0.5 + off_axis * (guess[3] + guess[4] * u2 + guess[5] * u2**2)


def _first_guess(design: Design, lattice: np.ndarray, blobs: np.ndarray, scale: float) -> np.ndarray:
    """Return a guess (8,): centre and size from the blobs' moments, the size times `scale`, and the best rotation.

    Of the equivalent rotations the one nearest to the design's is used.
    """
    middle = np.median(blobs, 0)
    size = scale * np.sqrt(((blobs - middle) ** 2).sum(1).mean() / (lattice**2).sum(1).mean())

    def guess(turn: float) -> np.ndarray:
        # A wide-angle map: spacings are somewhat wider at the rim than in the middle.
        return np.array([turn, *(middle + 0.5), 0.92 * size, 0.13 * size / design.pins.rings**2, 0.0, 0.0, 0.0])

    def misfit(turn: float) -> float:
        mapped = _mapped(guess(turn), lattice)
        return float(np.median(np.linalg.norm(mapped[:, None] - blobs[None], axis=2).min(1)))

    own = design.pins.rotation_deg
    period = _SYMMETRY_DEG[design.pins.layout]
    turns = own + np.arange(0.0, period) - period / 2
    return guess(np.radians(min(turns, key=lambda t: misfit(np.radians(t)))))


def _assigned(mapped: np.ndarray, blobs: np.ndarray) -> np.ndarray:
    """Return the blob (p, 2) of each pin, one to one; NaN where none is near."""
    distance = np.linalg.norm(mapped[:, None] - blobs[None], axis=2)
    gate = 0.5 * np.median(np.sort(np.linalg.norm(mapped[:, None] - mapped[None], axis=2), 1)[:, 1])
    rows, columns = linear_sum_assignment(np.minimum(distance, gate))
    seen = np.full_like(mapped, np.nan)
    near = distance[rows, columns] < gate
    seen[rows[near]] = blobs[columns[near]]
    return seen


def _design_of(design: Design, guess: np.ndarray) -> Design:
    """Return the design with a guess's optics and rotation, and the pins on the lattice."""
    optics = replace(
        design.optics,
        neutral_radius=tuple(float(c) for c in guess[3:6]),
        centre=tuple(float(c) for c in guess[1:3] / REFERENCE_PX),
        camera_offset_m=tuple(float(o) for o in guess[6:] * design.pins.pitch_m),
    )
    optics = _when_neutral(optics)
    turn = float(np.degrees(guess[0]))
    return replace(design, optics=optics, pins=replace(design.pins, rotation_deg=turn, as_built_m=()))


def with_pin_offsets(design: Design, seen: np.ndarray) -> Design:
    """Return the design with each detected pin's root moved to match its position in a neutral image.

    The camera's change since that image (zoom and drift) is ignored.

    Args:
        design: The design.
        seen: Detected positions (p, 2), px of 256; NaN where a pin is not detected.
    """
    offsets = plan_positions(design.pins) if design.pins.layout == "free" else np.zeros_like(seen)
    known = np.isfinite(seen[:, 0])
    tiny, then = 1e-6, replace(design, optics=_when_neutral(design.optics))
    for _ in range(5):
        here = neutral_px(_moved(then, offsets))
        slopes = [(neutral_px(_moved(then, offsets + tiny * axis)) - here) / tiny for axis in np.eye(2)]
        jacobian = np.stack(slopes, -1)
        offsets[known] += np.linalg.solve(jacobian[known], (seen - here)[known][..., None])[..., 0]
    return _moved(design, offsets)


def widest_spacing(design: Design) -> float:
    """Return the factor by which a design's pins can be farther apart within its dome."""
    pins, limit = design.pins, MAX_LAYOUT_RADIUS * design.shape.radius_m
    extent = pins.rings * pins.pitch_m
    if pins.layout == "free":
        extent = float(np.linalg.norm(pins.as_built_m, axis=1).max())
    return limit / extent


def with_spacing(design: Design, factor: float) -> Design:
    """Return the design with pins `factor` times as far apart, and with the lens that shows them at the same places in the
    neutral image. Raises TactipError if they would lie outside the dome."""
    pins, optics = design.pins, design.optics
    wider = replace(
        pins,
        pitch_m=factor * pins.pitch_m,
        diameter_m=factor * pins.diameter_m,
        rim_diameter_m=factor * pins.rim_diameter_m,
        as_built_m=tuple((factor * x, factor * y) for x, y in pins.as_built_m),
    )
    moved = replace(optics, camera_offset_m=tuple(factor * x for x in optics.camera_offset_m))
    seen = neutral_px(replace(design, optics=_when_neutral(optics)))
    return with_pin_offsets(replace(design, pins=wider, optics=moved), seen)


def _when_neutral(optics: Optics) -> Optics:
    """Return the optics as they were when the neutral image was taken."""
    return replace(optics, zoom=1.0, drift=(0.0, 0.0))


def _moved(design: Design, offsets: np.ndarray) -> Design:
    """Return the design with pin offsets (p, 2), m."""
    return replace(design, pins=replace(design.pins, as_built_m=tuple((float(x), float(y)) for x, y in offsets)))


def _rms(positions: np.ndarray, seen: np.ndarray) -> float:
    """Return the rms distance, px, of detected positions (p, 2) from the nearest of other positions (p, 2)."""
    known = np.isfinite(seen[:, 0])
    distance = np.linalg.norm(seen[known][:, None] - positions[None], axis=2).min(1)
    return float(np.sqrt((distance**2).mean()))
