"""The sim-to-real gap: pins and images of real frames compared with simulated ones at the same pose and shear.

This analysis uses real labels. A frame taken before its move was finished, as by slow cameras, shows another contact than
its row states. Distances are therefore given at the labels and at the best-fitting fraction of the move.
"""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from tactip_twin.learning.data import Samples
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.plot import figure_of, save_figure
from tactip_twin.sim2real.calibration.moves import MOVE_FRACTIONS, best_fraction, distances, pin_pixels
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px, reference_pixels
from tactip_twin.tactip_model.optics import REFERENCE_PX
from tactip_twin.tactip_model.pin_detection import PinMatcher, find_blobs
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

_BINS = 4
"""Number of bins of a label, with equal numbers of frames."""

_MIN_RANGE = 0.5
"""Minimum range, mm or degrees, of a label that varies."""

_MIN_PIN_FRACTION = 0.6
"""Minimum fraction of identified pins in a frame; frames below it are left out and counted."""


def sim_to_real_gap(
    samples: Samples, design: Design, fidelity: str, frames: int, seed: int = 0
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the distances of real from simulated pins as figures (JSON), and as arrays for `plot_gap`.

    Args:
        samples: Samples of a real set.
        design: Design of its sensor.
        fidelity: Name of the simulation's fidelity.
        frames: Number of frames, sampled from `samples`.
        seed: Seed of that choice.

    Raises:
        TactipError: If no frame's pins are those of the design.
    """
    order = np.random.default_rng(seed).permutation(len(samples))[:frames]
    chosen = samples.take(np.sort(order))
    neutral, real = neutral_px(design), detect_pins(design, chosen.images)
    good = np.isfinite(real[..., 0]).mean(1) > _MIN_PIN_FRACTION
    if not good.any():
        raise TactipError(
            f"none of {len(good)} frames shows {_MIN_PIN_FRACTION:.0%} of the pins of {design.name!r}: check the design"
        )
    simulated, images = _simulated(chosen.take(good), design, fidelity)
    real, chosen = real[good], chosen.take(good)
    fractions, fitted, _ = best_fraction(simulated, real)
    # In a frame whose error is half the distance between pins, pins were confused with their neighbours.
    between = np.median(cKDTree(neutral).query(neutral, 2)[0][:, 1])
    right = np.nanmedian(np.linalg.norm(fitted - real, axis=-1), 1) < between / 2
    if not right.any():
        raise TactipError(
            f"none of {len(good)} frames shows the pins of {design.name!r} nearer to their predictions than to their "
            "neighbours: check the design"
        )
    chosen = chosen.take(right)
    real, fractions, fitted, simulated, images = (a[right] for a in (real, fractions, fitted, simulated, images))
    off = fitted - real
    rms = distances(fitted, real)
    labels = {name: np.abs(chosen.targets[:, k]) for k, name in enumerate(chosen.labels.names)}
    labels |= {"shear_mm": np.linalg.norm(chosen.shears[:, :3], axis=1)}
    moved = np.linalg.norm(real - neutral, axis=-1)
    rings = np.linalg.norm(neutral - neutral.mean(0), axis=1)
    figures = {
        "frames": len(chosen),
        "unmatched_frames": int((~good).sum()),
        "mismatched_frames": int((~right).sum()),
        "unit": "px of a 256 px image",
        "labelled": _spread(distances(simulated[:, -1], real)),
        "best_fraction": _spread(rms),
        "pins_move": float(np.sqrt(np.nanmean(moved**2))),
        "images": _likeness(chosen.images, images),
        "against": {name: _binned(values, rms) for name, values in labels.items() if np.ptp(values) > _MIN_RANGE},
        "by_radius_px": _binned(rings, np.sqrt(np.nanmean((off**2).sum(-1), 0))),
    }
    return figures, {"neutral": neutral, "off": np.nanmean(off, 0), "rms": np.sqrt(np.nanmean((off**2).sum(-1), 0))}


def detect_pins(design: Design, images: np.ndarray) -> np.ndarray:
    """Return the pins (n, p, 2), px of 256, of a design in tactile images (n, size, size); NaN where one is not detected."""
    width = images.shape[1]
    matcher = PinMatcher((neutral_px(design) + 0.5) * width / REFERENCE_PX - 0.5)
    return np.array([reference_pixels(matcher.match(find_blobs(image)), width) for image in images])


def _simulated(samples: Samples, design: Design, fidelity: str) -> tuple[np.ndarray, np.ndarray]:
    """Return pins (n, MOVE_FRACTIONS, p, 2), px of 256, and tactile images (n, size, size) at the end of the move."""
    simulator, raster = ContactSimulator(design, samples.labels.task, fidelity_named(fidelity)), Raster(design)
    poses, shears = samples.dataset.poses[samples.rows], samples.shears
    pins, images = [], []
    for pose, shear in zip(tqdm(poses, unit="contact", file=sys.stderr, mininterval=5), shears, strict=True):
        skins, contacts = [], []
        for contact in simulator.simulate_partial_shears(from_mm_deg(pose), from_mm_deg(shear), MOVE_FRACTIONS):
            skins.append(simulator.scene.vertices()[: simulator.scene.mesh.surface_count])
            contacts.append((contact.pin_tips, contact.directions))
        pins.append(pin_pixels(design, fidelity, np.array(skins)))
        images.append(tactile_image(raster.render(*contacts[-1]), design.image))
    return np.array(pins), np.array(images)


def _spread(rms: np.ndarray) -> dict[str, float]:
    return {"rms": float(np.sqrt(np.mean(rms**2))), "median": float(np.median(rms)), "p90": float(np.quantile(rms, 0.9))}


def _binned(values: np.ndarray, errors: np.ndarray) -> list[dict[str, float]]:
    """Return the median error in bins of equal size."""
    parts = np.array_split(np.argsort(values, kind="stable"), _BINS)
    return [
        {"from": float(values[p].min()), "to": float(values[p].max()), "median": float(np.median(errors[p]))}
        for p in parts
        if len(p)
    ]


def _likeness(real: np.ndarray, simulated: np.ndarray) -> dict[str, float]:
    """Return the similarity of images (n, size, size): the fraction of white pixels within a pixel of a white pixel of the
    other."""
    near = np.ones((3, 3), np.uint8)
    fractions = []
    for a, b in zip(real, simulated, strict=True):
        for one, other in ((a, b), (b, a)):
            fractions.append(((one > 0) & (cv2.dilate(other, near) > 0)).sum() / max(1, (one > 0).sum()))
    white = [float((images > 0).mean()) for images in (real, simulated)]
    return {"white_within_a_pixel": float(np.mean(fractions)), "white_real": white[0], "white_simulated": white[1]}


def plot_gap(arrays: dict[str, np.ndarray], title: str, path: Path) -> None:
    """Plot the mean and rms distance by pin to `path`, from the arrays of `sim_to_real_gap`."""
    figure, (axis,) = figure_of(1, 1, (6.0, 5.2))
    x, y = arrays["neutral"].T
    points = axis.scatter(x, y, c=arrays["rms"], cmap="viridis", s=40, vmin=0)
    axis.quiver(x, y, *arrays["off"].T, angles="xy", scale_units="xy", scale=0.1, width=0.003, color="0.2")
    axis.set(aspect="equal", title=title, xlabel="x, px of a 256 px image", ylabel="y, px")
    axis.invert_yaxis()
    figure.colorbar(points, label="rms distance, px (arrows: mean, 10 times)")
    save_figure(figure, path)
