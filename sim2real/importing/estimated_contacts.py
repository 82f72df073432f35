"""Contacts estimated from the pins of some frames of a set, without its table, which is then compared with them.

The neutral image gives camera and pins, and the learned tip of any materials (sim/fast_tip/) says which contact moves pins
as those of a frame have moved (learning/pose_from_pins.py). Pitch and materials are estimated from the same
pins (learning/tip_from_pins.py). Whatever else of the mechanics is not this sensor's may make estimates too small or too
large, but their signs and axes are right.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tactip_twin.learning.pose_from_pins import MostLikely, PinModel, most_likely
from tactip_twin.learning.tip_from_pins import TipModels, most_likely_tip
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.fast_tip.fast_tip import any_materials, read_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.frame_blobs import blobs_of
from tactip_twin.sim2real.importing.source import PIN_DETECTION_FRAMES, Recording
from tactip_twin.sim2real.importing.table_columns import complete_rows
from tactip_twin.sim2real.sensor.preprocess import FrameReader
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import NeutralFit, camera_change, fit_neutral, neutral_px
from tactip_twin.tactip_model.pin_detection import Blobs, PinMatcher, find_blobs
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.sensor_of_image import fit_lattice, sensor_of

FRAMES = 120
"""Number of frames that are read."""

_MIN_DETECTED = 0.9
"""Fraction of the pins that must be detected in a frame."""

_MIN_FRAMES = 20
"""Minimum number of frames with enough pins."""

_PRESET = "tactip-127"
"""Preset whose materials the estimate begins with."""

_POSES = {
    "surface": Ranges(depth_mm=(-6.5, 0.0), roll_deg=(-25, 25), pitch_deg=(-25, 25)),
    "edge": Ranges(x_mm=(-7, 7), depth_mm=(-6.5, 0.0), roll_deg=(-20, 20), pitch_deg=(-20, 20), yaw_deg=(-200, 200)),
}
_SHEARS = Ranges(x_mm=(-6, 6), y_mm=(-6, 6), yaw_deg=(-8, 8))
"""Ranges of the estimates, mm and degrees, somewhat wider than what is usually recorded [?]."""

_PIXEL_NOISE, _INDEPENDENT = 0.5, 10
"""Residual of a good estimate, px of 256, and number of independent measurements that a frame counts for, because the
residuals of its pins are correlated (as in calibration/rounds.py)."""

_OUTLIER_PX = 2.0
"""Distance, px of 256, beyond which a pin hardly counts, because it is confused with its neighbour [?]."""

_TRIED_AT_REST = 20
"""Number of frames, those whose pins are closest together, that are tried in place of a missing neutral image [?]."""

_TIP_FRAMES, _TIP_ROUNDS = 40, 2
"""Number of frames that pitch and materials are estimated from, and number of rounds: with better ones, some frames have
another most likely contact [M]."""

_BAD_FIT = 2.0
"""Residual of a frame, in medians over all, beyond which it does not count for pitch and materials, nor for a tool centre:
pins were confused in it, or it lags behind its row. Without such frames, the tool centre of real-331 is known to 0.1 mm
instead of 0.2 [M]."""

_RANDOM_CONTACTS, _SECTORS = 4000, 6
"""Number of random contacts of which the nearest is the start of an estimate, and number of ranges of yaw, each with its own
starts, on an edge."""


@dataclass(frozen=True)
class EstimatedContacts:
    """Contacts of n frames with p pins, estimated from the pins alone. On a surface, axes are the image's."""

    rows: np.ndarray
    """(n,) int, rows of the table."""
    poses: np.ndarray
    """(n, 6) mm and degrees, axes of sim/pose.py."""
    pose_deviations: np.ndarray
    """(n, 6) standard deviations of the poses, mm and degrees."""
    shears: np.ndarray
    """(n, 6) mm and degrees."""
    residuals_px: np.ndarray
    """(n,) root mean square distance of detected and simulated pins, px of 256."""
    at_rest_px: np.ndarray
    """(p, 2) pins at rest, px of 256."""
    detected_px: np.ndarray
    """(n, p, 2) detected pins, px of 256; NaN where one is not detected."""
    simulated_px: np.ndarray
    """(n, p, 2) pins of the estimated contacts, px of 256."""
    touching_at_rest: bool = False
    """Whether the pins at rest are from frames that touch, because there is no neutral image: depths then have no zero."""
    optima: "tuple[EstimatedContacts, ...]" = ()
    """On an edge, estimates from several starts, of which this holds the one that fits best in each frame: another may be
    right."""

    @property
    def fits_well(self) -> np.ndarray:
        """Frames (n,) bool whose residuals are not far above the others'."""
        return self.residuals_px <= _BAD_FIT * np.median(self.residuals_px)


