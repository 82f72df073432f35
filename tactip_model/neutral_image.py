"""The neutral image: an undeformed tip as its camera sees it. It tells lens, camera pose and pin layout.

Nothing of it is known before but the design's layout: where the image's middle is, how large the pattern is and how it is
turned are found from the blobs. Then the lens's radial map, the camera's axis and the turn are fitted together, and what
is left, pin by pin, is how the tip was built.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.optics import REFERENCE_PX, Lens
from tactip_twin.tactip_model.pin_detection import find_blobs, find_reflections
from tactip_twin.tactip_model.pins import LAYOUTS, neutral_pins, plan_positions

_FEWEST = 0.95
"""Share of the pins that must be seen."""

_ALIKE_DEG = {"hexagonal": 60.0, "circular": 60.0}
"""Turn by which a layout looks the same, degrees: of those, the one nearest to the design's is taken."""


@dataclass(frozen=True)
class NeutralFit:
    """What a neutral image says of a design."""

    pins_px: np.ndarray
    """(p, 2) float: where each pin is seen, px of a 256 px image; NaN where it is not."""
    before_px: float
    """Distance (rms over pins, px of 256) of the pins seen from those of the design as it came."""
    lattice_px: float
    """The same after fitting lens, camera and turn, with pins on the lattice."""
    after_px: float
    """The same with each pin where it was built."""


def reference_pixels(points, width):
    """Positions (..., 2), px of an image `width` px wide, in px of a 256 px one; centres of top left pixels are (0, 0)."""
    return (np.asarray(points, float) + 0.5) * REFERENCE_PX / width - 0.5


def neutral_px(design):
    """Where the design's undeformed pins appear, (p, 2) px of a 256 px image."""
    lens = Lens(design)
    return reference_pixels(lens.project(neutral_pins(design)[0]), lens.width)


def fit_neutral(design, image):
    """Fit a design's optics and pins to a binary neutral image.

    design: Design, of which layout, number of pins and dimensions are taken as they are. image: (h, w) uint8, white pins.
    Returns the fitted Design (lens map, centre, camera offset, turn, as-built pins, zoom 1) and a NeutralFit.
    Raises TactipError where the blobs are not the design's pins.
    """
    if image.shape[0] != image.shape[1]:
        raise TactipError(f"a neutral image of {image.shape[1]} by {image.shape[0]} px does not do: it must be square")
    blobs = reference_pixels(find_blobs(image).centres, image.shape[1])
    count = len(plan_positions(replace(design.pins, as_built_m=())))
    if not _FEWEST * count <= len(blobs) <= 1.2 * count:
        raise TactipError(f"the neutral image shows {len(blobs)} pins: the design {design.name!r} has {count}")
    before = neutral_px(design)
    lattice = LAYOUTS[design.pins.layout](design.pins.rings)
    for share in _SIZES:
        guess, seen = _mapping(_first_guess(design, lattice, blobs, share), lattice, blobs)
        known = np.isfinite(seen[:, 0])
        if known.mean() >= _FEWEST:
            break
    else:
        raise TactipError(
            f"only {known.sum()} of {count} pins of the design {design.name!r} are found in the neutral image: is it of "
            "another tip, or pressed?"
        )
    # That map takes the pins for flat; with the camera off the axis, the dome's height enters.
    fitted, on_lattice = fit_pins(_design_of(design, guess), seen)
    return fitted, NeutralFit(seen, _rms(before, seen), _rms(on_lattice, seen), _rms(neutral_px(fitted), seen))


def fit_pins(design, seen):
    """Fit a design's optics and pins to where its pins are seen, from near by.

    design: Design, whose optics are near and whose zoom is 1. seen: (p, 2) px of 256, at rest; NaN where not seen.
    Returns the fitted Design, and where its pins would be on the lattice, (p, 2) px of 256.
    """
    known, optics, pins = np.isfinite(seen[:, 0]), design.optics, design.pins
    centre, offset = np.array(optics.centre) * REFERENCE_PX, np.array(optics.camera_offset_m) / pins.pitch_m
    guess = np.array([np.radians(pins.rotation_deg), *centre, *optics.neutral_radius, *offset])
    guess = least_squares(lambda p: (neutral_px(_design_of(design, p)) - seen)[known].ravel(), guess, x_scale=_SCALE).x
    fitted = _design_of(design, guess)
    return as_built(fitted, seen), neutral_px(fitted)


_SIZES = (1.0, 0.97, 0.94, 0.91, 0.88, 0.85, 1.03)
"""Sizes of the pattern that are tried, over that by the blobs' moments: specks of light far out make these too large."""


def _mapping(guess, lattice, blobs):
    """The map (8,) from lattice to image that a guess leads to, and where each pin is then seen (p, 2)."""
    for _ in range(8):
        seen = _assigned(_mapped(guess, lattice), blobs)
        known = np.isfinite(seen[:, 0])
        found = least_squares(lambda p: (_mapped(p, lattice) - seen)[known].ravel(), guess, x_scale=_SCALE)  # noqa: B023
        if np.allclose(found.x, guess, atol=1e-9):
            break
        guess = found.x
    return guess, seen


_SECTORS = 72
"""Directions in which the reflections at the rim are followed."""


