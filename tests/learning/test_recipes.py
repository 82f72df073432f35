"""Recipes by name and from JSON files."""

import pytest

from helpers.trainings import NET, QUICK
from tactip_twin.learning.configuration import Recipe
from tactip_twin.learning.recipes import read_recipe, recipe_json, recipe_named
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


@pytest.mark.parametrize(
    ("size_px", "downsample"), [(64, 2), (130, 2), (128, 2), (256, 4), (360, 4), (384, 6), (1024, 8), (270, 2)]
)
def test_wider_images_are_folded_by_more_pixels(size_px, downsample):
    network = recipe_named("laptop", "edge", size_px).network
    assert network.downsample == downsample
    assert recipe_named("paper", "edge", size_px) == recipe_named("paper", "edge")


def test_an_image_whose_pixels_cannot_be_folded_is_refused():
    with pytest.raises(TactipError, match=r"downsample must be a divisor of the images' width, 129 px, .* got 2"):
        recipe_named("laptop", "surface", 129).network.last_size(129)
