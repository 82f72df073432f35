"""tactip train: a network on a data set."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from tactip_twin.assets import MODELS
from tactip_twin.commands._parsing import Command, last_value
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.configuration import RECIPES, DeviceName, PoseNetConfig, Recipe, RecipeName, TrainSettings
from tactip_twin.learning.recipes import USUAL_PX, read_recipe, recipe_named


@dataclass(frozen=True)
class Train(Command):
    """Train a network on a data set. Rerun to resume."""

    common = (
        "data",
        "out",
        "recipe",
        "config",
        "init_from",
        "device",
        "training.epochs",
        "training.min_steps",
        "training.seed",
    )
    example = "tactip train --data data/surface --out runs/surface"

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the training."""
    recipe: RecipeName = "laptop"
    """Network and training. The options below change single settings; their defaults are the recipe's for the set's task and
    the width of its images."""
    config: Path | None = None
    """JSON file of network and training instead of a recipe, such as best.json of `tactip tune`."""
    init_from: str = ""
    """Initial weights: a shipped network or the folder of a training, whose layers then replace the recipe's. Default:
    random weights."""
    fast_tip: Path | None = None
    """Learned tip for --training.drawn-contacts, a file of `tactip fast-tip`; for sets of sliding paths and curved surfaces,
    of `tactip sliding-tip`. Default: the shipped one of the set's sensor and task."""
    device: DeviceName = "auto"
    """Device of the network; auto: the GPU if there is one."""
    threads: int | None = None
    """Number of threads of the network, at most one per core. Default: one per core."""
    network: PoseNetConfig = field(default_factory=PoseNetConfig)
    """Network."""
    training: TrainSettings = field(default_factory=TrainSettings)
    """Training."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Train":
        """Return the defaults: network and training of --config, or of --recipe for the task of --data, with --init-from's
        network."""
        data, recipe = _train_set(arguments), _recipe(arguments)
        network, training = recipe.network, recipe.settings
        if data is not None and not _can_be_rendered(data):
            training = replace(training, augmented_fraction=0.0, undeformed_fraction=0.0)
            named = last_value(arguments, "init-from") or last_value(arguments, "config")
            if not named and not _is_simulated(data):
                network = replace(network, quantities=False)
        return cls(data=tyro.MISSING, out=tyro.MISSING, network=network, training=training)

    def run(self) -> int:
        with DelayedStatus("reading the sets"):
            from tactip_twin.learning.contact_sources import drawing_tips
            from tactip_twin.learning.data import read_splits
            from tactip_twin.learning.device import device_named, set_threads
            from tactip_twin.learning.model import load_network
            from tactip_twin.learning.train import train

            device_named(self.device)
            set_threads(self.threads)
            start = load_network(self.init_from) if self.init_from else None
            train_samples, val_samples = read_splits(self.data)
            draws = self.fast_tip and self.training.drawn_contacts
            tips = drawing_tips(train_samples, self.fast_tip) if draws else ()
        recipe = read_recipe(self.config) if self.config else RECIPES[self.recipe][train_samples.labels.task]
        folder = train_samples.folder
        if recipe.settings.augmented_fraction and not self.training.augmented_fraction and not _can_be_rendered(folder):
            why = "grey images" if train_samples.grey else "no pins"
            to_stderr(f"{folder} has {why}: its images are taken as they are, without randomized optics")
        settings = self.network, self.training, self.out, self.device, to_stderr
        train(train_samples, val_samples, *settings, init_from=start, tips=tips)
        print(f"{self.out / 'model.json'} written")
        return 0


def _recipe(arguments: Sequence[str]) -> Recipe:
    """Return the recipe that the command line names. Raises TactipError if the file of --config is not one."""
    config = last_value(arguments, "config")
    if config is not None:
        return read_recipe(config)
    name, start = last_value(arguments, "recipe"), last_value(arguments, "init-from")
    folder = _train_set(arguments)
    known = name if name in RECIPES else "laptop"
    recipe = recipe_named(known, _task(folder), _size_px(folder))
    if start:
        folder = MODELS / start if (MODELS / start).is_dir() else Path(start)
        if (folder / "model.json").is_file():
            return Recipe(read_recipe(folder / "model.json").network, recipe.settings)
    return recipe


def _train_set(arguments: Sequence[str]) -> Path | None:
    """Return the folder of the training set, or None if there is none."""
    data = last_value(arguments, "data")
    folder = None if data is None else Path(data) / "train"
    return folder if folder is not None and folder.is_dir() else None


def _task(folder: Path | None) -> str:
    """Return the task of a set, or `surface` if it cannot be read."""
    return "edge" if folder and _configuration(folder).get("task") == "edge" else "surface"


def _size_px(folder: Path | None) -> int:
    """Return the width of a set's images, px, or that of most sets if it cannot be read."""
    configuration = {} if folder is None else _configuration(folder)
    design = configuration.get("design")
    image = design.get("image") if isinstance(design, dict) else configuration.get("layout")
    size = image.get("size_px") if isinstance(image, dict) else None
    return size if type(size) is int else USUAL_PX


def _configuration(folder: Path) -> dict[str, Any]:
    """Return the configuration of a set, empty if it cannot be read: reading the set later reports the error."""
    from tactip_twin.tactip_model.errors import TactipError
    from tactip_twin.tactip_model.input_files import read_json

    try:
        configuration = read_json(folder / "meta.json")["configuration"]
    except (TactipError, KeyError, TypeError):
        return {}
    return configuration if isinstance(configuration, dict) else {}


def _can_be_rendered(folder: Path) -> bool:
    """Return whether images of a set can be rendered again: its pins are known, and its images are binary."""
    from tactip_twin.sim.dataset.configuration import has_grey_images

    return _is_simulated(folder) and not has_grey_images(_configuration(folder))


def _is_simulated(folder: Path) -> bool:
    """Return whether a set, or a shard of it, has the positions of its pins."""
    return next(folder.glob("**/pins.npz"), None) is not None
