"""Pins are followed over frames, through large slow motions, missing blobs and back to rest."""

import numpy as np
import pytest

from tactip_twin.sim2real.sensor.pin_tracker import PinTracker

SPACING = 8.0


@pytest.fixture
def rest():
    """Places of the pins of a hexagonal grid within a disc."""
    i, j = np.meshgrid(np.arange(-8, 9), np.arange(-8, 9))
    grid = SPACING * np.stack([i + j / 2, np.sqrt(3) / 2 * j], -1).reshape(-1, 2)
    return grid[np.linalg.norm(grid, axis=1) < 6 * SPACING] + 64


def moved(rest, by):
    """Return pins that are shifted and stretched by `by`, 0 to 1: at 1 by twice their spacing."""
    return rest + by * (np.array([2 * SPACING, 0]) + 0.1 * (rest - 64))


def test_pins_that_move_by_more_than_their_spacing_are_told_apart(rest):
    tracker, rng = PinTracker(rest), np.random.default_rng(0)
    for by in [*np.linspace(0, 1, 25), *np.linspace(1, 0, 25)]:
        true = moved(rest, by)
        order = rng.permutation(len(true))[:-4]  # four blobs are missing
        found = tracker.track((true + rng.normal(0, 0.2, true.shape))[order])
        known = np.isfinite(found[:, 0])
        assert known.sum() >= len(order) - 2
        assert np.abs(found - true)[known].max() < 1.5


def test_pins_after_a_jump_are_identified_anew(rest):
    tracker = PinTracker(rest)
    true = moved(rest, 0.8)
    found = tracker.track(true)
    assert np.isfinite(found).all() and np.allclose(found, true)


def test_frame_without_blobs_loses_no_pin_for_good(rest):
    tracker = PinTracker(rest)
    assert np.isnan(tracker.track(np.zeros((0, 2)))).all()
    assert np.allclose(tracker.track(rest + 1.0), rest + 1.0)
