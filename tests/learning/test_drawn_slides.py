"""Slides drawn in a training: the sliding tip's own, with the set's ranges and images, reproducible from the seed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.learning_sets import write_fake_set
from helpers.trainings import NET, quiet
from tactip_twin.learning.configuration import TrainSettings
from tactip_twin.learning.contact_sources import contact_source, drawing_tips
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.drawn_slides import SlideSource
from tactip_twin.learning.model import load_model
from tactip_twin.learning.quantities import QUANTITIES
from tactip_twin.sim.contact.curved_surface import sample_curvatures
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.smooth_surface import SmoothSurface
from tactip_twin.sim.contact.stimuli import stimulus_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.contact_sample import curved_stimulus, sample_motion
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.mechanics_randomization import MECHANICS_RANDOMIZATIONS
from tactip_twin.sim.dataset.sampling import POSE_RANGES, Ranges
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.fast_tip.fast_tip import shipped_fast_tip
from tactip_twin.sim.fast_tip.sliding_contact import SlidingContact, TouchedObject
from tactip_twin.sim.fast_tip.sliding_tip import SlidingTip, read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.pose import before_shear, sensor_in_contact, to_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import load_design

SNAPSHOTS = 4
RANGES = {"surface": replace(POSE_RANGES["surface"], depth_mm=(-4, -1.5)), "edge": POSE_RANGES["edge"]}
CURVATURES = {"surface": (-20.0, 50.0), "edge": (0.0, 0.0)}


def sliding_tip(samples) -> SlidingTip:
    """Return the sliding tip that draws contacts like those of a set."""
    (tip,) = drawing_tips(samples)
    assert isinstance(tip, SlidingTip)
    return tip


@pytest.fixture(scope="module", params=["surface", "edge"])
def samples(request, tmp_path_factory):
    """A set of sliding paths that the sliding tip predicts, on curved surfaces or on edges."""
    task = request.param
    path = shipped_sliding_tip(task, "tactip-127")
    configuration = Configuration(
        task=task,
        split="train",
        samples=3 * SNAPSHOTS,
        seed=0,
        renderer="raster",
        design=load_design("tactip-127"),
        fidelity=fidelity_named("standard"),
        pose=RANGES[task],
        shear=Ranges(x_mm=(-2, 2), y_mm=(-2, 2)),
        curvature_per_m=CURVATURES[task],
        varying_curvature_fraction=0.5 if task == "surface" else 0.0,
        snapshots_per_contact=SNAPSHOTS,
        fast_tip=read_sliding_tip(path).digest,
    )
    folder = tmp_path_factory.mktemp("slides") / task
    make([Job(configuration, folder, path)], 1, log=lambda line: None)
    return read_samples(folder)


@pytest.fixture(scope="module")
def source(samples):
    return contact_source(samples, drawing_tips(samples))


def test_drawn_slides_are_those_of_the_sliding_contact(samples, source):
    """Walked again by the class that servo runs use, with the same generators, pins and forces are the same."""
    task, design = samples.labels.task, load_design("tactip-127")
    c, names = source.configuration, [q.name for q in QUANTITIES]
    stimulus = curved_stimulus() if task == "surface" else stimulus_named("edge")
    compared = 0
    for seed in range(6):
        drawn = source.draw(SNAPSHOTS, np.random.default_rng(seed))
        rng = np.random.default_rng(seed).spawn(1)[0]
        pose, shear = sample_motion(c, rng)
        solid = SmoothSurface(sample_curvatures(rng, *CURVATURES[task], 0.5)) if task == "surface" else None
        path = SlidingPath(task, solid, c.pose, pose, rng)
        touched = TouchedObject(stimulus, path.truth, solid.distance if solid else stimulus.distance)
        contact = SlidingContact(sliding_tip(samples), design, touched, fidelity_named("standard"))
        start = sensor_in_contact(before_shear(pose, shear))
        if contact.touch_down(start, start) is None:
            continue
        stops = [sensor_in_contact(pose), *(sensor_in_contact(path.stride()) for _ in range(SNAPSHOTS - 1))]
        states = [contact.move(stop) for stop in stops]
        if contact.simulated_motions or not all(c.pose.contain(s.pose) for s in states):
            continue
        compared += 1
        np.testing.assert_allclose([s.pin_tips for s in states], drawn.pin_tips, atol=1e-8)
        np.testing.assert_allclose(samples.labels.of(to_mm_deg([s.pose for s in states])), drawn.targets, atol=1e-6)
        forces = drawn.quantities[:, names.index("force_x_N") : names.index("force_z_N") + 1]
        np.testing.assert_allclose([s.force_n for s in states], forces, atol=1e-5)
        shears = drawn.quantities[:, :2]
        np.testing.assert_allclose([1e3 * s.shear[:2] for s in states], shears, atol=1e-6)
    assert compared >= 3


def _with_pose(samples, **ranges):
    """Return samples whose configuration has other ranges of the pose."""
    meta = samples.dataset.meta
    pose = meta["configuration"]["pose"] | ranges
    dataset = replace(samples.dataset, meta=meta | {"configuration": meta["configuration"] | {"pose": pose}})
    return replace(samples, dataset=dataset)


def test_paths_do_not_depend_on_each_other(samples):
    """Many at once as one by one, on light paths that lose the contact again and again."""
    source = SlideSource(_with_pose(samples, depth_mm=[-1.0, 0.6]), sliding_tip(samples))
    paths = [source._path(rng) for rng in np.random.default_rng(7).spawn(15)]
    assert any(path.in_contact[:-1][~path.in_contact[1:]].any() for path in paths)  # some lift off
    together, alone = source._slide(paths), [source._slide([path]) for path in paths]
    order = np.argsort(together[2][:, -1])
    for k in range(4):
        each = np.concatenate([drawn[k] for drawn in alone])
        by = np.argsort(np.concatenate([drawn[2] for drawn in alone])[:, -1])
        np.testing.assert_allclose(together[k][order], each[by], atol=1e-5)


def test_fixed_components_are_drawn(samples):
    """A component without a range is met but for rounding."""
    source = SlideSource(_with_pose(samples, roll_deg=[0.0, 0.0], pitch_deg=[0.0, 0.0]), sliding_tip(samples))
    paths = [source._path(rng) for rng in np.random.default_rng(8).spawn(4)]
    assert np.mean([path.is_seen.sum() for path in paths]) > 0.9 * SNAPSHOTS


def test_draw_keeps_to_the_ranges_and_follows_its_generator(samples, source):
    first, again, other = (source.draw(30, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert torch.equal(first.images, again.images)
    assert np.array_equal(first.targets, again.targets)
    assert not np.array_equal(first.targets, other.targets)
    assert first.images.shape == (30, 128, 128)
    low, high = samples.labels.of(RANGES[samples.labels.task].bounds().T)
    assert ((first.targets > low - 1e-6) & (first.targets < high + 1e-6)).all()
    tips, directions = read_pins(samples.folder, samples.dataset.meta)
    assert np.array_equal(source.raster.render(tips, directions).numpy(), samples.images)


def test_train_on_drawn_slides_names_the_sliding_tip(samples, tmp_path):
    settings = TrainSettings(epochs=1, learning_rate=1e-3, drawn_contacts=8)
    quiet(samples, samples, replace(NET, downsample=4), settings, tmp_path / "run")
    assert load_model(tmp_path / "run").provenance["fast_tip"] == sliding_tip(samples).digest


def test_slides_that_no_tip_can_draw_raise(samples, tmp_path):
    task = samples.labels.task
    meta = samples.dataset.meta
    varied = {"mechanics_randomization": vars(MECHANICS_RANDOMIZATIONS["real"])}
    dataset = replace(samples.dataset, meta=meta | {"configuration": meta["configuration"] | varied})
    with pytest.raises(TactipError, match="contacts with slides of tips with varied mechanics, as the set in"):
        contact_source(replace(samples, dataset=dataset), drawing_tips(samples))
    with pytest.raises(TactipError, match="must be a file of the format 'tactip-twin sliding tip'"):
        drawing_tips(samples, shipped_fast_tip(task, "tactip-127"))
    imported = read_samples(write_fake_set(tmp_path / "imported", samples=2))
    with pytest.raises(TactipError, match="has no pins: set drawn_contacts to 0"):
        drawing_tips(imported)
    other = read_sliding_tip(shipped_sliding_tip("edge" if task == "surface" else "surface", "tactip-127"))
    with pytest.raises(TactipError, match=f"must be for '{task}'"):
        SlideSource(samples, other)
    impossible = replace(sliding_tip(samples), max_spread_m=0.0)
    with pytest.raises(TactipError, match="hardly any of those in the set's ranges"):
        SlideSource(samples, impossible).draw(1, np.random.default_rng(0))
