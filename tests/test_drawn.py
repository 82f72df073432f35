"""Images drawn as training runs: other cameras, the same contacts; the same from the seed, at any epoch."""

from dataclasses import replace

import numpy as np
import pytest
from learning_sets import write_fake_set

from learning.drawn import DrawnImages, OpticsRanges
from learning.posenet import PoseNetConfig
from learning.samples import read_samples
from learning.train import TrainSettings, read_metrics, train
from tactip_model.errors import Stopped, TactipError
from tactip_model.image import tactile_image
from tactip_model.raster import Raster

FIXED = OpticsRanges(zoom=0, drift=0, pin_size=0, blur_px=0, exposure=0, threshold=0)


@pytest.fixture(scope="module")
def samples(tmp_path_factory, on_surface):
    """A set of 128 px with the pins of four contacts."""
    folder = write_fake_set(tmp_path_factory.mktemp("drawn") / "set", samples=4, size=128)
    contacts = [on_surface([0, 0, -d, 0, 0, 0]) for d in (1, 2, 3, 4)]
    tips, directions = (np.array([getattr(c, k) for c in contacts]) for k in ("tips", "directions"))
    np.savez(folder / "pins.npz", tips=tips, directions=directions)
    return read_samples(folder)


def test_without_variation_it_is_the_plain_image(samples, design, on_surface):
    drawn = DrawnImages(samples, 0, 3, FIXED)
    contact = on_surface([0, 0, -2, 0, 0, 0])
    plain = tactile_image(Raster(design).render(contact.tips, contact.directions), design.image)
    assert np.array_equal(drawn.image(1, 5), plain)


def test_images_last_so_many_epochs_and_are_the_same_after_a_kill(samples):
    whole = DrawnImages(samples, 0, 3)
    images = np.zeros((4, 128, 128), np.uint8)
    changed = []
    for epoch in range(7):
        before = images.copy()
        for start, some in whole.due(epoch):
            images[start : start + len(some)] = some
        changed.append([bool((a != b).any()) for a, b in zip(before, images, strict=True)])
        assert all(np.array_equal(images[i], whole.image(i, epoch)) for i in range(4))
    again = DrawnImages(samples, 0, 3)
    resumed = np.concatenate([some for _, some in again.due(6)])
    assert np.array_equal(resumed, images)
    assert sum(map(sum, changed[1:])) >= 4
    assert not changed[1][0] and not changed[2][0]
    assert not np.array_equal(DrawnImages(samples, 1, 3).image(0, 0), whole.image(0, 0))


def test_optics_vary_within_their_ranges(design):
    ranges, draw = OpticsRanges(), np.random.default_rng(0)
    varied = [ranges.vary(design, draw) for _ in range(200)]
    zoom = np.array([v.optics.zoom for v in varied])
    assert 0.011 < np.abs(zoom - 1).max() <= 0.012
    assert max(abs(v.optics.drift[1]) for v in varied) <= 0.008
    assert min(v.optics.blur_px for v in varied) >= 0.2 - 1e-9
    assert {v.materials for v in varied} == {design.materials}
    assert ranges.vary(replace(design, image=replace(design.image, threshold=None)), draw).image.threshold is None


def test_a_set_without_pins_is_refused(tmp_path):
    samples = read_samples(write_fake_set(tmp_path / "set", samples=3))
    with pytest.raises(TactipError, match="only simulated sets, which have pins"):
        DrawnImages(samples, 0, 2)
    np.savez(tmp_path / "set" / "pins.npz", tips=np.zeros((2, 127, 3)), directions=np.zeros((2, 127, 3)))
    with pytest.raises(TactipError, match="has 2 records for 3 images"):
        DrawnImages(samples, 0, 2)


def test_training_on_drawn_images(samples, tmp_path):
    """The set's own images stay what they are; stopped, it goes on to the same network; and it is not the plain one."""

    def stop(history):
        if len(history) == 2:
            raise KeyboardInterrupt
        return False

    net = PoseNetConfig(conv_layers=2, filters=2, units=4, batch_size=2, reduce=4)
    drawn, plain = (TrainSettings(epochs=5, rate=1e-2, redraw_every=every) for every in (2, 0))
    before = samples.images.copy()
    train(samples, samples, net, drawn, tmp_path / "whole", say=print, quiet=True)
    assert np.array_equal(samples.images, before)
    with pytest.raises(Stopped):
        train(samples, samples, net, drawn, tmp_path / "stopped", say=print, hopeless=stop, quiet=True)
    train(samples, samples, net, drawn, tmp_path / "stopped", say=print, quiet=True)
    train(samples, samples, net, plain, tmp_path / "plain", say=print, quiet=True)
    losses = [[h["loss"] for h in read_metrics(tmp_path / name)] for name in ("whole", "stopped", "plain")]
    assert losses[0] == losses[1]
    assert losses[0] != losses[2]
