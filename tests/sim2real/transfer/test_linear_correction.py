"""A network whose errors are linear in the pose is corrected by a few frames, and stays a network like any other."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.learning_sets import write_fake_splits
from helpers.trainings import NET, QUICK, quiet
from tactip_twin.learning.data import read_splits
from tactip_twin.learning.model import load_model
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.sim2real.transfer.linear_correction import (
    corrected,
    estimates_and_features,
    fit_linear_correction,
    write_corrected,
)
from tactip_twin.sim2real.transfer.score import score
from tactip_twin.tactip_model.errors import TactipError

UNITS = ("mm", "°", "°")
VARY = np.array([True, True, True])
NONE = np.empty((100, 0))
MATRIX = np.array([[1.15, 0.01, 0.0], [0.1, 0.95, -0.05], [0.0, 0.05, 1.1]])


def poses(count, seed=0):
    return np.random.default_rng(seed).uniform([-5, -15, -15], [-1, 15, 15], (count, 3))


def test_linear_errors_are_found():
    """Without noise, the prior has no weight: the labels come out exactly."""
    estimates = poses(40)
    labels = estimates @ MATRIX.T + [0.5, -3.0, 1.0]
    correction = fit_linear_correction(estimates, NONE[:40], labels, UNITS, VARY)
    assert np.allclose(correction.matrix, MATRIX, atol=1e-3)
    others = poses(100, seed=1)
    assert np.allclose(correction(others, NONE), others @ MATRIX.T + [0.5, -3.0, 1.0], atol=1e-2)
    assert np.allclose(correction.leverages.sum(0), 4.0, atol=1e-2)


def test_few_noisy_frames_do_not_distort():
    """Five frames with the noise of a rig's labels: better than no correction, and gains keep near to 1."""
    rng, noise, before, after = np.random.default_rng(0), np.array([0.1, 1.5, 1.5]), [], []
    for seed in range(20):
        true = poses(205, seed)
        estimates = (true - [0.4, 2.0, 0.0]) @ np.diag([0.87, 1.0, 1.0])
        labels = true + rng.normal(size=true.shape) * noise
        correction = fit_linear_correction(estimates[:5], NONE[:5], labels[:5], UNITS, VARY)
        before.append(np.abs(estimates[5:] - true[5:]).mean(0))
        after.append(np.abs(correction(estimates[5:], np.empty((200, 0))) - true[5:]).mean(0))
        assert np.all(np.abs(np.diag(correction.matrix) - 1) < 0.3)
        assert correction.leverages[:, 0].sum() < 4
    assert np.mean(after, 0)[0] < 0.7 * np.mean(before, 0)[0]
    assert np.mean(after, 0)[1] < 0.7 * np.mean(before, 0)[1]


def test_component_that_does_not_vary_gets_an_offset_only():
    estimates = poses(50)
    labels = estimates.copy()
    labels[:, 2] = 0.0
    features = np.random.default_rng(1).normal(size=(50, 20))
    correction = fit_linear_correction(estimates, features, labels, UNITS, np.array([True, True, False]))
    assert not correction.by_features[2].any()
    assert np.array_equal(correction.matrix[2], [0, 0, 1]) and not correction.matrix[:2, 2].any()
    assert correction.offset[2] == pytest.approx(-estimates[:, 2].mean(), abs=0.5)


def labels_by_features(seed, factor):
    """Return estimates, features and labels of 250 frames; 30 features change the labels by about `factor` mm."""
    rng, estimates = np.random.default_rng(seed), poses(250, seed)
    features = rng.normal(size=(250, 30)) * np.geomspace(3, 0.1, 30)
    change = features @ rng.normal(size=(30, 3)) / 3 * [factor, 10 * factor, 10 * factor]
    noise = rng.normal(size=(250, 3)) * [0.05, 0.5, 0.5]
    return estimates, features, estimates + change + noise


@pytest.mark.parametrize(("factor", "better"), [(0.3, 0.6), (0.0, 1.1)])
def test_features_correct_what_poses_do_not_and_do_no_harm(factor, better):
    without, with_features = [], []
    for seed in range(10):
        estimates, features, labels = labels_by_features(seed, factor)
        for used, errors in ((features[:, :0], without), (features, with_features)):
            correction = fit_linear_correction(estimates[:50], used[:50], labels[:50], UNITS, VARY)
            errors.append(np.abs(correction(estimates[50:], used[50:]) - labels[50:]).mean(0))
    assert (np.mean(with_features, 0) < better * np.mean(without, 0)).all()


