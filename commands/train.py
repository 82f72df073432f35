"""tactip train: a network on a data set."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from tactip_twin.assets import MODELS
from tactip_twin.commands._parsing import Command, last_value
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.configuration import RECIPES, DeviceName, PoseNetConfig, Recipe, RecipeName, TrainSettings
from tactip_twin.learning.recipes import read_recipe


@dataclass(frozen=True)
class Train(Command):
    """Train a network on a data set. Rerun to resume."""

    common = ("data", "out", "recipe", "config", "init_from", "device", "training.epochs", "training.seed")
    example = "tactip train --data data/surface --out runs/surface"

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the training."""
    recipe: RecipeName = "laptop"
    """Network and training that the options below change; their defaults are those of the recipe for the set's task."""
    config: Path | None = None
    """Instead of a recipe: a JSON file, as `tactip tune` writes best.json."""
    init_from: str = ""
    """A shipped network or the folder of a training, whose weights it begins with; at random if empty. Its layers are the
    recipe's then."""
    device: DeviceName = "auto"
    """Device; auto is the GPU if there is one."""
    threads: int | None = None
    """Threads of the network, at most one a core. Default: one a core."""
    network: PoseNetConfig = field(default_factory=PoseNetConfig)
    """The network."""
    training: TrainSettings = field(default_factory=TrainSettings)
    """The training."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Train":
        """Return the defaults: network and training of --config, or of --recipe for the task of --data, with --init-from's
        network."""
        data, recipe = _train_set(arguments), _recipe(arguments)
        training = recipe.settings
        if data is not None and not _is_simulated(data):
            training = _without_rendered_images(training)
        return cls(data=tyro.MISSING, out=tyro.MISSING, network=recipe.network, training=training)

    def run(self) -> int:
        with DelayedStatus("reading the sets"):
            from tactip_twin.learning.data import read_splits
            from tactip_twin.learning.device import device_named, set_threads
            from tactip_twin.learning.model import load_network
            from tactip_twin.learning.train import train

            device_named(self.device)
            set_threads(self.threads)
            start = load_network(self.init_from) if self.init_from else None
            train_samples, val_samples = read_splits(self.data)
        recipe = read_recipe(self.config) if self.config else RECIPES[self.recipe][train_samples.labels.task]
        if (
            recipe.settings.augmented_fraction
            and not self.training.augmented_fraction
            and not train_samples.dataset.simulated
        ):
            to_stderr(f"{train_samples.folder} has no pins: its images are taken as they are, and none is drawn anew")
        train(train_samples, val_samples, self.network, self.training, self.out, self.device, to_stderr, init_from=start)
        print(f"{self.out / 'model.json'} written")
        return 0


def _recipe(arguments: Sequence[str]) -> Recipe:
    """Return the recipe that the command line names. Raises TactipError where --config's file is not one."""
    config = last_value(arguments, "config")
    if config is not None:
        return read_recipe(config)
    name, start = last_value(arguments, "recipe"), last_value(arguments, "init-from")
    named = next((recipes for key, recipes in RECIPES.items() if key == name), RECIPES["laptop"])
    recipe = named[_task(_train_set(arguments))]
    if start:
        folder = MODELS / start if (MODELS / start).is_dir() else Path(start)
        if (folder / "model.json").is_file():
            return Recipe(read_recipe(folder / "model.json").network, recipe.settings)
    return recipe


def _train_set(arguments: Sequence[str]) -> Path | None:
    """Return the folder of the set to train on, where there is one."""
    data = last_value(arguments, "data")
    folder = None if data is None else Path(data) / "train"
    return folder if folder is not None and folder.is_dir() else None


def _task(folder: Path | None) -> str:
    """Return the task of a set, `surface` where it cannot be told: to read the set is what reports its errors."""
    from tactip_twin.tactip_model.errors import TactipError
    from tactip_twin.tactip_model.input_files import read_json

    try:
        task = read_json(folder / "meta.json")["configuration"]["task"] if folder else "surface"
    except (TactipError, KeyError, TypeError):
        return "surface"
    return "edge" if task == "edge" else "surface"


def _is_simulated(folder: Path) -> bool:
    """Return whether a set, or a shard of it, has the positions of its pins."""
    return next(folder.glob("**/pins.npz"), None) is not None


def _without_rendered_images(training: TrainSettings) -> TrainSettings:
    """Return the settings for a set without pins, from which no image can be rendered anew."""
    from dataclasses import replace

    return replace(training, augmented_fraction=0.0)
