"""Detection and identification of pins."""

import numpy as np
import pytest

from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pin_detection import Blobs, PinMatcher, find_blobs
from tactip_twin.tactip_model.presets import design_named


def discs(centres, radius, size=256):
    """Return a binary image of discs at centres (n, 2) px."""
    y, x = np.mgrid[:size, :size]
    image = np.zeros((size, size), np.uint8)
    for cx, cy in centres:
        image[np.hypot(x - cx, y - cy) <= radius] = 255
    return image


def pressed(neutral, shift, expansion, turn):
    """Return the pins (p, 2) of a pressed tip: displaced outward, rotated and shifted."""
    middle = neutral.mean(0)
    away = neutral - middle
    r = np.linalg.norm(away, axis=1, keepdims=True) / 100
    c, s = np.cos(turn), np.sin(turn)
    return middle + (away * (1 + expansion * r * np.exp(-6 * r**2))) @ np.array([[c, s], [-s, c]]) + shift


def test_find_blobs_returns_centres():
    image = discs([(40, 50), (80.0, 51), (120, 160)], 3.0)
    image[200:203, 20:120] = 255  # a crescent at the rim
    blobs = find_blobs(image)
    assert len(blobs.centres) == 3
    assert np.allclose(np.sort(blobs.centres[:, 0]), [40, 80, 120], atol=0.01)
    assert find_blobs(np.zeros((64, 64), np.uint8)).centres.shape == (0, 2)


@pytest.mark.parametrize("name", ["tactip-127", "tactip-331"])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (9.0, -6.0), (-13.0, 4.0)])
def test_match_identifies_pins_moved_by_about_their_spacing(name, shift):
    neutral = neutral_px(design_named(name))
    moved = pressed(neutral, np.array(shift), 1.6, 0.05)
    spacing = np.sort(np.linalg.norm(neutral[:, None] - neutral[None], axis=2), 1)[:, 1].min()
    assert np.linalg.norm(moved - neutral, axis=1).max() > 0.7 * spacing
    order = np.random.default_rng(0).permutation(len(moved))
    blobs = find_blobs(discs([], 1))
    blobs = type(blobs)(moved[order] + np.random.default_rng(1).normal(0, 0.2, moved.shape))
    found = PinMatcher(neutral).match(blobs)
    assert np.linalg.norm(found - moved, axis=1).max() < 1.5


def test_matches_do_not_depend_on_the_frames_before():
    """What a matcher keeps from frame to frame depends on which pins are known, and not on where they are."""
    neutral, rng = neutral_px(design_named("tactip-127")), np.random.default_rng(0)
    frames = [pressed(neutral, rng.uniform(-9, 9, 2), rng.uniform(0, 1.6), 0.05)[rng.random(127) < 0.95] for _ in range(6)]
    kept = PinMatcher(neutral)
    again = [kept.match(Blobs(frame)) for frame in [*frames, *frames]]
    for k, frame in enumerate([*frames, *frames]):
        assert np.array_equal(again[k], PinMatcher(neutral).match(Blobs(frame)), equal_nan=True)
        assert np.isfinite(again[k][:, 0]).sum() >= len(frame) - 2


class Exhaustive(PinMatcher):
    """Gives no start up."""

    def _grow(self, tree, first, to_beat):
        return super()._grow(tree, first, -np.inf)


@pytest.mark.parametrize("name", ["tactip-127", "tactip-331"])
def test_starts_that_are_given_up_would_not_have_won(name):
    neutral, rng = neutral_px(design_named(name)), np.random.default_rng(1)
    for _ in range(5):
        seen = pressed(neutral, rng.uniform(-12, 12, 2), rng.uniform(0, 1.8), rng.uniform(-0.1, 0.1))
        seen = seen[rng.random(len(seen)) < 0.97] + rng.normal(0, 0.4, 2)
        found, all_tried = (one(neutral).match(Blobs(seen)) for one in (PinMatcher, Exhaustive))
        assert np.array_equal(found, all_tried, equal_nan=True) and np.isfinite(found).any()


def test_match_leaves_hidden_pins_nan():
    neutral = neutral_px(design_named("tactip-127"))
    hidden = [5, 60, 100]
    blobs = find_blobs(discs([], 1))
    seen = np.delete(neutral + [3.0, 2.0], hidden, axis=0)
    found = PinMatcher(neutral).match(type(blobs)(seen))
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == hidden
    assert np.isnan(PinMatcher(neutral).match(type(blobs)(seen[:2]))).all()