def estimate_contacts(
    recording: Recording,
    reader: FrameReader,
    neutral: np.ndarray | None,
    task: Task,
    at_rest: np.ndarray | None = None,
    seed: int = 0,
) -> EstimatedContacts:
    """Estimate the contacts of up to FRAMES frames of a set.

    Args:
        recording: The set.
        reader: Reader of its frames.
        neutral: (h, w[, 3]) uint8, the neutral image, if there is one.
        task: Stimulus of the set.
        at_rest: (h, w) uint8, a cropped binary image of the pins at rest in place of a missing neutral image; without both,
            the least deformed frame takes its place.
        seed: Seed of the choice of frames and of the starts.

    Raises:
        TactipError: If the image at rest shows no pins, or pins are not detected in enough frames.
    """
    rng = np.random.default_rng(seed)
    frames = _read_frames(recording, reader, rng)
    at_rest = at_rest if neutral is None else reader.cropped(reader.masked(neutral))
    cropped = list(frames.cropped.values())
    design, fit = _least_deformed(cropped) if at_rest is None else fit_neutral(sensor_of(at_rest), at_rest)
    design = replace(design, materials=design_named(_PRESET).materials)
    if neutral is not None:
        design = _with_camera_of(design, reader.with_rim(neutral), frames.with_rim[:PIN_DETECTION_FRAMES])
    pins, good = detected_pins([blobs_of(image) for image in cropped], fit.pins_px)
    rows, pins = np.array(list(frames.cropped))[good], pins[good]
    model = contact_model(design, some_of(pins, rng), task, rng).model
    noise = _noise(pins)
    optima = []
    for found in _optima(model, pins, noise, task, rng):
        values = np.concatenate([found.poses, found.shears], 1)[:, model.free]
        one = EstimatedContacts(
            rows=rows,
            poses=found.poses,
            pose_deviations=found.deviations[:, :6],
            shears=found.shears,
            residuals_px=found.residuals,
            at_rest_px=fit.pins_px,
            detected_px=pins,
            simulated_px=model.positions(values).reshape(pins.shape),
            touching_at_rest=neutral is None,
        )
        optima.append(one)
    best = chosen_of(optima, np.argmin([one.residuals_px for one in optima], 0))
    return replace(best, optima=tuple(optima) if len(optima) > 1 else ())


class _Frames(NamedTuple):
    """Frames that could be read."""

    cropped: dict[int, np.ndarray]
    """Cropped binary images (h, w) uint8 by row of the table."""
    with_rim: list[np.ndarray]
    """The same frames with what lies around the pins, (h, w) uint8."""


def _read_frames(recording: Recording, reader: FrameReader, rng: np.random.Generator) -> _Frames:
    """Read up to FRAMES frames of a set, chosen at random. Raises TactipError if none can be used."""
    complete = complete_rows(recording.table)
    rows = np.array([i for i, path in enumerate(recording.paths) if path and complete[i]])
    if not len(rows):
        raise TactipError("the table must have a row whose frame is there and whose cells are numbers, got none")
    rows = np.sort(rng.choice(rows, min(FRAMES, len(rows)), replace=False))
    cropped: dict[int, np.ndarray] = {}
    with_rim, problem = [], ""
    for i in rows:
        try:
            frame = recording.load(i)
            cropped[int(i)] = reader.cropped(reader.masked(frame))
        except TactipError as error:  # the import leaves it out later, and reports it
            problem = problem or f"{recording.names[i]}: {error}"
            continue
        with_rim.append(reader.with_rim(frame))
    if not cropped:
        raise TactipError(f"none of {len(rows)} frames can be used, for example {problem}")
    return _Frames(cropped, with_rim)


