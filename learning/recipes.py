"""Recipes by name and from JSON files."""

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

from tactip_twin.learning.configuration import MAX_DOWNSAMPLE, RECIPES, PoseNetConfig, Recipe, TrainSettings
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.errors import TactipError, lookup
from tactip_twin.tactip_model.input_files import read_json

USUAL_PX = 128
"""Width of the images that the recipes are made for, px."""


def recipe_named(name: str, task: str, size_px: int = USUAL_PX) -> Recipe:
    """Return the recipe of a name and a task for images of a width, px.

    A network with pixel_unshuffle downsamples an image of twice the width by twice as much, and so takes as long.

    Raises:
        TactipError: The name or the task is unknown; the message lists the valid ones.
    """
    recipe = lookup("task", task, lookup("recipe", name, RECIPES))
    network = recipe.network
    downsample = min(MAX_DOWNSAMPLE, network.downsample * max(1, size_px // USUAL_PX))
    if not network.pixel_unshuffle or size_px % downsample:
        return recipe
    return replace(recipe, network=replace(network, downsample=downsample))


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a JSON file with `network` and optionally `settings`, as written by `tactip tune`.

    Raises:
        TactipError: If the file cannot be read, has an unknown field, or a number is out of bounds.
    """
    given = read_json(path)
    if not isinstance(given, dict) or "network" not in given:
        raise TactipError(f"{path} must be a recipe, JSON with `network` and optionally `settings`, but has no `network`")
    network = from_dict(PoseNetConfig, given["network"], f"{path}: network")
    return Recipe(network, from_dict(TrainSettings, given.get("settings", {}), f"{path}: settings"))


def recipe_json(recipe: Recipe) -> str:
    """Return a recipe as JSON text."""
    return json.dumps(dataclasses.asdict(recipe), indent=1) + "\n"
