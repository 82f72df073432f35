"""Train a small network on a folder of sets, DATA/train and DATA/val, and evaluate it on DATA/test."""

from dataclasses import replace
from pathlib import Path

import tyro

import tactip_twin as tt
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.recipes import recipe_named
from tactip_twin.learning.train import train


def main(data: Path, out: Path = Path("runs/example"), epochs: int = 20, filters: int = 8) -> None:
    """data: folder of the sets. out: folder of the training. epochs: at least. filters: of the first layer."""
    train_samples, val_samples = read_splits(data)
    recipe = recipe_named("laptop", train_samples.labels.task, train_samples.size)
    network, settings = replace(recipe.network, filters=filters), replace(recipe.settings, epochs=epochs, min_steps=0)
    if not train_samples.dataset.simulated:
        # Real frames have no forces to learn, and no pins from which images could be rendered again.
        network = replace(network, quantities=False)
        settings = replace(settings, augmented_fraction=0.0, undeformed_fraction=0.0)
    train(train_samples, val_samples, network, settings, out)
    figures = tt.evaluate(tt.load_network(str(out)), tt.read_samples(data / "test")).figures
    for name, error in figures["mae"].items():
        print(f"{name}: {error:.3f} {'°' if '_R' in name else 'mm'}")


if __name__ == "__main__":
    tyro.cli(main)