def _with_camera_of(design: Design, neutral: np.ndarray, frames: list[np.ndarray]) -> Design:
    """Return a design whose camera is zoomed and moved as it is in frames (h, w) uint8 against the neutral image (h, w)."""
    centre_px = np.array(design.optics.centre) * neutral.shape[1] - 0.5
    change = camera_change(neutral, frames, centre_px)
    if change is None:
        return design
    zoom, x, y = (float(value) for value in change[0])
    return replace(design, optics=replace(design.optics, zoom=zoom, drift=(x, y)))


def detected_pins(blobs: Sequence[np.ndarray], at_rest_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pins (n, p, 2), px of 256, of frames, NaN where one is not detected; and which frames show enough of them,
    (n,) bool.

    Args:
        blobs: (n) centres (k, 2) of the blobs of each frame, px of 256.
        at_rest_px: (p, 2) pins at rest, px of 256; NaN where unknown.

    Raises:
        TactipError: If fewer than _MIN_FRAMES frames do.
    """
    known = np.isfinite(at_rest_px[:, 0])
    matcher = PinMatcher(at_rest_px[known])
    pins = np.full((len(blobs), len(known), 2), np.nan)
    for k, centres in enumerate(blobs):
        pins[k, known] = matcher.match(Blobs(centres))
    good = np.isfinite(pins[..., 0]).mean(1) > _MIN_DETECTED
    if good.sum() < _MIN_FRAMES:
        raise TactipError(
            f"contacts cannot be estimated: {_MIN_DETECTED:.0%} of the pins were detected in {good.sum()} of {len(good)} "
            f"frames, and at least {_MIN_FRAMES} are needed"
        )
    return pins, good


class ContactModel(NamedTuple):
    """A model of the pins of a tip whose pitch and materials were estimated."""

    model: PinModel
    """The model."""
    design: Design
    """The design with the estimated pitch, and its own materials."""
    materials: np.ndarray
    """(6,) the estimated materials, inputs of FastTip.coefficients."""
    contacts: np.ndarray
    """(n, 12) most likely poses and shears of the frames, mm and degrees."""
    before_px: float
    """Median distance of detected and simulated pins with the design's own materials, px of 256."""
    after_px: float
    """The same with the estimated ones."""


def pins_of_some(blobs: Sequence[np.ndarray], design: Design, rng: np.random.Generator) -> np.ndarray:
    """Return the pins (m, p, 2), px of 256, of a few frames of a sensor, chosen at random, for contact_model; NaN where one
    is not detected.

    Args:
        blobs: (n) centres (k, 2) of the blobs of each frame, px of 256.
        design: The sensor.
        rng: Generator for the choice.

    Raises:
        TactipError: If too few frames show their pins.
    """
    chosen = rng.choice(len(blobs), min(FRAMES, len(blobs)), replace=False)
    pins, good = detected_pins([blobs[k] for k in chosen], neutral_px(design))
    return some_of(pins[good], rng)


def some_of(pins: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the pins (m, p, 2) of at most _TIP_FRAMES of n frames (n, p, 2), which are enough for contact_model."""
    return pins[rng.choice(len(pins), min(_TIP_FRAMES, len(pins)), replace=False)]


def contact_model(design: Design, pins: np.ndarray, task: Task, rng: np.random.Generator) -> ContactModel:
    """Return a model of the pins of a tip of some design, with the pitch and materials that explain the pins
    of some frames best, whatever their contacts.

    Args:
        design: The design.
        pins: (n, p, 2) px of 256, from some_of or pins_of_some; NaN where a pin is not detected.
        task: Stimulus of the frames.
        rng: Generator of contacts from which to start.
    """
    models = TipModels(read_fast_tip(any_materials(task)), design, _POSES[task], _SHEARS)
    noise = _noise(pins)
    tip, found = models.with_materials(models.middle, material_inputs(design.materials)), np.empty((0, 12))
    for _ in range(_TIP_ROUNDS):
        found, residuals = _likeliest(_optima(models.of(tip), pins, noise, task, rng))
        good = residuals <= _BAD_FIT * np.median(residuals)
        tip = most_likely_tip(models, pins[good], found[good], tip, noise, outlier=_OUTLIER_PX)
    usual = models.with_materials(tip, material_inputs(design.materials))
    before, after = (most_likely(models.of(one), pins, found, noise, outlier=_OUTLIER_PX) for one in (usual, tip))
    contacts = np.concatenate([after.poses, after.shears], 1)
    medians = (float(np.median(one.residuals)) for one in (before, after))
    return ContactModel(models.of(tip), models.design(tip), models.materials(tip), contacts, *medians)


def _likeliest(optima: Sequence[MostLikely]) -> tuple[np.ndarray, np.ndarray]:
    """Return poses and shears (n, 12), mm and degrees, of the best optimum of each frame, and its residuals (n,)."""
    residuals = np.stack([one.residuals for one in optima])
    both = np.stack([np.concatenate([one.poses, one.shears], 1) for one in optima])
    return both[residuals.argmin(0), np.arange(residuals.shape[1])], residuals.min(0)


def _noise(pins: np.ndarray) -> float:
    """Return the noise of each coordinate, px of 256, with which pins (n, p, 2) count as _INDEPENDENT measurements."""
    return float(_PIXEL_NOISE * np.sqrt(2 * pins.shape[1] / _INDEPENDENT))


def _optima(model: PinModel, pins: np.ndarray, noise: float, task: Task, rng: np.random.Generator) -> list[MostLikely]:
    """Return the most likely contacts for pins (n, p, 2), px; on an edge, from starts in each of _SECTORS of the yaw."""
    edges = np.linspace(-180, 180, _SECTORS + 1)
    sectors = [{5: ends} for ends in itertools.pairwise(edges)] if task == "edge" else [{}]
    starts = [model.nearest_of(pins, _RANDOM_CONTACTS, rng, within) for within in sectors]
    return [most_likely(model, pins, start, noise, outlier=_OUTLIER_PX) for start in starts]


def chosen_of(optima: Sequence[EstimatedContacts], which: np.ndarray) -> EstimatedContacts:
    """Return for each of n frames that of some estimates whose index is in `which`, (n,) int."""
    frames = np.arange(len(which))
    per_frame = ("poses", "pose_deviations", "shears", "residuals_px", "simulated_px")
    parts = {name: np.stack([getattr(one, name) for one in optima])[which, frames] for name in per_frame}
    return replace(optima[0], **parts)


def _least_deformed(images: list[np.ndarray]) -> tuple[Design, NeutralFit]:
    """Return the fit of a nominal design to the binary image whose pins are nearest to a lattice that a lens shows, among
    those whose pins are closest together, because a contact spreads and distorts them.

    Raises:
        TactipError: If none of these images shows a lattice.
    """
    centres = [find_blobs(image).centres for image in images]
    usual = float(np.median([len(c) for c in centres]))
    spreads = [
        float(np.linalg.norm(c - c.mean(0), axis=1).mean()) if abs(len(c) - usual) <= (1 - _MIN_DETECTED) * usual else np.inf
        for c in centres
    ]
    tried = (fit_lattice(images[k], usual) for k in np.argsort(spreads, kind="stable")[:_TRIED_AT_REST])
    fits = [fit for fit in tried if fit is not None]
    if not fits:
        raise TactipError(
            f"no frame shows its {usual:.0f} pins nearly at rest on a hexagonal or circular lattice, and there is no "
            "neutral image: give one with --neutral, or give --columns instead of --find"
        )
    return min(fits, key=lambda fit: fit[1].lattice_px)
