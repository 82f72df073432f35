"""A neutral image for a set that has none, from its pressed frames.

A learned tip (sim/fast_tip/) says how far each pin has moved in each frame, given the pose and shear in the table. The
median of the frames that have moved least, or the one that has moved least, shows which blob is which pin. What the
predicted motion leaves of the pins' positions, in the median of more such frames, is their place at rest. The mechanics are
nominal at first, so some of the press remains: least where pins have moved little, and tilts and shears average out. From
these places, pitch and materials are estimated, and how much of the table's depth the frames show; with them, the motion is
predicted again.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import theilslopes

from tactip_twin.sim.fast_tip.fast_tip import PinDecoder, any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.column_map import Task
from tactip_twin.sim2real.importing.estimated_contacts import FRAMES, contact_model, detected_pins
from tactip_twin.sim2real.importing.frame_blobs import blobs_of
from tactip_twin.sim2real.importing.source import Source
from tactip_twin.sim2real.sensor.preprocess import FrameReader
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import fit_neutral, fit_pins, neutral_px, reference_pixels
from tactip_twin.tactip_model.optics import REFERENCE_PX, Lens
from tactip_twin.tactip_model.pin_detection import PinMatcher, find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import NOMINAL, nearest_nominal
from tactip_twin.tactip_model.sensor_of_image import fit_lattice, free_sensor

_MAX_CONSIDERED = 2000
"""Largest number of frames whose motion is predicted, evenly spaced in the table: more would take memory for nothing."""

_LAYOUT_FRACTION, _LAYOUT_FRAMES = 0.05, (5, 21)
"""Fraction of the frames, those that have moved least, whose median shows the layout, and its least and largest number."""

_MIN_MEDIAN_PIN_FRACTION = 0.97
"""Fraction of the usual number of pins below which that median is too blurred; the frame that has moved least then takes its
place. An estimate [?]."""

_PRESSED_FRACTION, _PRESSED_FRAMES = 0.1, (40, 100)
"""Fraction of the frames, those that have moved least, whose press is removed, and its least and largest number. On a hidden
331-pin tip the pins' errors were 0.11, 0.16 and 0.33 px of 256 for the shallowest tenth, third and all of 400 frames [M]."""

_ROUNDS = 3
"""Number of times that the press is predicted for the pins found so far. On the sets tried, the third changed the pins'
error by at most 0.05 px of 256 [M]."""

_MECHANICS_FRAMES = 60
"""Number of frames that pitch and materials are estimated from, once: with a second estimate, the pins' error fell from 0.32
to 0.22 px of 256 on a hidden tip, and rose from 0.28 to 0.43 on a real one [M]."""

_MIN_DEPTH_RANGE_MM, _GAINS = 1.0, (0.6, 1.4)
"""Least range of the depths in the table that shows how much of them the frames show, and range of that part [?]."""

_GAIN_ERROR = 0.05
"""Error of that part: on two hidden tips, where it is 1, it was 0.97 and 1.03; on the two real ones 0.88 and 0.94 [M]."""

_MIN_DETECTED = 0.9
"""Fraction of the pins that must be detected in a frame."""


class _Mechanics(NamedTuple):
    """How the pins of a tip move."""

    materials: np.ndarray | None = None
    """(6,) inputs of FastTip.coefficients; None for those of the design."""
    depth_gain: float = 1.0
    """Depth that the frames show, in parts of the depth in the table."""


