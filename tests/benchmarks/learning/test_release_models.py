"""Shipped networks agree with their cards, and predict newly simulated contacts."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from helpers.learning_sets import write_fake_splits
from tactip_twin.assets import MODELS
from tactip_twin.benchmarks.learning import release_models as shipped
from tactip_twin.benchmarks.learning.options import ReleaseModelsOptions
from tactip_twin.commands import main as tactip
from tactip_twin.learning.configuration import PoseNetConfig, Recipe, TrainSettings
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.labels import labels_of
from tactip_twin.learning.model import load_network, net_sha256, shipped_models
from tactip_twin.learning.train import train
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, generator
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

CONTACTS = 6
SLOWER = ("edge-256px-tactip-127", "edge-tactip-331")
NAMES = ["edge-256px-tactip-127", "edge-any-tactip-127", "edge-any-yaw-tactip-127", "edge-tactip-127", "edge-tactip-331"]
NAMES += ["surface-256px-tactip-127"]
NAMES += ["surface-curved-256px-tactip-127", "surface-curved-tactip-127", "surface-tactip-127", "surface-tactip-331"]
TINY = Recipe(PoseNetConfig(conv_layers=1, filters=2, dense_units=4, batch_size=8), TrainSettings(epochs=1))


def test_shipped_models_are_listed():
    assert shipped_models() == NAMES


@pytest.mark.parametrize("name", shipped_models())
def test_card_agrees_with_its_network(name):
    folder = MODELS / name
    record, card = json.loads((folder / "evaluation.json").read_text()), (folder / "card.md").read_text()
    model = load_network(name)
    assert (folder / "model.pt").stat().st_size < shipped.MAX_BYTES
    # A few contacts on flat surfaces fail their checks, and more on ridges.
    asked, least = (600, 0.9) if "curved" in name else (1000, 0.995)
    assert least * asked <= record["samples"] <= asked
    assert record["test"]["digest"] != model.provenance["train"]["digest"]
    for component, error in record["mae"].items():
        assert re.search(rf"\| {component} \| [^|]+ \| {error:.3f} ", card)
    assert model.provenance["outcome"]["finished"]
    assert model.config.deviations and model.config.quantities and model.deviation_scale is not None
    for row in record["by_force"]:
        for component, error in row["mae"].items():
            assert component not in record["mae"] or f"{error:.3f}" in card
    assert model.labels == labels_of(model.provenance["train"]["configuration"])
    found = re.search(r"Initial weights: `([\w-]+)`", card)
    assert bool(found) == ("initial_weights" in model.provenance)
    if found and found.group(1) in shipped_models():  # the others are rows of the benchmark
        same = net_sha256(load_network(found.group(1)).net) == model.provenance["initial_weights"]
        assert same == ("of an earlier version" not in card)


@pytest.fixture(scope="module")
def contacts_of():
    """A function from a design's name and a task to contacts, which are simulated once for all networks."""

    @cache
    def simulated(design, task):
        simulator = RetryingSimulator(load_design(design), task, fidelity_named("standard"), QualityLimits())
        draws = [generator(991, task, "test", number) for number in range(CONTACTS)]
        return [simulator.simulate(POSE_RANGES[task].sample(draw), SHEAR_RANGES.sample(draw))[0] for draw in draws]

    return simulated


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in SLOWER else []) for n in shipped_models()]
)
def test_shipped_model_predicts_contacts_of_another_seed(contacts_of, name):
    """On a few contacts that are simulated here, the mean error is below 2.5 times that of the card."""
    model, of = load_network(name), re.sub(".*-(tactip-)", r"\1", name)
    design = load_design(of)
    design = replace(design, image=replace(design.image, size_px=model.size))
    contacts, raster = contacts_of(of, model.labels.task), Raster(design)
    images = [tactile_image(raster.render(one.pin_tips, one.directions), design.image) for one in contacts]
    errors = model.predict(np.stack(images)) - model.labels.of(np.array([to_mm_deg(one.pose) for one in contacts]))
    card = json.loads((MODELS / name / "evaluation.json").read_text())
    assert np.all(np.abs(errors).mean(0) < 2.5 * np.array(list(card["mae"].values())))


@pytest.mark.parametrize(
    ("kind", "name", "changes"),
    [
        ("plain", "surface-nominal-127", {}),
        ("curved", "surface-curved-nominal-127", {"curvature_per_m": (-20.0, 50.0)}),
    ],
)
def test_release_copies_and_evaluates_a_finished_training(tmp_path, kind, name, changes):
    """The test set is that of its kind, and the card has the commands that make the network again."""
    data = write_fake_splits(tmp_path / "data" / ("slides" if kind == "curved" else "plain") / "surface", **changes)
    places = {"data": tmp_path / "data", "runs": tmp_path / "runs", "out": tmp_path / "models"}
    options = ReleaseModelsOptions(row="laptop-large", **places)
    with pytest.raises(TactipError, match="no model in"):
        shipped.release_model(options)
    train(*read_splits(data), TINY.network, TINY.settings, tmp_path / "runs" / "surface" / "laptop-large", quiet=True)
    folder, record = shipped.release_model(options)
    assert folder.name == name
    assert record == json.loads((folder / "evaluation.json").read_text())
    card = (folder / "card.md").read_text()
    assert card.startswith(f"# {name}\n")
    assert f"{record['mae']['pose_z']:.3f} mm" in card
    assert ("the paper, real sensor" in card) == (kind == "plain")
    assert ("curvatures of -20 to 50 /m" in card) == (kind == "curved")
    assert "tactip bench learning --task surface --large-contacts 24 --only laptop-large" in card
    model = load_network(folder)
    assert model.labels.task == "surface"


def test_unknown_model_name_is_refused(tmp_path, capsys):
    assert tactip.main(["evaluate", "--model", "surface-tactip-9", "--data", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert f"neither a folder nor a shipped model: choose a folder or one of {', '.join(NAMES)}" in error
