"""From simulation to a real sensor: what is learned without one real label, and what a few of them are worth.

    a real set ── neutral image ──► design ── contacts under varied mechanics ──► network ──► real test frames
               └─ some frames with labels ──────────────────────────────────► fine-tuned ──┘

Every step is kept in OUT and is not made again: a stopped command goes on where it was.
"""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tactip_twin.learning.data import Samples, read_samples
from tactip_twin.learning.model import find_model, load_model
from tactip_twin.learning.optics_ranges import noiseless
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.format import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import SHEAR_RANGES, Ranges
from tactip_twin.sim.parallel.worker_pool import worker_count
from tactip_twin.sim2real.importing.import_set import read_report
from tactip_twin.sim2real.transfer.fine_tune import FineTuning, fine_tune
from tactip_twin.sim2real.transfer.neutral_calibration import (
    camera_of,
    fit_design_to_neutral_image,
    nearest_nominal_design,
    with_camera_drift,
)
from tactip_twin.sim2real.transfer.settings import AUTO, GAP
from tactip_twin.sim2real.transfer.sim_gap import draw, sim_to_real_gap
from tactip_twin.tactip_model.design_file import write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import find_design

RESULTS = "results.json"

_HELD = 200
"""Real frames by which a training on real frames alone is stopped; of those that it is given."""

_LEAST_HELD = 0.2
"""... or this share of them, where they are few."""


_KNOWN, _MOST_KNOWN, _LEAST_KNOWN = 1500, 0.6, 20
"""Real frames whose labels may be used, if it is not told how many; at most this share of the set; and at least."""

_STILL = 0.02
"""A label that varies less than this share of its greatest value, as standard deviation, does not vary."""


@dataclass(frozen=True)
class RealSplit:
    """A real set in two parts, drawn from its rows."""

    known: Samples
    """Frames whose labels may be used."""
    test: Samples
    """Frames that are tested on, and nothing else."""


def split_of(samples, settings):
    """The RealSplit of Samples. settings: TransferSettings. Raises TactipError where the set is too small."""
    known = settings.real_frames
    if known is None:
        known = min(_KNOWN, round(_MOST_KNOWN * len(samples)))
        if known < _LEAST_KNOWN:
            raise TactipError(
                f"{samples.folder} has {len(samples)} frames: at least {round(_LEAST_KNOWN / _MOST_KNOWN)} are needed"
            )
    if len(samples) < known + 20:
        raise TactipError(
            f"{samples.folder} has {len(samples)} frames: with {known} to learn from, 20 or more must be "
            f"left to test on; ask for at most {max(0, len(samples) - 20)} by --real-frames"
        )
    order = np.random.default_rng(settings.seed).permutation(len(samples))
    return RealSplit(samples.take(order[:known]), samples.take(np.sort(order[known:])))


@dataclass(frozen=True)
class Variant:
    """How a network of simulation is made; None: as the settings have it."""

    name: str = "sim"
    """Part of its folder's name."""
    contacts: str = "sim"
    """Folder of its contacts: two that differ in images alone share them."""
    calibrated: bool = True
    """Whether the design is fitted to the sensor, or a preset."""
    sheared: bool = True
    """Whether its contacts are sheared."""
    mechanics: str | None = None
    """none or real."""
    noise: bool = True
    """Whether pins are off, of another size or missing, and light is where no pin is."""
    drawn: float | None = None
    """Share of the images that are drawn anew."""


ABLATIONS = {
    "all of it": Variant(),
    "without calibration": Variant("uncalibrated", "uncalibrated", calibrated=False),
    "without shear": Variant("unsheared", "unsheared", sheared=False),
    "without varied optics": Variant("one-camera", drawn=0.0),
    "without varied mechanics": Variant("one-tip", "one-tip", mechanics="none"),
    "without image noise": Variant("noiseless", noise=False),
}
"""What is left out, one at a time."""