def camera_change(neutral, frames, centre_px):
    """How the camera has changed since the neutral image, by the reflections at the rim, that no contact moves.

    neutral: (h, w) uint8. frames: iterable of the same. centre_px: (2,), image of the camera's axis, px. Returns zoom and
    drift (design.Optics) as an array (3,), and the standard deviation (3,) of one frame's; None where there is too little
    light at the rim (a third of its directions).
    """
    width = neutral.shape[1]
    before = _rim(neutral, centre_px)
    bearing = (np.arange(_SECTORS) + 0.5) / _SECTORS * 2 * np.pi - np.pi
    found = []
    for frame in frames:
        now = _rim(frame, centre_px)
        both = np.isfinite(before) & np.isfinite(now)
        if both.sum() < _SECTORS / 3:
            continue
        slopes = np.stack([before, np.cos(bearing), np.sin(bearing)], 1)[both]
        # Reflections flicker at their ends: what is far off is left out, once.
        change = np.linalg.lstsq(slopes, (now - before)[both], rcond=None)[0]
        left = np.abs(slopes @ change - (now - before)[both])
        good = left <= 3 * np.median(left) + 1e-9
        change = np.linalg.lstsq(slopes[good], (now - before)[both][good], rcond=None)[0]
        found.append([1 + change[0], change[1] / width, change[2] / width])
    if len(found) < 3:
        return None
    middle = np.median(found, 0)
    return middle, 1.4826 * np.median(np.abs(np.array(found) - middle), 0)


def _rim(image, centre_px):
    """Mean distance (_SECTORS,) px from the centre of the reflections in each direction; NaN where there are none."""
    y, x = np.nonzero(find_reflections(image))
    sector = ((np.arctan2(y - centre_px[1], x - centre_px[0]) + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    count = np.bincount(sector, minlength=_SECTORS)
    total = np.bincount(sector, np.hypot(x - centre_px[0], y - centre_px[1]), _SECTORS)
    return np.where(count >= 5, total / np.maximum(count, 1), np.nan)


# A guess: turn (rad), centre x and y (px), c1, c3, c5 of Optics.neutral_radius, camera offset x and y (pitches).
_SCALE = np.array([0.01, 1.0, 1.0, 0.3, 0.03, 0.003, 0.1, 0.1])


def _mapped(guess, lattice):
    """Where a guess (8,) puts pins of the unturned lattice (p, 2), in pitches: (p, 2) px of 256."""
    c, s = np.cos(guess[0]), np.sin(guess[0])
    off_axis = lattice @ np.array([[c, s], [-s, c]]) - guess[6:]
    u2 = (off_axis**2).sum(1, keepdims=True)
    return guess[1:3] - 0.5 + off_axis * (guess[3] + guess[4] * u2 + guess[5] * u2**2)


def _first_guess(design, lattice, blobs, share):
    """Centre and size by the blobs' moments, the size times a share, turn by trying them; the design's own turn among those
    that look alike."""
    middle = np.median(blobs, 0)
    size = share * np.sqrt(((blobs - middle) ** 2).sum(1).mean() / (lattice**2).sum(1).mean())

    def guess(turn):
        # A wide-angle map: at the rim, spacings are somewhat wider than in the middle.
        return np.array([turn, *(middle + 0.5), 0.92 * size, 0.13 * size / design.pins.rings**2, 0.0, 0.0, 0.0])

    def misfit(turn):
        mapped = _mapped(guess(turn), lattice)
        return np.median(np.linalg.norm(mapped[:, None] - blobs[None], axis=2).min(1))

    own = design.pins.rotation_deg
    alike = _ALIKE_DEG[design.pins.layout]
    turns = own + np.arange(0.0, alike) - alike / 2
    return guess(np.radians(min(turns, key=lambda t: misfit(np.radians(t)))))


def _assigned(mapped, blobs):
    """The blob (p, 2) of each pin, one to one; NaN where none is near."""
    distance = np.linalg.norm(mapped[:, None] - blobs[None], axis=2)
    gate = 0.5 * np.median(np.sort(np.linalg.norm(mapped[:, None] - mapped[None], axis=2), 1)[:, 1])
    rows, columns = linear_sum_assignment(np.minimum(distance, gate))
    seen = np.full_like(mapped, np.nan)
    near = distance[rows, columns] < gate
    seen[rows[near]] = blobs[columns[near]]
    return seen


def _design_of(design, guess):
    """The Design with a guess's optics and turn, pins on the lattice."""
    optics = replace(
        design.optics,
        neutral_radius=tuple(float(c) for c in guess[3:6]),
        centre=tuple(float(c) for c in guess[1:3] / REFERENCE_PX),
        camera_offset_m=tuple(float(o) for o in guess[6:] * design.pins.pitch_m),
    )
    optics = _when_neutral(optics)
    turn = float(np.degrees(guess[0]))
    return replace(design, optics=optics, pins=replace(design.pins, rotation_deg=turn, as_built_m=()))


def as_built(design, seen):
    """The Design with each pin's root moved so that it appears where it is seen in a neutral image, if it is.

    seen: (p, 2) px of 256. What has changed since that image was taken, zoom and centre, is left out of it.
    """
    offsets = np.zeros_like(seen)
    known = np.isfinite(seen[:, 0])
    tiny, then = 1e-6, replace(design, optics=_when_neutral(design.optics))
    for _ in range(5):
        here = neutral_px(_moved(then, offsets))
        slopes = [(neutral_px(_moved(then, offsets + tiny * axis)) - here) / tiny for axis in np.eye(2)]
        jacobian = np.stack(slopes, -1)
        offsets[known] += np.linalg.solve(jacobian[known], (seen - here)[known][..., None])[..., 0]
    return _moved(design, offsets)


def _when_neutral(optics):
    return replace(optics, zoom=1.0, drift=(0.0, 0.0))


def _moved(design, offsets):
    return replace(design, pins=replace(design.pins, as_built_m=tuple((float(x), float(y)) for x, y in offsets)))


def _rms(mine, seen):
    """Root mean square distance of positions (p, 2) from those seen (p, 2), each its nearest: px."""
    known = np.isfinite(seen[:, 0])
    distance = np.linalg.norm(seen[known][:, None] - mine[None], axis=2).min(1)
    return float(np.sqrt((distance**2).mean()))
