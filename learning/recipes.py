"""Named networks and trainings, and files of them."""

import dataclasses
import json
from dataclasses import dataclass, fields, replace
from pathlib import Path

from tactip_twin.learning.posenet import PoseNetConfig
from tactip_twin.learning.train import TrainSettings
from tactip_twin.tactip_model.errors import TactipError, lookup


@dataclass(frozen=True)
class Recipe:
    """A network and how it is trained."""

    network: PoseNetConfig
    """What is trained."""
    settings: TrainSettings
    """How."""


_PAPER = {
    "surface": PoseNetConfig(),
    "edge": PoseNetConfig(filters=256, dense_layers=2, units=512, dropout=0.203, l1=1e-4, l2=3e-4, batch_size=16),
}
"""The paper's best: Table 2, where its text differs [P]."""

_LAPTOP = PoseNetConfig(
    conv_layers=4,
    filters=32,
    widening=2.0,
    most_filters=128,
    reduce=2,
    fold=True,
    halving="stride",
    further=1,
    dense_layers=3,
    units=256,
    activation="elu",
    group_norm=16,
    dropout=0.0,
    l1=0.0,
    l2=0.0,
    batch_size=32,
)

_LAPTOP_TRAINING = TrainSettings(
    epochs=36,
    least_steps=8000,
    patience=100000,
    rate=1.4e-3,
    muon=0.014,
    schedule="cosine",
    drawn=0.4,
    optics=0.2,
)

RECIPES = {
    "laptop": {
        "surface": Recipe(_LAPTOP, _LAPTOP_TRAINING),
        "edge": Recipe(_LAPTOP, replace(_LAPTOP_TRAINING, epochs=26, drawn=0.5)),
    },
    "paper": {task: Recipe(network, TrainSettings()) for task, network in _PAPER.items()},
}
"""By name and task. `laptop` is for two cores: per image, its convolutions multiply some 300 times less than the paper's for
the surface. `tactip bench learning` holds the two side by side."""


def recipe_named(name, task):
    """The Recipe of a name and a task. Raises TactipError that lists the names."""
    return lookup("task", task, lookup("recipe", name, RECIPES))


def read_recipe(path):
    """The Recipe in a JSON file: `network` and, if it has them, `settings`, as `tactip tune` and `tactip train` write them.

    Raises TactipError where it cannot be read, names what there is not, or a number is out of bounds.
    """
    try:
        given = json.loads(Path(path).read_text())
        parts = given["network"], given.get("settings", {})
        unknown = [
            f"{k}" for part, kind in zip(parts, (PoseNetConfig, TrainSettings), strict=True)
            for k in part if k not in {f.name for f in fields(kind)}
        ]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TactipError(f"{path} is no configuration of a network (JSON with `network`): {error!r}") from error
    if unknown:
        allowed = [f.name for kind in (PoseNetConfig, TrainSettings) for f in fields(kind)]
        raise TactipError(f"{path} names {', '.join(unknown)}: it may name {', '.join(allowed)}")
    return Recipe(PoseNetConfig(**parts[0]), TrainSettings(**parts[1]))


def recipe_json(recipe):
    """A Recipe as JSON text."""
    return json.dumps(dataclasses.asdict(recipe), indent=1) + "\n"