class Experiment:
    """What the experiments on one real set share: its sensor's design, simulated sets, networks."""

    def __init__(self, real, out, settings, workers="auto", device="auto", say=print):
        """real: path of an imported set. out: path. settings: TransferSettings. workers, device: str. say: called with
        lines for the user.

        Raises TactipError where the set cannot be used.
        """
        self.real, self.out, self.settings = Path(real), Path(out), settings
        self._workers, self._device, self._say = worker_count(workers), device, say
        self.samples = read_samples(self.real)
        self.split = split_of(self.samples, settings)
        self.task = self.samples.labels.task
        depth = float(np.median(self.samples.dataset.poses[:, 2]))
        if depth > 0:
            raise TactipError(
                f"pose_z of {self.real} is {depth:g} mm in the middle, and must be negative into the object: import it anew "
                "with --columns pose_z=-COLUMN"
            )
        # What is not known is said before anything is made.
        fidelity_named(settings.fidelity)
        self.recipe()
        self._told = find_design(settings.design) if settings.design else None
        self._fitted = None
        self._start = find_model(settings.start) if settings.start else None

    def recipe(self, variant=Variant()):
        """The Recipe of a training on simulated samples of a Variant."""
        s, recipe = self.settings, self._recipe()
        drawn = s.drawn if variant.drawn is None else variant.drawn
        varied = replace(recipe.settings, drawn=drawn, optics=1.0, varied=self.optics(variant), seed=s.seed)
        return replace(recipe, settings=varied)

    def _recipe(self):
        recipe, least = recipe_named(self.settings.recipe, self.task), self.settings.least_steps
        return recipe if least is None else replace(recipe, settings=replace(recipe.settings, least_steps=least))

    def optics(self, variant=Variant()):
        """Name of the OpticsRanges that a Variant's images are drawn under; if uncalibrated, of an unknown camera."""
        measured = variant.calibrated and camera_of(self.real)
        name = self.settings.optics
        if name == AUTO:
            name = "steady" if measured else "real"
        return name if variant.noise else noiseless(name)

    def design(self):
        """The sensor's Design: as it was told, or fitted to the neutral image."""
        if self._told:
            told = with_camera_drift(self._told, camera_of(self.real))
            return replace(told, image=replace(told.image, size_px=self.samples.size))
        if self._fitted is None:
            self._say("the tip and its camera are fitted to its image at rest")
            self._fitted, figures = fit_design_to_neutral_image(self.real, self.samples.size)
            if figures["pressed_mm"]:
                self._say(
                    f"there is no such image: a press of {figures['pressed_mm']:.2f} mm is taken off its shallowest frames"
                )
            self.out.mkdir(parents=True, exist_ok=True)
            write_design(self.out / "design.json", self._fitted, {"neutral_image_of": self.real.name, **figures})
        return self._fitted

    def simulated(self, variant=Variant()):
        """Training and validation Samples of a Variant, made if they are not there."""
        design = self.design() if variant.calibrated else nearest_nominal_design(self._pins(), self.samples.size)
        jobs = [self._job(design, variant, split) for split in ("val", "train")]
        make(jobs, self._workers, self._say)
        val, trained = (read_samples(job.folder) for job in jobs)
        return trained, val

    def _pins(self):
        """Pins that are seen in most frames."""
        report = read_report(self.real)
        if report is None:
            raise TactipError(f"{self.real} has no import.json: it is no set that tactip import made")
        return report["pins"]["median"]

    def _job(self, design, variant, split):
        s = self.settings
        symmetric = split == "train" and self.task == "surface"
        configuration = Configuration(
            task=self.task,
            split=split,
            samples=s.contacts * (8 if symmetric else 1) if split == "train" else s.held,
            seed=s.seed,
            renderer="raster",
            design=design,
            fidelity=fidelity_named(s.fidelity),
            pose=self._poses(),
            shear=SHEAR_RANGES if variant.sheared else Ranges(),
            symmetric=symmetric,
            mechanics=MECHANICS_RANDOMIZATIONS[variant.mechanics or s.mechanics],
        )
        return Job(configuration, self.out / variant.contacts / split)

    def _poses(self):
        """Ranges of poses: those that the rig was told to go through. In the surface task every tilt is as wide as the
        widest, and the tip is in touch."""
        told = {k: tuple(v) for k, v in self.samples.dataset.meta["configuration"]["pose"].items()}
        low, high = told["depth_mm"]
        told["depth_mm"] = (low, min(high, 0.0))
        if self.task == "surface":
            widest = max(abs(x) for name in ("roll_deg", "pitch_deg") for x in told[name])
            told |= {"roll_deg": (-widest, widest), "pitch_deg": (-widest, widest)}
            told |= {name: (0.0, 0.0) for name in ("x_mm", "y_mm", "yaw_deg")}
        return Ranges(**told)

    def network(self, variant=Variant()):
        """The Model that was trained on simulated samples of a Variant alone; trained if it is not there."""
        folder, recipe = self.out / f"network-{variant.name}", self.recipe(variant)
        sets = self.simulated(variant)
        train(*sets, recipe.network, recipe.settings, folder, self._device, self._say, start=self._start)
        return load_model(folder)

    def real_network(self, count):
        """The Model that was trained on `count` real frames alone, a part of them held to stop by."""
        held = min(_HELD, round(_LEAST_HELD * count))
        known = self.split.known.take(slice(0, count))
        recipe = self._recipe()
        plain = replace(recipe.settings, drawn=0.0, seed=self.settings.seed)
        folder = self.out / f"network-real-{count}"
        train(
            known.take(slice(held, None)), known.take(slice(0, held)), recipe.network, plain, folder, self._device, self._say
        )
        return load_model(folder)

    def tuned(self, count):
        """The Model of simulation, fine-tuned with `count` real frames."""
        folder = self.out / f"network-sim-and-{count}"
        base, (trained, _) = self.network(), self.simulated()
        settings = FineTuning(self.settings.seed, self.settings.tuning_steps, optics=self.optics())
        fine_tune(base, trained, self.split.known.take(slice(0, count)), settings, folder, self._device, self._say)
        return load_model(folder)

    def score(self, model):
        """Figures (dict) of a Model on the real test frames."""
        return score(model, self.split.test)

    def keep(self, name, results):
        """Add results (dict) of an experiment to results.json. Returns all of it."""
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / RESULTS
        record = json.loads(path.read_text()) if path.exists() else {}
        record["real"] = {"set": self.real.name, "digest": self.samples.dataset.meta["digest"], "test": len(self.split.test)}
        record["settings"] = json.loads(json.dumps(asdict(self.settings) | {"real_frames": len(self.split.known)}))
        record[name] = results
        write_file(path, (json.dumps(record, indent=1) + "\n").encode())
        return record


