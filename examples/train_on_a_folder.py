"""Train a small network on a folder of sets, DATA/train and DATA/val, and hold it against DATA/test."""

from dataclasses import replace
from pathlib import Path

import tyro

from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.evaluate import evaluate
from tactip_twin.learning.model import load_model
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train


def main(data: Path, out: Path = Path("runs/example"), epochs: int = 20, filters: int = 8):
    """data: folder of the sets. out: folder of the training. epochs: at least. filters: of the first layer."""
    train_samples, val_samples = read_splits(data)
    recipe = recipe_named("laptop", train_samples.labels.task)
    network = replace(recipe.network, filters=filters)
    # Images can be drawn anew, as the recipe does, where it is known where the pins are.
    drawn = recipe.settings.drawn if train_samples.dataset.simulated else 0.0
    settings = replace(recipe.settings, epochs=epochs, least_steps=0, drawn=drawn)
    train(train_samples, val_samples, network, settings, out)
    figures = evaluate(load_model(out), read_samples(data / "test")).figures
    for name, error in figures["mae"].items():
        print(f"{name}: {error:.3f} {'°' if '_R' in name else 'mm'}")


if __name__ == "__main__":
    tyro.cli(main)
