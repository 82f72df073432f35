"""Contacts drawn in a training: the learned tip's, with the set's images and ranges, reproducible from the seed."""

from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from helpers.learning_sets import write_fake_set
from helpers.trainings import NET, quiet
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import TrainSettings
from tactip_twin.learning.contact_sources import drawing_tips, not_drawn
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.drawn_contacts import ContactSource
from tactip_twin.learning.model import load_model
from tactip_twin.learning.pin_projection import PinProjection
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.learning.tactile_raster import TactileRaster
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, Ranges, generator
from tactip_twin.sim.fast_tip.fast_contacts import FastContacts
from tactip_twin.sim.fast_tip.fast_tip import FastTip, PinDecoder, any_materials, read_fast_tip, shipped_fast_tip
from tactip_twin.sim.fast_tip.materials import material_inputs
from tactip_twin.sim.fast_tip.randomized_contacts import RandomizedContacts
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.raster_renderer import Raster

SHEAR = Ranges(x_mm=(-5, 5), y_mm=(-5, 5), yaw_deg=(-5, 5))
"""Without tilts, so that the learned quantities name the whole motion."""


def press_tips(samples) -> list[FastTip]:
    """Return the learned tips that draw contacts like those of a set of single presses."""
    return [tip for tip in drawing_tips(samples) if isinstance(tip, FastTip)]


def with_pose(samples, **ranges):
    """Return samples whose set names other ranges of poses."""
    meta = samples.dataset.meta
    configuration = meta["configuration"]
    changed = configuration | {"pose": configuration["pose"] | ranges}
    return replace(samples, dataset=replace(samples.dataset, meta=meta | {"configuration": changed}))


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """A set of edges that the learned tip predicts."""
    path = shipped_fast_tip("edge", "tactip-127")
    configuration = Configuration(
        task="edge",
        split="train",
        samples=24,
        seed=0,
        renderer="raster",
        design=load_design("tactip-127"),
        fidelity=fidelity_named("standard"),
        pose=POSE_RANGES["edge"],
        shear=SHEAR,
        fast_tip=read_fast_tip(path).digest,
    )
    folder = tmp_path_factory.mktemp("drawn") / "set"
    make([Job(configuration, folder, path)], 1, log=lambda line: None)
    return read_samples(folder)


@pytest.fixture(scope="module")
def source(samples):
    return ContactSource(samples, press_tips(samples))


def test_drawn_contacts_are_those_of_the_learned_tip(samples, source):
    """Predicted again from their labels and shears, they have the same pins and forces."""
    drawn = source.draw(20, np.random.default_rng(1))
    names = [q.name for q in QUANTITIES]
    zero = np.zeros(20)
    x, z, roll, pitch, yaw = drawn.targets.T
    shear_x, shear_y, shear_yaw = drawn.quantities[:, :3].T
    poses = from_mm_deg(np.stack([x, zero, z, roll, pitch, yaw], 1))
    shears = from_mm_deg(np.stack([shear_x, shear_y, zero, zero, zero, shear_yaw], 1))
    contacts, trusted = FastContacts(press_tips(samples)[0], load_design("tactip-127")).predict(poses, shears)
    assert trusted.all()
    np.testing.assert_allclose([c.pin_tips for c in contacts], drawn.pin_tips, atol=1e-9)
    forces = drawn.quantities[:, names.index("force_x_N") : names.index("force_z_N") + 1]
    np.testing.assert_allclose([c.force_n for c in contacts], forces, atol=1e-6)
    low, high = POSE_RANGES["edge"].bounds()[[0, 2, 3, 4, 5]].T
    assert ((drawn.targets >= low) & (drawn.targets <= high)).all()


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_contacts_with_drawn_mechanics_are_those_of_each_tip(task):
    """Materials and pin lengths of each contact's own, in one batch as one by one."""
    design, tip = load_design("tactip-331"), read_fast_tip(any_materials(task))
    rng = np.random.default_rng(2)
    low, high = tip.ranges.T
    contacts = low + (high - low) * rng.random((12, 12))
    poses, shears = 0.7 * contacts[:, :6], 0.7 * contacts[:, 6:]
    mechanics = MECHANICS_RANDOMIZATIONS["real"].sample_many(design, 12, np.random.default_rng(4))
    again = np.random.default_rng(4)
    designs = [MECHANICS_RANDOMIZATIONS["real"].sample(design, again) for _ in range(12)]
    together = tip.predict_each(PinDecoder(design, tip.modes), poses, shears, mechanics)
    known = 0
    for k, one in enumerate(designs):
        alone = RandomizedContacts(tip, design).of(one)
        if alone is None:
            assert not together.trusted[k]
            continue
        known += 1
        (contact,), trusted = alone.predict(poses[k : k + 1], shears[k : k + 1])
        np.testing.assert_allclose(together.pin_tips[k], contact.pin_tips, atol=1e-8)
        np.testing.assert_allclose(together.directions[k], contact.directions, atol=1e-6)
        np.testing.assert_allclose(together.forces_n[k], contact.force_n, rtol=1e-4, atol=1e-6)
        assert together.trusted[k] == trusted[0]
    assert known >= 4


