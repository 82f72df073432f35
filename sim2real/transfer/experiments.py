"""Transfer from simulation to a real sensor: without any real label, and with a few.

    a real set ── neutral image ──► design ── contacts, randomized mechanics ──► network ──► real test frames
               └─ some frames with labels ───────────────────────────────────► corrected ──┘

Each finished step is kept in OUT and not repeated, so an interrupted command resumes.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.configuration import DeviceName, Recipe
from tactip_twin.learning.data import Samples, read_samples
from tactip_twin.learning.drawn_contacts import configuration_of
from tactip_twin.learning.model import Model, load_model, load_network
from tactip_twin.learning.optics_ranges import noiseless
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.limits import MAX_TILT_RAD, exceeds_max_tilt
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import SHEAR_RANGES, Ranges, Split
from tactip_twin.sim.fast_tip.fast_tip import FastTip, any_materials, read_fast_tip
from tactip_twin.sim.labels import FidelityName, Task
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.import_set import read_report
from tactip_twin.sim2real.transfer.gel import with_other_gels, with_usual_gel
from tactip_twin.sim2real.transfer.initial_network import shipped_network_for
from tactip_twin.sim2real.transfer.linear_correction import MIN_FRAMES, write_corrected
from tactip_twin.sim2real.transfer.neutral_calibration import camera_of, nearest_nominal_design
from tactip_twin.sim2real.transfer.real_sensor import RealSensor
from tactip_twin.sim2real.transfer.real_shear import real_shear
from tactip_twin.sim2real.transfer.score import Estimator, score
from tactip_twin.sim2real.transfer.settings import AUTO, GAP, NONE, TransferSettings
from tactip_twin.sim2real.transfer.sim_gap import plot_gap, sim_to_real_gap
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import remove_leftovers, write_file
from tactip_twin.tactip_model.input_files import read_json

RESULTS = "results.json"

VAL_FRAMES = 200
"""Number of validation frames of a training on real frames alone, taken from its frames."""

_MAX_VAL_FRACTION = 0.2
"""Maximum fraction of its frames that are validation frames."""

_STEPS, _STEPS_FROM_NETWORK = 3000, 1500
"""Default numbers of training steps from random weights and from those of a network [M] (docs/transfer.md)."""

_CONTACTS = {"surface": 700, "edge": 2000}
"""Default number of simulated contacts to train on, by task. On a surface, 2000 took three times as long, and the errors on
real-331 were the same [M] (docs/transfer.md)."""

_VALIDATION_RENDERINGS = 5
"""Number of renderings of a validation image, of whose camera no more is known than of the real one. With the images of the
design's own camera, intervals of depth became 1.6 times too narrow [M]."""

_TRAIN_FRAMES, _MAX_TRAIN_FRACTION, _MIN_TRAIN_FRAMES = 1500, 0.6, 20
"""Default number of real training frames, its maximum as a fraction of the set, and its minimum."""


@dataclass(frozen=True)
class RealSplit:
    """A real set, split at random into two parts."""

    known: Samples
    """Frames whose labels may be used."""
    test: Samples
    """Frames for testing only."""


def _possible(samples: Samples, log: Callable[[str], None]) -> Samples:
    """Return the samples without those that are tilted more than any simulated contact, and say how many these are."""
    poses = from_mm_deg(samples.dataset.poses[samples.rows])
    steep = exceeds_max_tilt(poses, from_mm_deg(samples.shears))
    limit = f"{np.degrees(MAX_TILT_RAD):g} degrees"
    if steep.all():
        raise TactipError(
            f"some frames in {samples.folder} must be tilted by at most {limit}, as simulated contacts are, got none of "
            f"{len(samples)}"
        )
    if steep.any():
        log(f"{steep.sum()} of {len(samples)} frames are left out: no simulated contact is tilted by more than {limit}")
    return samples.take(~steep) if steep.any() else samples


def split_of(samples: Samples, settings: TransferSettings) -> RealSplit:
    """Return the RealSplit of a real set's samples. Raises TactipError if the set is too small."""
    known = settings.real_train_frames
    if known is None:
        known = min(_TRAIN_FRAMES, round(_MAX_TRAIN_FRACTION * len(samples)))
        if known < _MIN_TRAIN_FRAMES:
            raise TactipError(
                f"at least {round(_MIN_TRAIN_FRAMES / _MAX_TRAIN_FRACTION)} real frames are needed, "
                f"got {len(samples)} in {samples.folder}"
            )
    if len(samples) < known + 20:
        raise TactipError(
            f"real_train_frames must be at most {max(0, len(samples) - 20)}, so 20 of the {len(samples)} frames in "
            f"{samples.folder} are left to test on, got {known}"
        )
    order = np.random.default_rng(settings.seed).permutation(len(samples))
    return RealSplit(samples.take(order[:known]), samples.take(np.sort(order[known:])))