def test_frames_that_lag_behind_their_labels_count_less():
    errors = {}
    for lagging in (0, 6):
        rng, found = np.random.default_rng(3), []
        for seed in range(10):
            true = poses(130, seed)
            labels = true + rng.normal(size=true.shape) * [0.05, 0.5, 0.5]
            labels[:lagging] += [0.8, 8.0, 8.0]
            correction = fit_linear_correction(true[:30], NONE[:30], labels[:30], UNITS, VARY)
            found.append(np.abs(correction(true[30:], NONE) - true[30:]).mean(0))
        errors[lagging] = np.mean(found, 0)
    assert (errors[6] < 0.5 * np.array([0.8, 8.0, 8.0]) * 6 / 30).all()  # least squares have all of their mean
    assert (errors[0] < errors[6]).all()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corrected")
    splits = read_splits(write_fake_splits(folder / "set", samples=48))
    quiet(*splits, replace(NET, deviations=True, quantities=True), QUICK, folder / "network")
    return load_model(folder / "network"), splits[0]


def test_correction_is_in_the_weights(trained):
    model, samples = trained
    kept = {name: tensor.clone() for name, tensor in model.net.state_dict().items()}
    found, correction = corrected(model, samples)
    assert all((tensor == kept[name]).all() for name, tensor in model.net.state_dict().items())
    before, after = model.estimate(samples.images), found.estimate(samples.images)
    assert np.allclose(
        after.means[:, :3], correction(before.means[:, :3], estimates_and_features(model, samples.images)[1]), atol=1e-4
    )
    assert np.allclose(after.means[:, 3:], before.means[:, 3:], atol=1e-6)
    errors = [np.abs(e.means[:, :3] - samples.targets).mean(0) for e in (before, after)]
    assert (errors[1] < errors[0]).all()
    # Each component's standard deviations have one factor, and fit the errors.
    ratio = after.deviations / before.deviations
    assert np.allclose(ratio[:, 3:], 1, atol=1e-6) and np.allclose(ratio, ratio[0], rtol=1e-5)
    inside = (np.abs(after.means[:, :3] - samples.targets) < 2 * after.deviations[:, :3]).mean(0)
    assert (inside > 0.85).all()


def test_yaw_all_round_is_corrected_by_a_turn(tmp_path):
    """Without a jump where the yaw begins again: its outputs are a sine and a cosine."""
    pose = replace(POSE_RANGES["edge"], yaw_deg=(-180.0, 180.0))
    splits = read_splits(write_fake_splits(tmp_path / "set", "edge", samples=48, pose=pose))
    quiet(*splits, replace(NET, deviations=True), QUICK, tmp_path / "network")
    model, samples = load_model(tmp_path / "network"), splits[0]
    yaw = model.labels.circular
    estimates = model.predict(samples.images)
    assert yaw == 4 and np.abs(estimates[:, yaw]).max() <= 180
    # Labels of a rig whose zero is turned by 100 degrees.
    labels = estimates.copy()
    labels[:, yaw] = (labels[:, yaw] + 100 + 180) % 360 - 180
    found, correction = corrected(model, replace(samples, targets=labels))
    after = found.predict(samples.images)
    assert np.allclose(found.labels.unwrapped(after, labels), labels, atol=0.5)
    assert correction.offset[yaw] == pytest.approx(100, abs=0.5) and not correction.matrix[:yaw, yaw].any()
    assert np.abs(after[:, yaw]).max() <= 180
    # And the score counts 359 degrees as one.
    whole = score(found, replace(samples, targets=np.where(np.arange(5) == yaw, labels + 359, labels)))
    assert whole["mae"]["pose_Rz"] == pytest.approx(1.0, abs=0.5)


def test_written_network_is_kept_and_is_of_its_frames(trained, tmp_path):
    model, samples = trained
    write_corrected(model, samples.take(slice(0, 20)), tmp_path / "out")
    loaded = load_model(tmp_path / "out")
    assert np.allclose(
        loaded.predict(samples.images), corrected(model, samples.take(slice(0, 20)))[0].predict(samples.images)
    )
    assert loaded.provenance["real"]["samples"] == 20 and len(loaded.provenance["linear_correction"]["matrix"]) == 3
    said = []
    write_corrected(model, samples.take(slice(0, 20)), tmp_path / "out", said.append)
    assert said == [f"{tmp_path / 'out'} already holds this network"]
    with pytest.raises(TactipError, match="holds a corrected network with other settings"):
        write_corrected(model, samples.take(slice(0, 10)), tmp_path / "out")
    with pytest.raises(TactipError, match="needs at least 10 real frames, got 9"):
        write_corrected(model, samples.take(slice(0, 9)), tmp_path / "few")
    assert not (tmp_path / "few").exists()


def test_network_without_deviations_is_corrected_too(trained, tmp_path):
    _, samples = trained
    quiet(samples, samples.take(slice(0, 20)), NET, QUICK, tmp_path / "plain")
    found, _ = corrected(load_model(tmp_path / "plain"), samples)
    assert found.deviation_scale is None and found.estimate(samples.images).deviations is None
