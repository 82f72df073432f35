"""Recipes from JSON files."""

import pytest

from helpers.trainings import NET, QUICK
from tactip_twin.learning.configuration import Recipe
from tactip_twin.learning.recipes import read_recipe, recipe_json
from tactip_twin.tactip_model.errors import TactipError


def test_read_recipe_round_trip_and_errors(tmp_path):
    recipe = Recipe(NET, QUICK)
    (tmp_path / "good.json").write_text(recipe_json(recipe))
    assert read_recipe(tmp_path / "good.json") == recipe
    for text, message in (
        ("{", "bad.json is not JSON"),
        ("[1]", "must be a recipe, JSON with `network`"),
        ('{"network": {"depth": 3}}', "network has no field 'depth': it has conv_layers"),
        ('{"network": {"filters": "many"}}', "network.filters must be a whole number, got 'many'"),
        ('{"network": {"filters": 1025}}', "filters must be a whole number from 1 to 1024, got 1025"),
    ):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(TactipError, match=message):
            read_recipe(tmp_path / "bad.json")