def score(model, samples):
    """Errors of a Model on Samples of a real set: dict of mae, rmse, bias, and mae with the depth's zero taken out.

    Where a label's zero lies is not known of a rig better than to some tenths of a millimetre: for the depth, and for it
    alone, the median error is also taken out (`mae_zeroed`). Components that do not vary in the set are not what it can tell
    of: `varies` says which do.
    """
    errors = model.predict(samples.images) - samples.targets
    names = samples.labels.names
    zeroed = errors - np.where([name == "pose_z" for name in names], np.median(errors, 0), 0.0)

    varies = samples.targets.std(0) > _STILL * samples.labels.scale

    def by_name(values):
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    return {
        "samples": len(samples),
        "mae": by_name(np.abs(errors).mean(0)),
        "mae_zeroed": by_name(np.abs(zeroed).mean(0)),
        "rmse": by_name(np.sqrt((errors**2).mean(0))),
        "bias": by_name(errors.mean(0)),
        "varies": {name: bool(v) for name, v in zip(names, varies, strict=True)},
    }


def zero_shot(experiment):
    """Simulation alone against real frames, beside a network trained on real frames. Returns results (dict)."""
    return {
        "simulation": experiment.score(experiment.network()),
        "real": experiment.score(experiment.real_network(len(experiment.split.known))),
    }


def few_shot(experiment):
    """What some real frames are worth: fine-tuned, against trained on them alone, and on all. Returns results (dict)."""
    known = len(experiment.split.known)
    counts = [n for n in experiment.settings.shots if n <= known]
    out = {"0": {"fine_tuned": experiment.score(experiment.network())}}
    for n in counts:
        alone = {"alone": experiment.score(experiment.real_network(n))} if n >= 20 else {}
        out[str(n)] = {"fine_tuned": experiment.score(experiment.tuned(n)), **alone}
    out.setdefault(str(known), {})["alone"] = experiment.score(experiment.real_network(known))
    return out


def ablate(experiment):
    """What each part of the simulation is worth: networks that were made without it. Returns results (dict)."""
    return {what: experiment.score(experiment.network(variant)) for what, variant in ABLATIONS.items()}


def sim_to_real_gap_experiment(experiment):
    """Pins and images of real frames beside simulated ones at the same pose and shear. Returns results (dict)."""
    s = experiment.settings
    figures, arrays = sim_to_real_gap(experiment.split.test, experiment.design(), s.fidelity, s.gap_frames, s.seed)
    experiment.out.mkdir(parents=True, exist_ok=True)  # a design that was told is not written there
    draw(arrays, f"simulated from real pins, {experiment.real.name}", experiment.out / GAP)
    return figures


EXPERIMENTS = {"zero-shot": zero_shot, "ablate": ablate, "few-shot": few_shot, "gap": sim_to_real_gap_experiment}
"""By name: a function of an Experiment to its results (dict)."""