@dataclass(frozen=True)
class Variant:
    """Choices for a network trained in simulation; None: as in the settings."""

    name: str = "sim"
    """Part of its folder's name."""
    contacts: str = "sim"
    """Folder of its contacts, shared by variants that differ in images only."""
    calibrated: bool = True
    """Whether the design is fitted to the sensor; otherwise it is a preset."""
    sheared: bool = True
    """Whether its contacts are sheared."""
    randomize_mechanics: str | None = None
    """A name of settings.Mechanics."""
    noise: bool = True
    """Whether images have noise: jittered, resized or missing pins, and specks of light."""
    augmented_fraction: float | None = None
    """Fraction of the images with randomized optics."""


ABLATIONS = {
    "complete simulation": Variant(),
    "without calibration": Variant("uncalibrated", "uncalibrated", calibrated=False),
    "without shear": Variant("unsheared", "unsheared", sheared=False),
    "without optics randomization": Variant("one-camera", augmented_fraction=0.0),
    "without mechanics randomization": Variant("one-tip", "one-tip", randomize_mechanics="none"),
    "without image noise": Variant("noiseless", noise=False),
}
"""Variants by the part that is left out, one at a time."""


class Experiment:
    """Shared parts of the experiments on one real set: its sensor's design, simulated sets, networks."""

    def __init__(
        self,
        real: str | Path,
        out: str | Path,
        settings: TransferSettings,
        workers: str | int = "auto",
        device: DeviceName = "auto",
        log: Callable[[str], None] = print,
    ) -> None:
        """Read the real set.

        Args:
            real: Folder of an imported set.
            out: Folder of simulated sets, networks and results.
            settings: Settings of the experiments.
            workers: Number of worker processes, or auto for one per core.
            device: Device to train on.
            log: Callback for messages to the user.

        Raises:
            TactipError: If the set cannot be used, or a name in the settings is unknown.
        """
        self.real, self.out, self.settings = Path(real), Path(out), settings
        self._device: DeviceName = device
        self._workers, self.log = worker_count(workers), log
        remove_leftovers(self.out)
        self.samples = _possible(read_samples(self.real), log)
        if self.samples.grey:
            raise TactipError(f"experiments need binary images, but those in {self.real} are grey: import without --grey")
        self.split = split_of(self.samples, settings)
        self.task = self.samples.labels.task
        depth = float(np.median(self.samples.dataset.poses[:, 2]))
        if depth > 0:
            raise TactipError(
                f"the median pose_z of {self.real} must be negative (into the object), got {depth:g} mm: import the set "
                "again with --columns pose_z=-COLUMN"
            )
        self._init_from = self._initial_network()
        self.recipe()  # an unknown name is reported before any work starts
        self._stimulus: Task = "edge" if self.task == "edge" else "surface"
        self._sensor = RealSensor(self.real, self.out, settings, self.split.known, self._stimulus, log)

    def recipe(self, variant: Variant = Variant()) -> Recipe:
        """Return the recipe of a training on simulated samples of a variant."""
        s, recipe = self.settings, self._recipe(_STEPS_FROM_NETWORK if self._init_from else _STEPS)
        drawn = s.augmented_fraction if variant.augmented_fraction is None else variant.augmented_fraction
        varied = replace(
            recipe.settings,
            augmented_fraction=drawn,
            augmentation_strength=1.0,
            optics_ranges=self.optics(variant),
            validation_renderings=_VALIDATION_RENDERINGS if drawn else 0,
            seed=s.seed,
        )
        return replace(recipe, settings=varied)

    def _recipe(self, default_steps: int) -> Recipe:
        """Return the recipe with its number of training steps: that of the settings, the given default, or the paper's."""
        s = self.settings
        recipe = recipe_named(s.recipe, self.task, self.samples.size)
        steps = s.steps or (None if s.recipe == "paper" else default_steps)
        return recipe if steps is None else replace(recipe, settings=replace(recipe.settings, epochs=1, min_steps=steps))

    def _initial_network(self) -> Model | None:
        """Return the network that trainings in simulation start from; None for random weights."""
        name = self.settings.init_from
        if name != AUTO:
            return None if name == NONE else load_network(name)
        if read_report(self.real) is None:  # the number of pins is unknown
            return None
        config = recipe_named(self.settings.recipe, self.task, self.samples.size).network
        return shipped_network_for(self.samples, self._pins(), config)

    def optics(self, variant: Variant = Variant()) -> str:
        """Return the name of the OpticsRanges of a variant's images; without calibration, those of an unknown camera."""
        measured = variant.calibrated and camera_of(self.real)
        name = self.settings.optics_ranges
        if name == AUTO:
            name = "steady" if measured else "real"
        return name if variant.noise else noiseless(name)

    def design(self) -> Design:
        """Return the sensor's design: the given one, or one fitted to the neutral image.

        Raises:
            TactipError: The given one is of another sensor or camera, or the neutral image shows no pins.
        """
        return self._sensor.design()

    def _mechanics(self, variant: Variant) -> str:
        """Return the name of the randomization of the mechanics of a variant's contacts."""
        name = variant.randomize_mechanics or self.settings.randomize_mechanics
        return name if name != AUTO else self._sensor.mechanics() if variant.calibrated else "real"

    def simulated(self, variant: Variant = Variant()) -> tuple[Samples, Samples]:
        """Return training and validation samples of a variant, simulated if they do not exist."""
        if variant.calibrated:
            design = self.design()
        else:
            design = with_usual_gel(nearest_nominal_design(self._pins(), self.samples.size))
        jobs = [self._job(design, variant, split) for split in ("val", "train")]
        make(jobs, self._workers, self.log)
        val, trained = (read_samples(job.folder) for job in jobs)
        return trained, val

    def _pins(self) -> float:
        """Return the median number of pins in a frame."""
        report = read_report(self.real)
        if report is None:
            raise TactipError(f"{self.real} has no import.json: import the set with tactip import")
        return report["pins"]["median"]

    def _job(self, design: Design, variant: Variant, split: Split) -> Job:
        s = self.settings
        symmetric = split == "train" and self.task == "surface"
        randomization = MECHANICS_RANDOMIZATIONS[self._mechanics(variant)]
        if not (variant.calibrated and s.design):  # a given design has its own gel
            randomization = with_other_gels(randomization)
        path, digest = self._learned_tip(design, randomized=not randomization.is_identity)
        configuration = Configuration(
            task=self.task,
            split=split,
            samples=self.contacts * (8 if symmetric else 1) if split == "train" else s.val_contacts,
            seed=s.seed,
            renderer="raster",
            design=design,
            fidelity=fidelity_named(self.simulated_fidelity),
            fast_tip=digest,
            pose=self._poses(),
            shear=SHEAR_RANGES if variant.sheared else Ranges(),
            augment_symmetry=symmetric,
            mechanics_randomization=randomization,
        )
        return Job(configuration, self.out / variant.contacts / split, path)

    @property
    def contacts(self) -> int:
        """Number of simulated contacts to train on."""
        return self.settings.contacts or _CONTACTS[self.task]

    @property
    def simulated_fidelity(self) -> FidelityName:
        """Fidelity of the contacts that are simulated, whether others are predicted or not."""
        name = self.settings.fidelity
        return "standard" if name in (AUTO, "fast") else name

    def _learned_tip(self, design: Design, randomized: bool) -> tuple[Path | None, str]:
        """Return file and checksum of the learned tip that predicts the contacts; none if all are simulated.

        Raises TactipError if `fast` was chosen by name, and the tip does not know the task or the design.
        """
        name = self.settings.fidelity
        if name not in (AUTO, "fast"):
            return None, ""
        path = any_materials(self._stimulus)
        tip = read_fast_tip(path)
        try:
            tip.check_design(design, randomized)
        except TactipError:
            if name == AUTO:
                return None, ""
            raise
        return path, tip.digest

    def _poses(self) -> Ranges:
        """Return the rig's ranges of poses. In the surface task all tilts get the widest range, and every pose touches."""
        ranges = {k: tuple(v) for k, v in self.samples.dataset.meta["configuration"]["pose"].items()}
        low, high = ranges["depth_mm"]
        ranges["depth_mm"] = (low, min(high, 0.0))
        if self.task == "surface":
            widest = max(abs(x) for name in ("roll_deg", "pitch_deg") for x in ranges[name])
            widest = min(widest, round(float(np.degrees(MAX_TILT_RAD)), 9))
            ranges |= {"roll_deg": (-widest, widest), "pitch_deg": (-widest, widest)}
            ranges |= {name: (0.0, 0.0) for name in ("x_mm", "y_mm", "yaw_deg")}
        return Ranges(**ranges)

    def network(self, variant: Variant = Variant()) -> Model:
        """Return the network trained on simulated samples of a variant only; it is trained if it does not exist."""
        folder, recipe = self.out / f"network-{variant.name}", self.recipe(variant)
        sets = self.simulated(variant)
        tips = self._drawing_tips(sets[0])
        drawn = self.settings.drawn_contacts
        if drawn and not tips:
            self.log(f"no contacts are drawn anew (--drawn-contacts): no learned tip predicted those in {sets[0].folder}")
        settings = replace(recipe.settings, drawn_contacts=drawn if tips else 0)
        train(*sets, recipe.network, settings, folder, self._device, self.log, init_from=self._init_from, tips=tips)
        return load_model(folder)

    def _drawing_tips(self, samples: Samples) -> list[FastTip]:
        """Return the learned tip that draws more contacts like those of a set: the one that predicted them, if one did."""
        predicted = configuration_of(samples).fast_tip
        return [read_fast_tip(any_materials(self._stimulus))] if predicted else []

    def real_network(self, count: int) -> Model:
        """Return the network trained on `count` real frames only, some of which are validation frames."""
        val = min(VAL_FRAMES, round(_MAX_VAL_FRACTION * count))
        known = self.split.known.take(slice(0, count))
        recipe = self._recipe(_STEPS)
        plain = replace(recipe.settings, augmented_fraction=0.0, undeformed_fraction=0.0, seed=self.settings.seed)
        network = replace(recipe.network, quantities=False)  # real frames have no forces
        folder = self.out / f"network-real-{count}"
        train(known.take(slice(val, None)), known.take(slice(0, val)), network, plain, folder, self._device, self.log)
        return load_model(folder)

    def corrected(self, count: int) -> Model:
        """Return the network trained on simulation with its output corrected linearly by `count` real frames."""
        folder = self.out / f"network-sim-corrected-by-{count}"
        write_corrected(self.network(), self.split.known.take(slice(0, count)), folder, self.log)
        return load_model(folder)

    def score(self, model: Estimator) -> dict[str, Any]:
        """Return the figures of a network on the real test frames."""
        return score(model, self.split.test)

    def keep(self, name: str, results: dict[str, Any]) -> dict[str, Any]:
        """Add results of an experiment to results.json, and return all of its content."""
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / RESULTS
        record = read_json(path) if path.exists() else {}
        record["real"] = {"set": self.real.name, "digest": self.samples.dataset.meta["digest"], "test": len(self.split.test)}
        counts = {"contacts": self.contacts, "real_train_frames": len(self.split.known)}
        record["settings"] = json.loads(json.dumps(asdict(self.settings) | counts))
        record[name] = results
        write_file(path, (json.dumps(record, indent=1) + "\n").encode())
        return record


