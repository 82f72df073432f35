"""Data sets of `tactip bench learning`."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactip_twin.benchmarks.learning.options import LearningOptions
from tactip_twin.learning.data import Samples, read_samples, read_splits
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_pins
from tactip_twin.sim.dataset.generate import Job
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges, Split
from tactip_twin.sim.dataset.symmetry import SYMMETRIES
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.labels import Task
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

_DRAWN_SET = 500
"""Number of contacts of the set that names the ranges of drawn ones."""

_DRAWN_VAL = 3000
"""Number of validation contacts of rows on single drawn contacts: the factors on deviations at light touch need hundreds of
light ones."""

WIDE_PX = 256
"""Width of the images of the row `laptop-256px`, whose pins are known to half the noise of 128 px (docs/uncertainty.md)."""

NOISES_GREY = (5, 15, 30)
"""Standard deviations of the noise of frames that networks are tested with, grey levels of 255."""

SLIDE_SNAPSHOTS = 15
"""Number of images per sliding path."""

_SLIDE_SET = 100 * SLIDE_SNAPSHOTS
"""Number of images of the set that names the ranges of drawn slides."""

_FAST_SEED, _FAST_VAL_SEED, _LIGHT_SEED = 11, 12, 13
"""Seeds of predicted contacts, of their validation contacts, and of the test contacts with light ones. The learned tip was
taught on contacts of seed 0."""

_LIGHT_DEPTH_MM = (-5.0, 0.0)
"""Depths of contacts from none at all: the paper's begin at 1 mm, where a servo has long touched."""

CURVATURES_PER_M = (-28.0, 80.0)
"""Principal curvatures of curved surfaces, 1/m, as on the bust: concave with 36 mm radius to convex with 12.5 mm."""

VARYING_FRACTION = 0.5
"""Fraction of curved surfaces with varying curvature: a network trained without them errs by 2 degrees of tilt near a nose,
and one trained on these alone errs by 0.2 mm of depth on a sphere [M]."""

SNAPSHOTS = 20
"""Number of images per contact of the row `laptop-snapshots`."""

_SLIDE_DEPTHS_MM: dict[Task, tuple[float, float]] = {"surface": (-5.0, -0.5), "edge": (-5.0, -0.2)}
"""Depths of sliding contacts: shallower ones may miss a surface that bends away."""

_SLIDE_SHEARS = replace(SHEAR_RANGES, x_mm=(-3.0, 3.0), y_mm=(-3.0, 3.0))
"""Shears before a path slides on: after longer ones on a curved surface, the first contact is rarely trusted."""

DESIGN, FIDELITY = "tactip-127", "standard"

MORE_PINS_DESIGN = "tactip-331"
"""Sensor of the row `laptop-331`."""

ANY_DESIGNS = {"331": MORE_PINS_DESIGN, "any": DESIGN, "any-yaw": DESIGN}
"""Sensors by kind of rows (Row.kind) with any materials."""

_DEEP_MM = (-5.5, -0.2)
"""Depths of their contacts: all that the learned tip of any materials knows."""

_ALL_ROUND_DEG = (-180.0, 180.0)
"""Yaws of rows of the kind `any-yaw`, whose edges are met from every side."""

WIDE_KINDS = ("256px", "256px-slides")
"""Kinds of rows (Row.kind) with wide images."""

_SINGLE = {"slides": "drawn", "256px-slides": "256px"}
"""Kinds of rows that learn from slides, and the kinds of the single contacts with which they are tested, too."""

_OWN_TESTS = {*WIDE_KINDS, *ANY_DESIGNS, "drawn", "slides"}
"""Kinds of rows (Row.kind) with test sets of their own."""