def neutral_from_frames(
    source: Source, kept: np.ndarray, reader: FrameReader, usual: float, task: Task, estimates_mechanics: bool
) -> tuple[np.ndarray, dict[str, Any]]:
    """Return a replacement for the neutral image of a Source, binary, (h, w) uint8, and figures of the frames that it is
    made of; `press_removed` says whether it shows the tip at rest.

    Args:
        source: The set.
        kept: (n,) int, rows to keep.
        reader: Reader of its frames.
        usual: Median number of pins.
        task: Task of the set.
        estimates_mechanics: Whether to estimate pitch and materials for it, too, which takes about a minute.
    """
    nominal = NOMINAL[nearest_nominal(usual)]
    kept = kept[np.linspace(0, len(kept) - 1, min(len(kept), _MAX_CONSIDERED)).astype(int)]
    moved = _motion_px(nominal, task, source.poses[kept], source.shears[kept], _Mechanics())
    motion = np.linalg.norm(moved, axis=-1).mean(1)
    order = kept[np.argsort(motion, kind="stable")]
    stand_in, rows = _layout_image(source, order[: _count(len(kept), _LAYOUT_FRACTION, _LAYOUT_FRAMES)], reader, usual)
    pressed = order[: _count(len(kept), _PRESSED_FRACTION, _PRESSED_FRAMES)]
    layout = reader.cropped(stand_in), source.poses[rows], source.shears[rows]
    rest = _at_rest(source, kept, pressed, reader, layout, usual, task, estimates_mechanics)
    if rest is not None:
        image, rows = rest
        stand_in = reader.uncropped(image, stand_in.shape)
    depths = source.poses[rows, 2]
    ends = [round(float(depth), 6) for depth in (depths.max(), depths.min())]
    return stand_in, {"frames": len(rows), "pose_z": ends, "press_removed": rest is not None}


def _count(frames: int, fraction: float, ends: tuple[int, int]) -> int:
    """Return a fraction of a number of frames, within ends."""
    return int(np.clip(round(fraction * frames), *ends))


def _layout_image(source: Source, rows: np.ndarray, reader: FrameReader, usual: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the median of frames, binary, (h, w) uint8, or the first where the median is blurred, and the rows used."""
    frames = [reader.masked(source.load(i)) for i in rows]
    # The median: a pin is where it is in the half of the frames that do not press it.
    image = np.where(np.mean([frame > 127 for frame in frames], 0) > 0.5, 255, 0).astype(np.uint8)
    if len(find_blobs(image).centres) < _MIN_MEDIAN_PIN_FRACTION * usual:
        return frames[0], rows[:1]
    return image, rows


def _at_rest(
    source: Source,
    kept: np.ndarray,
    rows: np.ndarray,
    reader: FrameReader,
    layout: tuple[np.ndarray, np.ndarray, np.ndarray],
    usual: float,
    task: Task,
    estimates_mechanics: bool,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a cropped binary image (h, w) uint8 of the pins at rest, and the rows of the frames that it is made of; None if
    no pins are seen, or the table does not explain how they move.

    Args:
        source: The set.
        kept: (m,) int, frames of all depths.
        rows: (n,) int, frames whose pins are used.
        reader: Reader of its frames.
        layout: Cropped binary image (h, w) that shows which blob is which pin, and the poses and shears (k, 6), mm and
            degrees, of the frames that it is made of.
        usual: Median number of pins.
        task: Task of the set.
        estimates_mechanics: Whether to estimate pitch and materials.
    """
    image, poses, shears = layout
    width = image.shape[1]
    try:
        design, fit = fit_lattice(image, usual) or fit_neutral(free_sensor(usual), image)
    except TactipError:  # whoever needs the pins says so
        return None
    known = np.isfinite(fit.pins_px[:, 0])
    matcher = PinMatcher(_pixels(fit.pins_px[known], width))
    pins = np.full((len(rows), len(known), 2), np.nan)
    for k, i in enumerate(rows):
        found = matcher.match(find_blobs(reader.cropped(reader.masked(source.load(i)))))
        pins[k, known] = reference_pixels(found, width)
    good = np.isfinite(pins[:, known, 0]).mean(1) > _MIN_DETECTED
    rows, pins = rows[good], pins[good]
    if len(rows) < _LAYOUT_FRAMES[0]:
        return None
    moved, rest, mechanics = pins, fit.pins_px.copy(), _Mechanics()
    for again in range(2 if estimates_mechanics else 1):
        if again:
            design, mechanics = _mechanics(source, kept, reader, design, task)
        for _ in range(_ROUNDS):
            moved = pins - _motion_px(design, task, source.poses[rows], source.shears[rows], mechanics)
            rest[known] = np.nanmedian(moved[:, known], 0)
            try:
                design, _ = fit_pins(design, rest)
            except TactipError:  # no tip has these pins, so the table does not explain how they have moved
                return None
    if _scatter(moved[:, known]) >= _scatter(pins[:, known]):
        return None
    # A pin that is pressed towards the camera looks larger.
    pressed = _distances(design, _tips(design, task, poses, shears, mechanics)).mean(0)
    nearer = pressed / _distances(design, neutral_pins(design)[0])
    return _drawn(_pixels(rest[known], width), image, _pixels(fit.pins_px[known], width), nearer[known]), rows


def _mechanics(
    source: Source, kept: np.ndarray, reader: FrameReader, design: Design, task: Task
) -> tuple[Design, _Mechanics]:
    """Return a design with the pitch that the frames of a set show, and their mechanics; both as they were if too few frames
    show their pins.

    Args:
        source: The set.
        kept: (m,) int, its frames.
        reader: Reader of its frames.
        design: The design, fitted to the pins at rest as far as they are known.
        task: Task of the set.
    """
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(kept, min(len(kept), FRAMES), replace=False))
    blobs = [blobs_of(reader.cropped(reader.masked(source.load(i)))) for i in rows]
    try:
        pins, good = detected_pins(blobs, neutral_px(design))
    except TactipError:
        return design, _Mechanics()
    which = rng.permutation(int(good.sum()))[:_MECHANICS_FRAMES]
    pins, depths = pins[good][which], source.poses[rows[good][which], 2]
    model = contact_model(design, pins, task, rng)
    gain = 1.0
    if np.ptp(depths) > _MIN_DEPTH_RANGE_MM:
        gain = float(np.clip(np.asarray(theilslopes(model.contacts[:, 2], depths))[0], *_GAINS))
    return model.design, _Mechanics(model.materials, 1.0 if abs(gain - 1) < _GAIN_ERROR else gain)


