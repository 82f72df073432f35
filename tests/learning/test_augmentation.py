"""Augmentation: images rendered from pins under random optics, reproducible from the seed."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from helpers.learning_sets import add_pins, write_fake_set
from tactip_twin.learning.augmentation import OpticsAugmentation
from tactip_twin.learning.checkpoint import read_metrics
from tactip_twin.learning.configuration import PoseNetConfig, TrainSettings
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import load_network
from tactip_twin.learning.optics_ranges import OPTICS, OpticsRanges
from tactip_twin.learning.train import train
from tactip_twin.learning.training import Training
from tactip_twin.tactip_model.errors import Interrupted, TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


@pytest.fixture(scope="module")
def samples(tmp_path_factory, on_surface, design):
    """A set of 128 px with the pins and the images of four contacts."""
    folder = write_fake_set(tmp_path_factory.mktemp("drawn") / "set", samples=4, size=128)
    contacts = [on_surface([0, 0, -d, 0, 0, 0]) for d in (1, 2, 3, 4)]
    tips, directions = (np.array([getattr(c, k) for c in contacts]) for k in ("pin_tips", "directions"))
    add_pins(folder, tips, directions)
    images = [tactile_image(grey, design.image) for grey in Raster(design).render(tips, directions)]
    return replace(read_samples(folder), images=np.stack(images))


def test_render_plain_nearly_equals_set_images(samples):
    """The white pixels are equal in number and mostly in position; a pin has only about four."""
    drawn, plain = OpticsAugmentation(samples).render_plain(torch.arange(4)).numpy() > 0, samples.images > 0
    assert drawn.sum() == pytest.approx(plain.sum(), rel=0.02)
    assert (drawn & plain).sum() > 0.8 * (drawn | plain).sum()
    blobs = [cv2.connectedComponents(image.astype(np.uint8), connectivity=4)[0] - 1 for image in drawn]
    assert blobs == [127] * 4


def test_render_zero_fraction_equals_plain(samples):
    still = OpticsAugmentation(samples, 0.0)
    assert torch.equal(still.render(torch.arange(4)), still.render_plain(torch.arange(4)))


NONE = {"zoom": 0.0, "rotation_deg": 0.0, "drift": 0.0, "pin_size": 0.0}


def render_varied(samples, **ranges):
    """Return 200 images of the first sample under these ranges only, (200, 128, 128) bool, and its plain image."""
    drawn = OpticsAugmentation(samples, 1.0, OpticsRanges(**NONE | ranges))
    torch.manual_seed(0)
    chosen = torch.zeros(200, dtype=torch.int64)
    return drawn.render(chosen).numpy() > 0, drawn.render_plain(chosen[:1])[0].numpy() > 0


def blob_centres(image):
    """Return the centres (127, 2) of the white blobs of an image, px from its centre."""
    count, _, _, where = cv2.connectedComponentsWithStats(image.astype(np.uint8), connectivity=4)
    assert count == 128
    return where[1:] - 63.5


def test_render_drift_stays_in_range(samples):
    after, before = render_varied(samples, drift=0.02)
    shifts = np.array([blob_centres(i).mean(0) - blob_centres(before).mean(0) for i in after])
    assert np.abs(shifts).max() < 2.56 + 0.1
    assert np.abs(shifts).max(0).min() > 0.9 * 2.56


def test_render_turn_and_zoom_stay_in_range(samples):
    """The pins rotate or scale as a whole, and the maximum is near the end of the range."""

    def transforms(images, before):
        for image in images:
            a, b = blob_centres(image) @ [1, 1j], blob_centres(before) @ [1, 1j]
            near = np.abs(a[:, None] - b).argmin(1)
            yield (a * b[near].conj()).sum() / (np.abs(b[near]) ** 2).sum()

    turned = np.array(list(transforms(*render_varied(samples, rotation_deg=2.0))))
    assert np.abs(np.abs(turned) - 1).max() < 0.005
    assert 1.8 < np.degrees(np.abs(np.angle(turned))).max() < 2.1
    zoomed = np.array(list(transforms(*render_varied(samples, zoom=0.03))))
    assert np.degrees(np.abs(np.angle(zoomed))).max() < 0.1
    assert 0.027 < np.abs(np.abs(zoomed) - 1).max() < 0.032


def test_render_pin_size_scales_area(samples):
    area = render_varied(samples, pin_size=0.3)[0].sum((1, 2))
    assert area.max() / area.min() == pytest.approx((1.3 / 0.7) ** 2, rel=0.25)


def test_augmentation_without_pins_raises(tmp_path):
    samples = read_samples(write_fake_set(tmp_path / "set", samples=3))
    with pytest.raises(TactipError, match="only simulated sets have pins"):
        OpticsAugmentation(samples)
    add_pins(tmp_path / "set", np.zeros((2, 127, 3)), np.zeros((2, 127, 3)))
    with pytest.raises(TactipError, match=r"pin_tips must be finite float32 of shape \(3, 127, 3\)"):
        OpticsAugmentation(read_samples(tmp_path / "set"))


def test_train_augmented_is_resumable_and_differs_from_plain(samples, tmp_path):
    """The images of the set are unchanged, and an interrupted training resumes to the same losses."""

    def stop(history):
        if len(history) == 2:
            raise KeyboardInterrupt
        return False

    net = PoseNetConfig(conv_layers=2, filters=2, dense_units=4, batch_size=2, downsample=4)
    drawn, plain = (
        TrainSettings(epochs=5, learning_rate=1e-2, muon_learning_rate=1e-2, augmented_fraction=fraction)
        for fraction in (0.5, 0.0)
    )
    before = samples.images.copy()
    train(samples, samples, net, drawn, tmp_path / "whole", log=print, quiet=True)
    assert np.array_equal(samples.images, before)
    with pytest.raises(Interrupted):
        train(samples, samples, net, drawn, tmp_path / "interrupted", log=print, should_prune=stop, quiet=True)
    train(samples, samples, net, drawn, tmp_path / "interrupted", log=print, quiet=True)
    train(samples, samples, net, plain, tmp_path / "plain", log=print, quiet=True)
    losses = [[h["loss"] for h in read_metrics(tmp_path / name)] for name in ("whole", "interrupted", "plain")]
    assert losses[0] == losses[1]
    assert losses[0] != losses[2]


def test_deviations_include_what_an_unknown_camera_makes_uncertain(samples):
    """The shipped network errs more on images of other cameras, which their own rendering of the validation images shows."""
    start = load_network("surface-tactip-127")
    known = replace(samples, targets=np.array([[-d, 0.0, 0.0] for d in (1, 2, 3, 4)]))
    assert known.labels.names == start.labels.names

    def trained(ranges, renderings):
        settings = TrainSettings(epochs=1, learning_rate=1e-7, optics_ranges=ranges, augmented_fraction=0.5)
        training = Training(known, known, start.config, replace(settings, validation_renderings=renderings), init_from=start)
        training.train_epoch()
        return training.deviation_scale().factors[0][0], training.best_error  # of depth

    plain, lens, real = trained("real", 0), trained("lens", 20), trained("real", 20)
    assert real[0] > 1.2 * lens[0] and lens[0] > 1.5 * plain[0]
    assert plain[1] < lens[1] < real[1]
    assert real[1] == trained("real", 20)[1]


def test_cameras_zero_offset_match_lens(samples, design):
    cameras = OpticsAugmentation(samples, 1.0, OpticsRanges(**NONE, camera_height_m=1e-9))
    positions = cameras._cameras.project(cameras._tips)
    assert torch.allclose(positions, cameras._centres, atol=0.03)


def test_cameras_agree_on_neutral_pins_only(samples, design):
    """Each lens is fitted to the same neutral image, but pressed pins grow more for a near camera."""
    drawn = OpticsAugmentation(samples, 1.0, OpticsRanges(**NONE, camera_height_m=3e-3, camera_offset_m=0.5e-3))
    tips = torch.from_numpy(neutral_pins(design)[0].astype(np.float32))
    torch.manual_seed(0)
    neutral = drawn._cameras.project(tips.expand(100, -1, -1))
    pressed = drawn._cameras.project(drawn._tips[3:4].expand(100, -1, -1))
    assert neutral.std(0).norm(dim=-1).max() < 0.3
    moved = (pressed - neutral).norm(dim=-1)
    assert moved.std(0).max() > 0.05 * moved.mean()


def blob_counts(images):
    return np.array([cv2.connectedComponents(image.astype(np.uint8), connectivity=4)[0] - 1 for image in images])


def test_render_missing_pins_speckles_and_jitter(samples):
    missing = blob_counts(render_varied(samples, missing=0.1)[0])
    # A tenth of 127 is 12.7, and three standard deviations above it is 23.
    assert missing.max() == 127 and 127 - 24 < missing.min() < 127 - 10
    specks = blob_counts(render_varied(samples, speckles=5.0)[0])
    assert specks.max() > 129 and np.median(specks) < 132
    # The gaps of this tip's pins are at least three pixels, so merging smaller gaps has no effect.
    assert np.array_equal(*(render_varied(samples, merged_px=m)[0][0] for m in (0.0, 1.0)))
    off = render_varied(samples, jitter_px=0.5)[0][0]
    assert blob_counts([off])[0] > 120
    assert not np.array_equal(off, render_varied(samples)[1])


def test_salt_makes_single_pixels_white(samples):
    """Fractions of the pixels are 0.3 times the square of a uniform number, so 0.1 in the mean; pins stay white."""
    salted, plain = render_varied(samples, salt=0.3)
    assert (salted | plain == salted).all()
    fractions = (salted & ~plain).mean((1, 2)) / (~plain).mean()
    assert fractions.max() < 0.31 and 0.05 < fractions.mean() < 0.15
    assert np.median(fractions) == pytest.approx(0.3 / 4, abs=0.04)


@pytest.mark.parametrize("gap", [1.0, 2.0, 2.5])
def test_rasterize_soft_merges_close_discs(samples, gap):
    drawn, radius = OpticsAugmentation(samples), 3.0
    positions = torch.tensor([[[40.0, 64.0], [40.0 + 2 * radius + gap, 64.0]]])
    for soft, blobs in ((0.6 * gap, 2), (1.5 * gap, 1)):
        image = drawn._rasterize_soft(positions, torch.full((1, 2), radius), torch.full((1, 1, 1), soft)).numpy()
        assert blob_counts(image > 0) == [blobs]
    # A single disc keeps its size.
    alone = drawn._rasterize_soft(positions[:, :1], torch.full((1, 1), radius), torch.full((1, 1, 1), 2.0))
    assert torch.equal(alone, drawn._rasterize(positions[:, :1], torch.full((1, 1), radius)))


def test_render_rim_lights_stay_at_rim(samples):
    lit, plain = render_varied(samples, rim_lights=6.0)
    added = lit & ~plain
    assert added.any((1, 2)).mean() > 0.5
    y, x = np.nonzero(added.any(0))
    assert np.hypot(x - 63.5, y - 63.5).min() > 0.42 * 128


@pytest.mark.parametrize("name", OPTICS)
def test_render_named_ranges_keep_most_pins(samples, name):
    drawn = OpticsAugmentation(samples, 1.0, OPTICS[name])
    torch.manual_seed(0)
    images = drawn.render(torch.arange(4).repeat(20)).numpy()
    assert set(np.unique(images)) == {0, 255}
    assert 100 < np.median(blob_counts(images > 0)) < 140 or OPTICS[name].salt
    torch.manual_seed(0)
    assert np.array_equal(drawn.render(torch.arange(4).repeat(20)).numpy(), images)