def jobs(options: LearningOptions, kinds: Collection[str]) -> list[Job]:
    """Return the sets that are needed, whether they exist or not: the test sets of rows, and the training and validation
    sets of rows of some kinds (Row.kind). Rows on wide images, and of other sensors, have test sets of their own."""
    task, still = options.task, Ranges()
    each = len(SYMMETRIES[task])
    usual, light = POSE_RANGES[task], replace(POSE_RANGES[task], depth_mm=_LIGHT_DEPTH_MM)
    wanted: list[_Wanted] = []
    shared = not (kinds and set(kinds) <= _OWN_TESTS)
    if shared:
        wanted += [_Wanted("plain", "test", options.test_contacts, usual, SHEAR_RANGES)]
        wanted += [_Wanted("light", "test", options.other_test_contacts, light, SHEAR_RANGES, _LIGHT_SEED)]
        wanted += [_Wanted("taps", "test", options.other_test_contacts, usual, still)]
    if {"plain", "symmetric", "large"} & set(kinds):
        # The other rows use a part of the set of `laptop-large` if it exists.
        large = "large" in kinds or _holds(options.data / "symmetric" / task / "train", options.large_contacts * each)
        contacts = options.large_contacts if large else options.contacts
        wanted += [_Wanted("symmetric", "train", contacts * each, usual, SHEAR_RANGES)]
    if "fast" in kinds:
        wanted += [_Wanted("fast", "train", options.fast_images, light, SHEAR_RANGES, _FAST_SEED)]
        wanted += [_Wanted("fast", "val", options.test_contacts, light, SHEAR_RANGES, _FAST_VAL_SEED)]
    for kind in ("256px", "drawn"):
        if kind in kinds:
            wanted += [_Wanted(kind, "train", _DRAWN_SET, light, SHEAR_RANGES, _FAST_SEED)]
            wanted += [_Wanted(kind, "val", _DRAWN_VAL, light, SHEAR_RANGES, _FAST_VAL_SEED)]
            wanted += [_Wanted(kind, "test", options.test_contacts, usual, SHEAR_RANGES)]
    for kind in ANY_DESIGNS:
        if kind in kinds:
            pose = replace(usual, yaw_deg=_ALL_ROUND_DEG) if kind == "any-yaw" else usual
            deep = replace(pose, depth_mm=_DEEP_MM)
            wanted += [_Wanted(kind, "train", _DRAWN_SET, deep, SHEAR_RANGES, _FAST_SEED)]
            wanted += [_Wanted(kind, "val", options.other_test_contacts, deep, SHEAR_RANGES, _FAST_VAL_SEED)]
            wanted += [_Wanted(kind, "test", options.test_contacts, pose, SHEAR_RANGES)]
    if {"plain", "symmetric", "large", "snapshots"} & set(kinds):
        wanted += [_Wanted("plain", "val", options.test_contacts, usual, SHEAR_RANGES)]
    if "snapshots" in kinds:
        wanted += [_Wanted("snapshots", "train", options.snapshot_contacts * SNAPSHOTS, usual, SHEAR_RANGES)]
    if "taps" in kinds:
        wanted += [_Wanted("taps", "train", options.contacts, usual, still)]
        wanted += [_Wanted("taps", "val", options.other_test_contacts, usual, still)]
    wanted += _slides(options, kinds)
    return [_job(options, one) for one in wanted]


def _slides(options: LearningOptions, kinds: Collection[str]) -> "list[_Wanted]":
    """Return the sets of sliding paths that rows of some kinds (Row.kind) need, and of single contacts to test them with."""
    task, images = options.task, options.slides * SLIDE_SNAPSHOTS
    usual, wanted = POSE_RANGES[task], []
    touching = replace(usual, depth_mm=_SLIDE_DEPTHS_MM[task])
    for kind, single in _SINGLE.items():
        # The rows `laptop-long` and `laptop-noise` are tested with slides, too.
        if kind in kinds or (single == "drawn" and single in kinds):
            wanted.append(_Wanted(kind, "test", images, touching, _SLIDE_SHEARS))
        if kind in kinds:
            wanted.append(_Wanted(kind, "train", _SLIDE_SET, touching, _SLIDE_SHEARS, _FAST_SEED))
            wanted.append(_Wanted(kind, "val", images, touching, _SLIDE_SHEARS))
        if kind in kinds and single not in kinds:
            wanted.append(_Wanted(single, "test", options.test_contacts, usual, SHEAR_RANGES))
    return wanted


@dataclass(frozen=True)
class _Wanted:
    """A set of the benchmark."""

    kind: str
    """Kind of contacts (Row.kind, or light)."""
    split: Split
    """Its split."""
    samples: int
    """Number of samples."""
    pose: Ranges
    """Ranges of the poses."""
    shear: Ranges
    """Ranges of the shears."""
    seed: int = 0
    """Seed."""


