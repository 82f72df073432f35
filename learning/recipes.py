"""Recipes by name and from JSON files."""

import dataclasses
import json
from dataclasses import fields
from pathlib import Path

from tactip_twin.learning.configuration import RECIPES, PoseNetConfig, Recipe, TrainSettings
from tactip_twin.tactip_model.errors import TactipError, lookup


def recipe_named(name: str, task: str) -> Recipe:
    """Return the recipe of a name and a task. Raises TactipError, listing the valid names, if either is unknown."""
    return lookup("task", task, lookup("recipe", name, RECIPES))


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a JSON file with `network` and optionally `settings`, as written by `tactip tune`.

    Raises:
        TactipError: If the file cannot be read, has an unknown field, or a number is out of bounds.
    """
    try:
        given = json.loads(Path(path).read_text())
        parts = given["network"], given.get("settings", {})
        unknown = [
            f"{k}" for part, kind in zip(parts, (PoseNetConfig, TrainSettings), strict=True)
            for k in part if k not in {f.name for f in fields(kind)}
        ]  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TactipError(f"{path} must be a recipe, JSON with `network` and optionally `settings`: {error!r}") from error
    if unknown:
        allowed = [f.name for kind in (PoseNetConfig, TrainSettings) for f in fields(kind)]
        raise TactipError(f"unknown fields in {path}: {', '.join(unknown)}; choose from {', '.join(allowed)}")
    return Recipe(PoseNetConfig(**parts[0]), TrainSettings(**parts[1]))


def recipe_json(recipe: Recipe) -> str:
    """Return a recipe as JSON text."""
    return json.dumps(dataclasses.asdict(recipe), indent=1) + "\n"
