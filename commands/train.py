"""tactip train, tune and evaluate."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from tactip_twin.commands._overrides import with_options
from tactip_twin.commands._progress import Waiting, to_stderr
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class NetworkOptions:
    """What is given replaces what the recipe or the configuration has (learning/posenet.py says what each is)."""

    conv_layers: int | None = None
    """Convolutions."""
    filters: int | None = None
    """Filters of the first."""
    widening: float | None = None
    """Filters of each over those of the one before."""
    most_filters: int | None = None
    """... up to so many."""
    blur_px: float | None = None
    """Blur of the image, px."""
    reduce: int | None = None
    """Squares of so many px are averaged."""
    fold: bool | None = None
    """Their pixels become channels instead."""
    halving: str | None = None
    """pool or stride: how a layer halves its image."""
    further: int | None = None
    """Convolutions that follow in each layer."""
    dense_layers: int | None = None
    """Dense layers."""
    units: int | None = None
    """Units of each."""
    activation: str | None = None
    """relu or elu."""
    batch_norm: bool | None = None
    """Batch normalisation."""
    group_norm: int | None = None
    """Group normalisation over so many filters each."""
    dropout: float | None = None
    """Share left out before each dense layer."""
    l1: float | None = None
    """Weight of L1."""
    l2: float | None = None
    """Weight of L2."""
    batch_size: int | None = None
    """Images a step."""


@dataclass(frozen=True)
class TrainOptions:
    """What is given replaces what the recipe or the configuration has (learning/train.py says what each is)."""

    seed: int | None = None
    """Seed of weights, order and dropout."""
    epochs: int | None = None
    """Most epochs."""
    least_steps: int | None = None
    """Steps for which a small set is gone through more often."""
    patience: int | None = None
    """Epochs without a better validation error before the end."""
    rate: float | None = None
    """Learning rate of Adam."""
    muon: float | None = None
    """Learning rate of Muon for the weights between layers; 0 for Adam alone."""
    decay: float | None = None
    """Its decay a step, of the schedule `paper`."""
    schedule: str | None = None
    """paper or cosine."""
    precision: str | None = None
    """float32, bfloat16, or auto."""
    drawn: float | None = None
    """Share of the images drawn anew at every step, under varied optics."""
    optics: float | None = None
    """How far optics are varied for that, 1 for all of their ranges."""


@dataclass(frozen=True)
class Train:
    """Train a network on a data set. Run again, it goes on where it stopped."""

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the training."""
    recipe: str = "laptop"
    """laptop or paper (learning/recipes.py)."""
    config: Path | None = None
    """Instead of a recipe: a JSON file, as `tactip tune` writes best.json."""
    start: str = ""
    """A shipped network or the folder of a training, whose weights it begins with; at random if empty. Its layers are the
    recipe's then."""
    device: str = "auto"
    """auto, cpu or cuda."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
    """Changes to the network."""
    training: TrainOptions = field(default_factory=TrainOptions)
    """Changes to the training."""

    def run(self):
        with Waiting("reading the sets"):
            from tactip_twin.learning.configuration import Recipe
            from tactip_twin.learning.data import read_splits
            from tactip_twin.learning.device import device_named
            from tactip_twin.learning.model import load_network
            from tactip_twin.learning.recipes import read_recipe, recipe_named
            from tactip_twin.learning.train import train

            device_named(self.device)
            given = read_recipe(self.config) if self.config else None
            start = load_network(self.start) if self.start else None
            train_samples, val_samples = read_splits(self.data)
        recipe = given or recipe_named(self.recipe, train_samples.labels.task)
        recipe = replace(recipe, network=start.config) if start and not given else recipe
        recipe = Recipe(with_options(recipe.network, self.network), with_options(recipe.settings, self.training))
        if recipe.settings.drawn and self.training.drawn is None and not train_samples.dataset.simulated:
            to_stderr(f"{train_samples.folder} has no pins: its images are taken as they are, and none is drawn anew")
            recipe = replace(recipe, settings=replace(recipe.settings, drawn=0.0))
        train(train_samples, val_samples, recipe.network, recipe.settings, self.out, self.device, to_stderr, start=start)
        print(f"{self.out / 'model.json'} written")
        return 0


@dataclass(frozen=True)
class SpaceOptions:
    """Limits of what is tried. What is not given is the paper's."""

    most_conv_layers: int | None = None
    """Most convolutions."""
    most_dense_layers: int | None = None
    """Most dense layers."""
    most_units: int | None = None
    """Most units of a dense layer."""
    blur_px: float | None = None
    """Blur of the image in every trial, px."""
    reduce: int | None = None
    """Squares of so many px are averaged in every trial: at 2 convolutions multiply a quarter."""