def zero_shot(experiment: Experiment) -> dict[str, Any]:
    """Return the errors on real frames of a network trained in simulation only, and of one trained on real frames."""
    network = experiment.network()
    shear = real_shear(network, experiment.split.test, experiment.design(), experiment.settings.seed)
    return {
        "simulation": experiment.score(network) | ({"shear": shear} if shear else {}),
        "real": experiment.score(experiment.real_network(len(experiment.split.known))),
    }


def few_shot(experiment: Experiment) -> dict[str, Any]:
    """Return the errors of the network corrected by some real frames, and of networks trained on these only and on all."""
    known = len(experiment.split.known)
    counts = [n for n in experiment.settings.shots if MIN_FRAMES <= n <= known]
    for n in sorted(set(experiment.settings.shots) - set(counts)):
        why = f"the set has {known} to train on (--real-train-frames)" if n > known else f"at least {MIN_FRAMES} are needed"
        experiment.log(f"not with {n} real frames: {why}")
    out: dict[str, Any] = {}
    for n in counts:
        networks = {"corrected": experiment.corrected}
        if n >= _MIN_TRAIN_FRAMES:
            networks["alone"] = experiment.real_network
        out[str(n)] = {name: experiment.score(network(n)) for name, network in networks.items()}
    out.setdefault(str(known), {})["alone"] = experiment.score(experiment.real_network(known))
    return out


def ablate(experiment: Experiment) -> dict[str, Any]:
    """Return the errors of networks that were trained without one part of the simulation each."""
    return {what: experiment.score(experiment.network(variant)) for what, variant in ABLATIONS.items()}


def sim_to_real_gap_experiment(experiment: Experiment) -> dict[str, Any]:
    """Return the distances between real and simulated pins and images at the same pose and shear."""
    s, fidelity = experiment.settings, experiment.simulated_fidelity
    figures, arrays = sim_to_real_gap(experiment.split.test, experiment.design(), fidelity, s.gap_frames, s.seed)
    experiment.out.mkdir(parents=True, exist_ok=True)  # no design was written if one was given
    plot_gap(arrays, f"Distance of simulated from real pins, {experiment.real.name}", experiment.out / GAP)
    return figures


EXPERIMENTS = {"zero-shot": zero_shot, "ablate": ablate, "few-shot": few_shot, "gap": sim_to_real_gap_experiment}
"""Functions of an Experiment to its results, by name."""
