"""Outputs of a network: losses against closed forms, and what initial weights keep."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import norm

from helpers.learning_sets import add_pins, write_fake_set, write_fake_splits
from helpers.trainings import NET, QUICK, quiet
from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.labels import Labels
from tactip_twin.learning.model import load_model
from tactip_twin.learning.outputs import Layout, Split, losses, scaled_loss
from tactip_twin.learning.quantities import CONTACT_FORCE_N, QUANTITIES, contact_probability, forces_of
from tactip_twin.learning.training import Training
from tactip_twin.sim.dataset.format import EFFECTIVE_SHEARS, FORCES
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

FULL = replace(NET, deviations=True, quantities=True)
SURFACE = Labels("surface", (-5.0, -15.0, -15.0), (-1.0, 15.0, 15.0))
ALL_ROUND = Labels("edge", (-5.0, -5.0, -15.0, -15.0, -180.0), (5.0, -1.0, 15.0, 15.0, 180.0))


def random_split(m=40, n=3):
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(3, m, n, generator=generator, dtype=torch.float64)
    return Split(numbers[0], 0.3 * numbers[1] - 1), numbers[2]


@pytest.mark.parametrize("raw_log_deviation", [-1e4, 0.0, 271.0, 1e4])
def test_loss_is_finite_whatever_a_network_says(raw_log_deviation):
    """A network trained on 127 pins said 271 for the image of a 331-pin tip, and the weight of its loss overflowed."""
    layout = Layout(FULL, SURFACE)
    raw = torch.full((2, layout.size), 60.0)
    raw[:, layout.components :] = raw_log_deviation
    raw.requires_grad_()
    loss = losses(layout.split(raw), torch.zeros(2, layout.components), beta=1.0).mean()
    (gradient,) = torch.autograd.grad(loss, raw)
    assert torch.isfinite(loss) and torch.isfinite(gradient).all()


def test_losses_with_deviations_are_negative_log_likelihoods():
    split, targets = random_split()
    expected = -norm.logpdf(targets.numpy(), split.means.numpy(), split.log_deviations.exp().numpy()).sum(1)
    found = losses(split, targets, beta=0.0)
    assert np.allclose(found.numpy(), expected - 3 * 0.5 * np.log(2 * np.pi))


def test_scaled_loss_is_the_least_over_factors_of_the_deviations():
    split, targets = random_split()
    targets[::3, 1] = torch.nan
    found = float(scaled_loss(split, targets))

    def with_factors(logs):
        return float(losses(Split(split.means, split.log_deviations + torch.from_numpy(logs)), targets, beta=0.0).mean())

    assert found == pytest.approx(minimize(with_factors, np.zeros(3), tol=1e-12).fun, abs=1e-9)
    too_small = Split(split.means, split.log_deviations - torch.tensor([0.0, 2.0, 5.0]))
    assert float(scaled_loss(too_small, targets)) == pytest.approx(found)
    assert float(scaled_loss(Split(split.means, None), targets)) == float(
        losses(Split(split.means, None), targets, beta=0.0).mean()
    )


def test_losses_without_deviations_are_squared_errors():
    split, targets = random_split()
    found = losses(Split(split.means, None), targets, beta=0.5)
    assert np.allclose(found, (split.means - targets).square().sum(1))


def test_losses_beta_one_gives_means_the_gradient_of_squared_errors():
    """β = 1 weighs errors as half a squared error does; the deviation of the largest likelihood stays where it is."""
    split, targets = random_split()
    means = split.means.clone().requires_grad_()
    losses(Split(means, split.log_deviations), targets, beta=1.0).sum().backward()
    assert means.grad is not None
    assert torch.allclose(means.grad, split.means - targets)
    logs = (split.means - targets).abs().log().requires_grad_()
    losses(Split(split.means, logs), targets, beta=0.5).sum().backward()
    assert logs.grad is not None
    assert torch.allclose(logs.grad, torch.zeros_like(logs), atol=1e-12)


def test_losses_unknown_targets_do_not_count():
    split, targets = random_split()
    whole = losses(split, targets, 0.5)
    targets[3, 1], targets[5] = torch.nan, torch.nan
    found = losses(split, targets, 0.5)
    assert torch.isfinite(found).all()
    assert (found != whole).nonzero().flatten().tolist() == [3, 5]
    assert found[5] == 0


@pytest.mark.parametrize("deviations", [False, True])
def test_circular_component_has_no_end(deviations):
    """A yaw of 179 degrees is 2 degrees from one of -179, in the loss and in the estimates."""
    assert ALL_ROUND.circular == 4 and SURFACE.circular is None
    assert replace(ALL_ROUND, low=(*ALL_ROUND.low[:4], -100.0), high=(*ALL_ROUND.high[:4], 100.0)).circular is None
    layout = Layout(replace(NET, deviations=deviations, quantities=False), ALL_ROUND)
    assert layout.size == 5 * (1 + deviations) + 1
    raw = torch.zeros(3, layout.size, dtype=torch.float64)
    angles = torch.tensor([179.0, -179.0, 30.0], dtype=torch.float64).deg2rad()
    raw[:, 4], raw[:, -1] = angles.sin(), angles.cos()
    split, targets = layout.split(raw), torch.zeros(3, 5, dtype=torch.float64)
    assert torch.allclose(split.means[:, 4] * 180, torch.tensor([179.0, -179.0, 30.0], dtype=torch.float64))
    targets[:, 4] = torch.tensor([-179.0, 179.0, 28.0]) / 180
    assert torch.allclose(split.squares(targets)[:, 4], torch.tensor((2 / 180) ** 2, dtype=torch.float64), rtol=1e-3)
    targets[0, 4] = torch.nan
    assert split.squares(targets)[0, 4] == 0
    predictions = np.array([[0, 0, 0, 0, 179.0], [0, 0, 0, 0, -179.0], [0, 0, 0, 0, 30.0]])
    near = ALL_ROUND.unwrapped(predictions, np.array([[0.0, 0, 0, 0, -179], [0, 0, 0, 0, 179], [0, 0, 0, 0, 28]]))
    assert near[:, 4].tolist() == [-181.0, 181.0, 30.0]
    plain = predictions[:, :3]
    assert SURFACE.unwrapped(plain, plain + 400) is plain


def test_rows_of_a_circular_component_are_shared_with_its_like_only():
    round_edge, plain = (Layout(FULL, one) for one in (ALL_ROUND, replace(ALL_ROUND, high=(5.0, -1.0, 15.0, 15.0, 45.0))))
    assert (4, 4) in plain.rows_of(plain) and (4, 4) in round_edge.rows_of(round_edge)
    assert (round_edge.size - 1, round_edge.size - 1) in round_edge.rows_of(round_edge)
    assert (4, 4) not in round_edge.rows_of(plain) and (4, 4) not in plain.rows_of(round_edge)


@pytest.mark.parametrize(("deviations", "quantities"), [(False, False), (True, False), (False, True), (True, True)])
def test_layout_parts_fill_the_outputs(deviations, quantities):
    layout = Layout(PoseNetConfig(deviations=deviations, quantities=quantities), SURFACE)
    split = layout.split(torch.randn(2, layout.size))
    assert layout.components == split.means.shape[1] == 3 + quantities * len(QUANTITIES)
    assert (split.log_deviations is not None) == deviations
    assert layout.size == layout.components * (1 + deviations)


def test_initial_weights_keep_the_pose_when_outputs_are_added(splits, tmp_path):
    quiet(*splits, NET, QUICK, tmp_path / "pose")
    pose = load_model(tmp_path / "pose")
    images = splits[1].images
    training = Training(*splits, FULL, QUICK, init_from=pose)
    training.net.eval()
    with torch.inference_mode():
        found = training.net(torch.from_numpy(images[:, None] / np.float32(255)))[:, :3].numpy() * pose.labels.scale
    assert np.allclose(found, pose.predict(images), atol=1e-4)


def test_initial_weights_keep_the_deviations_when_the_ranges_change(splits, tmp_path):
    """Deviations are in mm, so labels with another scale need other biases."""
    quiet(*splits, FULL, QUICK, tmp_path / "full")
    model = load_model(tmp_path / "full")
    deeper = replace(POSE_RANGES["surface"], depth_mm=(-10, -1))
    wide = read_splits(write_fake_splits(tmp_path / "wide", samples=8, pose=deeper))
    training = Training(*wide, FULL, QUICK, init_from=model)
    training.net.eval()
    images = splits[1].images
    with torch.inference_mode():
        split = training.layout.split(training.net(torch.from_numpy(images[:, None] / np.float32(255))))
    found = split.log_deviations.exp().numpy() * [10, 15, 15, *(q.scale for q in QUANTITIES)]
    expected = replace(model, deviation_scale=None).estimate(images)
    assert np.allclose(found, expected.deviations, rtol=0.02)
    assert np.allclose(split.means[:, 0] * 10, expected.means[:, 0], atol=1e-4)


def test_training_quantities_need_a_set_that_has_them(splits):
    train, val = splits
    unknown = replace(train, quantities=np.full_like(train.quantities, np.nan))
    with pytest.raises(TactipError, match="no forces to learn from"):
        Training(unknown, val, FULL, QUICK)


def test_model_estimates_what_its_set_shows(data, splits, tmp_path):
    """The image shows the depth, and the force follows from it: both are learned, with deviations that fit the errors."""
    train, val = splits
    settings = replace(QUICK, epochs=60, learning_rate=3e-3)
    quiet(train, val, replace(FULL, dropout=0.0), settings, tmp_path / "run")
    model = load_model(tmp_path / "run")
    found = model.estimate(train.images)
    assert model.columns[:3] == ("pose_z", "pose_Rx", "pose_Ry")
    assert found.means.shape == found.deviations.shape == (len(train), 3 + len(QUANTITIES))
    force = model.columns.index("force_z_N")
    truth = train.dataset.measures["force_z_N"]
    assert np.abs(found.means[:, force] - truth).mean() < 0.4 * np.abs(truth - truth.mean()).mean()
    assert np.array_equal(found.means[:, :3], model.predict(train.images))
    # On images that nothing was fitted to, errors are as large as the deviations say: 0.94 to 1.38 with six seeds [M]. Those
    # on the training images are smaller, the more so the longer the training.
    test = read_samples(data / "test")
    estimated = model.estimate(test.images)
    z = (estimated.means[:, :3] - test.targets) / estimated.deviations[:, :3]
    assert 0.6 < np.nanstd(z) < 1.8
    touching = forces_of(train.quantities) > 0.1
    assert found.contact[touching].mean() > found.contact[~touching].mean() + 0.1


def test_undeformed_tip_is_part_of_the_training(tmp_path):
    """It shows the neutral pins, has no contact, force and effective shear, and does not say where the sensor is."""
    design = design_named("nominal-127")
    folder = write_fake_set(tmp_path / "train", samples=6, size=128)
    tips, directions = neutral_pins(design)
    add_pins(folder, np.repeat(tips[None], 6, 0), np.repeat(directions[None], 6, 0))
    image = tactile_image(Raster(design).render(tips, directions), design.image)
    samples = replace(read_samples(folder), images=np.repeat(image[None], 6, 0))
    training = Training(samples, samples, FULL, replace(QUICK, undeformed_fraction=0.3))
    assert training.steps_per_epoch == 1  # it is not a sample of its own
    assert np.mean(training._images[6].numpy() != image) < 0.02
    known = training._targets[6].numpy()[3:]
    assert torch.isnan(training._targets[6, :3]).all()
    assert [q.name for q, value in zip(QUANTITIES, known, strict=True) if value == 0] == [*EFFECTIVE_SHEARS, *FORCES]
    assert np.isnan(known).sum() == len(QUANTITIES) - 6
    training.train_epoch()
    assert all(torch.isfinite(p).all() for p in training.net.parameters())
    with pytest.raises(TactipError, match="only simulated sets have pins"):
        Training(read_samples(write_fake_set(tmp_path / "real", samples=4)), samples, FULL, training.settings)


def test_contact_probability_is_that_of_a_sufficient_force():
    deviations = np.full((3, 3), 0.02)
    found = contact_probability(np.array([0.0, CONTACT_FORCE_N, 0.2]), deviations)
    assert found == pytest.approx([norm.cdf(-2.5), 0.5, 1.0])