def _job(options: LearningOptions, wanted: _Wanted) -> Job:
    """Return the set of a task, with the learned tip that predicts its contacts if one does."""
    task, kind, split = options.task, wanted.kind, wanted.split
    augmented = (kind, split) in (("symmetric", "train"), ("fast", "train"))
    tip: Path | None = None
    digest = ""
    slides = kind in _SINGLE
    if slides and split == "train":
        tip = shipped_sliding_tip(task, DESIGN)
        digest = read_sliding_tip(tip).digest
    elif split == "train" and (kind == "fast" or kind in _OWN_TESTS):
        tip = shipped_fast_tip(task, ANY_DESIGNS.get(kind, DESIGN), randomized=kind in ANY_DESIGNS)
        digest = read_fast_tip(tip).digest
    design, curved = load_design(ANY_DESIGNS.get(kind, DESIGN)), slides and task == "surface"
    if kind in WIDE_KINDS:
        design = replace(design, image=replace(design.image, size_px=WIDE_PX))
    configuration = Configuration(
        task=task,
        split=split,
        samples=wanted.samples,
        seed=wanted.seed,
        # OpenGL takes longer for eight images than the contact itself. Sets to test with, or to fit deviations to, are
        # rendered by it nevertheless: on light contacts, networks that learned from the raster err more on its images.
        renderer="raster" if augmented or (kind in _OWN_TESTS and split == "train") else "pyrender",
        design=design,
        fidelity=fidelity_named(FIDELITY),
        pose=wanted.pose,
        shear=wanted.shear,
        augment_symmetry=augmented,
        curvature_per_m=CURVATURES_PER_M if curved else (0.0, 0.0),
        varying_curvature_fraction=VARYING_FRACTION if curved else 0.0,
        snapshots_per_contact=SLIDE_SNAPSHOTS if slides else SNAPSHOTS if kind == "snapshots" else 1,
        # The sets of the networks also teach and test the learned tip.
        keep_mesh=kind in ("symmetric", "plain"),
        mechanics_randomization=MECHANICS_RANDOMIZATIONS["real" if kind in ANY_DESIGNS and split != "test" else "none"],
        fast_tip=digest,
    )
    return Job(configuration, options.data / kind / task / split, tip)


def _holds(folder: Path, samples: int) -> bool:
    """Return whether a folder has a finished set of this number of samples."""
    return (folder / "meta.json").exists() and read_meta(folder)["configuration"]["samples"] == samples


class Sets:
    """The sets of a task, read on demand."""

    def __init__(self, options: LearningOptions) -> None:
        self._options, self._each = options, len(SYMMETRIES[options.task])
        self._large: Samples | None = None

    def training(self, kind: str) -> tuple[Samples, Samples]:
        """Return training and validation samples of a kind (Row.kind).

        Raises:
            TactipError: A set is missing or damaged.
        """
        if kind in ("taps", "fast", *_OWN_TESTS):
            return read_splits(self._folder(kind))
        if kind == "snapshots":
            return read_samples(self._folder(kind) / "train"), read_samples(self._folder("plain") / "val")
        if self._large is None:
            self._large = read_samples(self._folder("symmetric") / "train")
        chosen = {
            # The first sample of a contact is the contact as simulated, before its symmetric copies.
            "plain": slice(0, self._options.contacts * self._each, self._each),
            "symmetric": slice(0, self._options.contacts * self._each),
            "large": slice(None),
        }[kind]
        return self._large.take(chosen), read_samples(self._folder("plain") / "val")

    def tests(self, kind: str) -> dict[str, Samples]:
        """Return test samples by kind of contact, for a row of a kind. Raises TactipError if a set is missing or damaged."""
        if kind in ("drawn", "slides", *WIDE_KINDS):
            wide = kind in WIDE_KINDS
            test = read_samples(self._folder("256px" if wide else "drawn") / "test")
            noisy = {NOISY.format(grey): with_noise(test, grey) for grey in NOISES_GREY}
            if kind == "256px":
                return {"sheared": test} | noisy
            return {
                "sheared": test,
                "slides": read_samples(self._folder("256px-slides" if wide else "slides") / "test"),
            } | noisy
        if kind in _OWN_TESTS:
            return {"sheared": read_samples(self._folder(kind) / "test")}
        kinds = {"sheared": "plain", "light": "light", "taps": "taps"}
        return {name: read_samples(self._folder(kind) / "test") for name, kind in kinds.items()}

    def _folder(self, kind: str) -> Path:
        return self._options.data / kind / self._options.task


NOISY = "noise {:g}"
"""Name of the test with noise of a standard deviation."""


def with_noise(samples: Samples, grey: float) -> Samples:
    """Return samples of a simulated set with the images of a camera with normal noise.

    Args:
        samples: Samples of a set with pins and binary images.
        grey: Standard deviation of the noise, grey levels of 255.
    """
    design = read_configuration(samples.dataset.meta, samples.folder).design
    raster, rng = Raster(design), np.random.default_rng(0)
    tips, directions = (array[samples.rows] for array in read_pins(samples.folder, samples.dataset.meta))
    images = []
    for pins in zip(tips, directions, strict=True):
        frame = raster.render(*pins)
        noisy = np.clip(np.rint(frame + rng.normal(0, grey, frame.shape)), 0, 255).astype(np.uint8)
        images.append(tactile_image(noisy, design.image))
    return replace(samples, images=np.stack(images))
