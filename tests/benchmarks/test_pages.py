"""Tables in docs/ agree with the JSON beside them."""

import json
from importlib import import_module

import pytest

from tactip_twin.benchmarks.report import DOCS, fill

PAGES = {
    "transfer": "learning.transfer",
    "hidden_sensors": "learning.hidden_sensors",
    "fem_cross_check": "physics.fem_cross_check",
    "materials": "physics.materials",
    "mechanics": "physics.mechanics",
    "mesh_contact": "physics.mesh_contact",
    "scene_cost": "physics.scene_cost",
    "friction": "physics.friction",
    "stability": "physics.stability",
    "fidelity": "physics.fidelity_page",
    "learning": "learning.learning",
    "uncertainty": "learning.uncertainty",
    "any_materials": "learning.any_materials",
    "fast_tip": "learning.fast_tip",
    "sliding_tip": "learning.sliding_tip",
    "search": "learning.search",
    "performance": "scale.performance",
    "scale": "scale.scale",
    "servo": "servo.servo",
    "conventions": "learning.conventions",
    "hard_objects": "servo.hard_objects",
    "tracking": "servo.tracking",
    "reinforcement_learning": "servo.reinforcement_learning",
}
"""Page, and the module that makes its tables from the page's JSON."""


@pytest.mark.parametrize("name", PAGES)
def test_page_holds_the_tables_of_its_json(name):
    if name == "reinforcement_learning":
        pytest.importorskip("gymnasium")
    tables = import_module(f"tactip_twin.benchmarks.{PAGES[name]}").tables
    page = (DOCS / f"{name}.md").read_text()
    assert fill(page, tables(json.loads((DOCS / f"{name}.json").read_text()))) == page