def _tips(design: Design, task: Task, poses: np.ndarray, shears: np.ndarray, mechanics: _Mechanics) -> np.ndarray:
    """Return the predicted pin tips (n, p, 3), m, sensor frame, at poses and shears (n, 6), mm and degrees, of a table."""
    tip = read_fast_tip(any_materials(task))
    materials = material_inputs(design.materials) if mechanics.materials is None else mechanics.materials
    if tip.materials is not None:
        materials = np.clip(materials, *tip.materials.T)
    shown = np.where(np.arange(6) == 2, mechanics.depth_gain, 1.0) * poses
    coefficients, _ = tip.coefficients(from_mm_deg(shown), from_mm_deg(shears), materials)
    tips = PinDecoder(design, tip.modes).tips(coefficients)
    return np.where(poses[:, 2, None, None] < 0, tips, neutral_pins(design)[0])  # without contact nothing moves


def _motion_px(design: Design, task: Task, poses: np.ndarray, shears: np.ndarray, mechanics: _Mechanics) -> np.ndarray:
    """Return how far the pins have moved from rest, (n, p, 2), px of 256, at poses and shears (n, 6), mm and degrees."""
    lens = Lens(design)
    tips = _tips(design, task, poses, shears, mechanics)
    return reference_pixels(lens.project(tips), lens.width) - neutral_px(design)


def _distances(design: Design, tips: np.ndarray) -> np.ndarray:
    """Return the distances (...), m, of pin tips (..., 3), m, sensor frame, from the camera."""
    return np.linalg.norm(tips - Lens(design).position, axis=-1)


def _scatter(pins: np.ndarray) -> float:
    """Return the median distance, px, of pins (n, p, 2) from each one's median over the n frames."""
    return float(np.nanmedian(np.linalg.norm(pins - np.nanmedian(pins, 0), axis=-1)))


def _pixels(places: np.ndarray, width: int) -> np.ndarray:
    """Return places (n, 2), px of 256, in px of an image."""
    return (places + 0.5) * width / REFERENCE_PX - 0.5


def _drawn(places: np.ndarray, image: np.ndarray, before: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return a binary image (h, w) uint8 with the pins of another one moved to other places.

    Args:
        places: (n, 2) px.
        image: (h, w) uint8, the other image.
        before: (n, 2) px, where they are in it.
        sizes: (n,) factors of their diameters.
    """
    _, _, stats, centres = cv2.connectedComponentsWithStats(np.where(image > 127, 1, 0).astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA][cKDTree(centres[1:]).query(before)[1]]
    radii = sizes * np.sqrt(areas / np.pi)
    rows, columns = np.indices(image.shape)
    distance, pin = cKDTree(places).query(np.stack([columns, rows], -1))
    return np.where(distance < radii[pin], 255, 0).astype(np.uint8)