def test_draw_takes_the_mechanics_randomization_of_the_set(samples):
    """Other contacts of the same generator: their forces differ, because their materials do."""
    meta = samples.dataset.meta
    configuration = meta["configuration"] | {"mechanics_randomization": asdict(MECHANICS_RANDOMIZATIONS["real"])}
    dataset = replace(samples.dataset, meta=meta | {"configuration": configuration})
    randomized = replace(samples, dataset=dataset)
    source = ContactSource(randomized, press_tips(randomized))
    drawn = source.draw(30, np.random.default_rng(5))
    names = [q.name for q in QUANTITIES]
    alike = FastContacts(read_fast_tip(any_materials("edge")), load_design("tactip-127"))
    x, z, roll, pitch, yaw = drawn.targets.T
    zero = np.zeros(30)
    shear_x, shear_y, shear_yaw = drawn.quantities[:, :3].T
    poses = from_mm_deg(np.stack([x, zero, z, roll, pitch, yaw], 1))
    shears = from_mm_deg(np.stack([shear_x, shear_y, zero, zero, zero, shear_yaw], 1))
    contacts, _ = alike.predict(poses, shears)
    ratio = drawn.quantities[:, names.index("force_z_N")] / np.array([c.force_n[2] for c in contacts])
    assert 1.1 < np.quantile(ratio, 0.9) < 2 and 0.5 < np.quantile(ratio, 0.1) < 0.95


def test_edges_at_yaws_all_round_are_drawn(samples):
    """A tip that learned yaws of -45 to 45 degrees knows them all."""
    around = with_pose(samples, yaw_deg=[-180.0, 180.0])
    tips = press_tips(around)
    assert not_drawn(around, tips) == []
    yaws = ContactSource(around, tips).draw(400, np.random.default_rng(7)).targets[:, 4]
    assert np.histogram(yaws, 4, (-180, 180))[0].min() > 70


def test_light_contacts_are_drawn_by_the_tip_of_any_materials(samples):
    """The tip of the sensor itself knows depths from 1 mm. Together they draw as many light contacts as the ranges have."""
    lighter = with_pose(samples, depth_mm=[-5.0, 0.0])
    own, other = press_tips(lighter)
    assert press_tips(samples)[0].digest == own.digest and len(press_tips(samples)) == 1
    assert not_drawn(lighter, (own, other)) == not_drawn(samples, (own,)) == []
    (line,) = not_drawn(lighter, (own,))
    assert line.endswith("has z from -5 to 0, but the learned tips know -5 to -1 only: no other contacts are drawn")
    drawn = ContactSource(lighter, (own, other)).draw(1000, np.random.default_rng(6))
    x, z, roll, pitch, yaw = drawn.targets.T
    light = z > -1
    assert light.mean() == pytest.approx(1 / 5, abs=0.04)
    assert (z > -0.2).mean() == pytest.approx(0.2 / 5, abs=0.02)
    zero = np.zeros(light.sum())
    shear_x, shear_y, shear_yaw = drawn.quantities[light, :3].T
    poses = from_mm_deg(np.stack([x[light], zero, z[light], roll[light], pitch[light], yaw[light]], 1))
    shears = from_mm_deg(np.stack([shear_x, shear_y, zero, zero, zero, shear_yaw], 1))
    contacts, _ = FastContacts(other, load_design("tactip-127")).predict(poses, shears)
    np.testing.assert_allclose([c.pin_tips for c in contacts], drawn.pin_tips[light], atol=1e-8)


@pytest.mark.parametrize("task", ["surface", pytest.param("edge", marks=pytest.mark.slow)])
def test_tip_of_any_materials_knows_contacts_lighter_than_it_learned(task):
    """Between no touch and 0.2 mm, where it is trusted to draw, its pins are 0.02 mm from simulated ones in the mean."""
    design, tip = load_design("tactip-127"), read_fast_tip(any_materials(task))
    decoder, simulator = (
        PinDecoder(design, tip.modes),
        RetryingSimulator(design, task, fidelity_named("standard"), QualityLimits()),
    )
    pose = replace(POSE_RANGES[task], depth_mm=(-0.2, 0.0))
    errors = []
    for number in range(6):
        rng = generator(5, task, "test", number)
        motion = pose.sample(rng), SHEAR.sample(rng)
        contact, _ = simulator.simulate(*motion)
        predicted = tip.predict(decoder, *(m[None] for m in motion), material_inputs(design.materials))
        errors.append(np.linalg.norm(predicted.pin_tips[0] - contact.pin_tips, axis=1).mean())
    assert np.mean(errors) < 0.03e-3