@dataclass(frozen=True)
class Tune:
    """Search for a network by TPE, each trial a training. Run again, it goes on where it stopped."""

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the search."""
    trials: int = 300
    """Trainings in all."""
    startup: int = 50
    """The first so many at random."""
    max_filters: int = 512
    """Most filters of a convolution; a CPU hardly trains more than 64."""
    jobs: int = 1
    """Trainings at a time."""
    cluster: str | None = None
    """Address of a Ray cluster (auto: this machine's; local: this machine alone). Needs the extra `cluster`."""
    seed: int = 0
    """Seed of the suggestions."""
    prune: bool = False
    """End trials that half of those before them had left behind by then."""
    device: str = "auto"
    """auto, cpu or cuda."""
    space: SpaceOptions = field(default_factory=SpaceOptions)
    """Other limits."""
    training: TrainOptions = field(default_factory=TrainOptions)
    """Changes to each training; the paper's otherwise."""

    def run(self):
        with Waiting("loading the libraries"):
            from tactip_twin.learning.configuration import SearchSpace, TrainSettings, TuneSettings
            from tactip_twin.learning.device import device_named
            from tactip_twin.learning.tune import tune

        device_named(self.device)
        if self.jobs < 1:
            raise TactipError(f"{self.jobs} jobs cannot work: ask for at least 1")
        settings = TuneSettings(
            trials=self.trials,
            startup=self.startup,
            seed=self.seed,
            prune=self.prune,
            space=with_options(SearchSpace(most_filters=self.max_filters), self.space),
            training=with_options(TrainSettings(), self.training),
        )
        if self.cluster:
            from tactip_twin.learning.tune_ray import tune_on_cluster

            results = tune_on_cluster(self.data, self.out, settings, self.jobs, self.cluster, self.device)
        else:
            results = tune(self.data, self.out, settings, self.jobs, self.device, to_stderr)
        good = [r for r in results if r["status"] == "ok"]
        print(f"{len(results)} trials, {len(good)} of them ended well: {self.out / 'best.json'} and tune.png written")
        return 0


@dataclass(frozen=True)
class Evaluate:
    """Hold a model against a set that it has not seen: errors by component, label and shear, worst cases, latency."""

    model: Path
    """Folder of a training, or the name of a shipped model."""
    data: Path
    """Folder of a set."""
    out: Path | None = None
    """Folder for evaluation.json, evaluation.md and pictures."""
    json: bool = False
    """Print one JSON object and nothing else."""
    device: str = "cpu"
    """auto, cpu or cuda."""

    def run(self):
        from json import dumps

        with Waiting("reading the set and the network"):
            from tactip_twin.learning.data import read_samples
            from tactip_twin.learning.device import device_named
            from tactip_twin.learning.evaluate import evaluate
            from tactip_twin.learning.evaluation_page import write_evaluation
            from tactip_twin.learning.model import load_network

            model, samples = load_network(self.model, device_named(self.device)), read_samples(self.data)
            evaluation = evaluate(model, samples)
        if self.out:
            write_evaluation(evaluation, samples, model, self.out)
        figures = evaluation.figures
        if self.json:
            print(dumps(figures))
            return 0
        for name, unit in zip(model.labels.names, model.labels.units, strict=True):
            mae, rmse, bias = (figures[key][name] for key in ("mae", "rmse", "bias"))
            print(f"{name}: mean error {mae:.3f} {unit}, rms {rmse:.3f} {unit}, bias {bias:+.3f} {unit}")
        print(f"{figures['samples']} samples; {figures['parameters']} parameters; {figures['latency_ms']:.1f} ms an image")
        if self.out:
            print(f"{self.out / 'evaluation.md'} written")
        return 0