def test_draw_follows_its_generator(source):
    first, again, other = (source.draw(5, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert torch.equal(first.images, again.images)
    assert np.array_equal(first.targets, again.targets)
    assert not np.array_equal(first.targets, other.targets)


def test_images_are_those_of_the_set(samples, source):
    """From the same pins, byte for byte; and by torch, as on a GPU, but for single pixels at the threshold."""
    tips, directions = read_pins(samples.folder, samples.dataset.meta)
    assert np.array_equal(source.raster.render(tips, directions).numpy(), samples.images)
    different = source.raster.render_in_torch(tips, directions).numpy() != samples.images
    assert different.sum() <= 3


@pytest.mark.parametrize(("blur_px", "constant"), [(1.1, -5.0), (0.0, -4.5), (0.5, 2.5)])
def test_images_by_torch_are_those_of_the_renderer_at_other_settings(samples, blur_px, constant):
    tips, directions = (a[:6].astype(float) for a in read_pins(samples.folder, samples.dataset.meta))
    design = load_design("tactip-127")
    image, optics = replace(design.image, threshold=(61, constant)), replace(design.optics, blur_px=blur_px)
    raster = TactileRaster(replace(design, image=image, optics=optics))
    different = raster.render_in_torch(tips, directions) != raster.render(tips, directions)
    assert different.sum() <= 3


def test_projection_agrees_with_renderer(samples):
    tips, directions = (a.astype(float) for a in read_pins(samples.folder, samples.dataset.meta))
    raster, projection = Raster(load_design("tactip-127")), PinProjection(load_design("tactip-127"))
    for ours, theirs in zip(
        projection.ellipses(torch.from_numpy(tips), torch.from_numpy(directions)),
        raster.ellipses(tips, directions),
        strict=True,
    ):
        np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-9)


@pytest.mark.parametrize(("drawn_epochs", "draws"), [(1, 4), (3, 2)])
def test_train_on_drawn_contacts_is_resumable(samples, tmp_path, monkeypatch, drawn_epochs, draws):
    """Contacts are drawn as often as asked for, also after an interruption; the model names the tip that drew them."""

    def stop(history):
        if len(history) == 2:
            raise KeyboardInterrupt
        return False

    drawn, draw = [], ContactSource.draw
    monkeypatch.setattr(ContactSource, "draw", lambda *a: drawn.append(1) or draw(*a))
    settings = TrainSettings(
        epochs=4, learning_rate=1e-3, augmented_fraction=0.5, drawn_contacts=20, drawn_epochs=drawn_epochs
    )
    net = replace(NET, quantities=True, deviations=True, downsample=4)
    quiet(samples, samples, net, settings, tmp_path / "whole")
    assert len(drawn) == draws
    with pytest.raises(Interrupted):
        quiet(samples, samples, net, settings, tmp_path / "cut", should_prune=stop)
    quiet(samples, samples, net, settings, tmp_path / "cut")
    quiet(samples, samples, net, replace(settings, drawn_contacts=0), tmp_path / "plain")
    losses = [[h["loss"] for h in read_metrics(tmp_path / name)] for name in ("whole", "cut", "plain")]
    assert losses[0] == losses[1]
    assert losses[0] != losses[2]
    assert load_model(tmp_path / "whole").provenance["fast_tip"] == press_tips(samples)[0].digest
    other = replace(press_tips(samples)[0], max_spread_m=1e-4)
    with pytest.raises(TactipError, match="fast_tip"):
        quiet(samples, samples, net, settings, tmp_path / "whole", tips=[other])


def test_contacts_that_no_tip_can_draw_raise(samples, tmp_path):
    imported = read_samples(write_fake_set(tmp_path / "imported", samples=2))
    with pytest.raises(TactipError, match="has no pins: set drawn_contacts to 0"):
        ContactSource(imported, press_tips(samples))
    meta = samples.dataset.meta
    dataset = replace(samples.dataset, meta=meta | {"configuration": meta["configuration"] | {"snapshots_per_contact": 2}})
    with pytest.raises(TactipError, match="a sliding tip must draw contacts like those in"):
        ContactSource(replace(samples, dataset=dataset), press_tips(samples))
    surface = read_fast_tip(shipped_fast_tip("surface", "tactip-127"))
    with pytest.raises(TactipError, match="must be for 'edge', got one for 'surface'"):
        ContactSource(samples, [surface])
    impossible = replace(press_tips(samples)[0], max_spread_m=0.0)
    with pytest.raises(TactipError, match="hardly any of those in the set's ranges"):
        ContactSource(samples, [impossible]).draw(2, np.random.default_rng(0))
