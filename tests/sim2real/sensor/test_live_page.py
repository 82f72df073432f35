"""The page of a camera shows where the network takes the contact to be, and warns outside of its range."""

import numpy as np
import pytest

from tactip_twin.learning.model import load_network
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.sim2real.sensor.live import Reading
from tactip_twin.sim2real.sensor.live_page import _BAD_COLOR, _GOOD_COLOR, _T_WORLD_SENSOR, CameraPage


@pytest.fixture(scope="module")
def page():
    page = CameraPage("camera", load_network("surface-tactip-127"), port=8471)
    yield page
    page.close()


def reading(depth_mm, number=0, **others):
    predicted = {"pose_z": depth_mm, "pose_Rx": 4.0, "pose_Ry": -3.0}
    rest = np.array([[x, y] for x in range(20, 100, 10) for y in range(20, 100, 10)], float)
    fields = {"fault": "", "deviations": {"pose_z": 0.1}, "pins_px": rest + 2, "rest_px": rest} | others
    return Reading(number, 0.5 * number, 64, np.zeros((128, 128), np.uint8), predicted, **fields)


def test_plate_is_at_the_estimated_contact(page):
    page.show(reading(-3.0), 20.0)
    T = _T_WORLD_SENSOR @ inverse(sensor_in_contact(from_mm_deg([0, 0, -3, 4, -3, 0])))
    assert page._plate.visible and np.allclose(page._plate.position, T[:3, 3])
    assert page._plate.color == tuple(map(round, _GOOD_COLOR))
    assert "| pose_z | -3.00 ± 0.10 mm |" in page._numbers.content
    assert "frame 0, 64 pins, 20.0 frames/s" in page._text.content


@pytest.mark.parametrize(
    ("depth_mm", "unlike", "text"),
    [(-30.0, "", "outside the trained range: pose_z"), (-3.0, "sharper than those in training", "sharper")],
)
def test_estimate_that_cannot_be_trusted_is_marked(page, depth_mm, unlike, text):
    page.show(reading(depth_mm, unlike=unlike), 20.0)
    assert page._plate.color == tuple(map(round, _BAD_COLOR))
    assert text in page._text.content


def test_moved_pins_have_arrows(page):
    page.show(reading(-3.0), 20.0)
    image = page._image.image
    assert image.shape == (384, 384, 3)
    assert 500 < (image[..., 0] > image[..., 2].astype(int) + 60).sum() < 20000


def test_curves_show_the_last_seconds(page):
    for number in range(1, 41):
        page.show(reading(-number / 10, number), 20.0)
    times, values, high, low = page._curves["pose_z"].data
    assert times[-1] == 20 and 9.5 <= times[-1] - times[0] <= 10
    assert np.allclose(values, -2 * times / 10) and np.allclose(high - low, 0.4)


def test_page_without_a_network_shows_the_image():
    page = CameraPage("camera", port=8475)
    page.show(Reading(0, 0.0, 0, np.zeros((128, 128), np.uint8), {}, "no pins"), 1.0)
    assert "**no pins**" in page._text.content
    page.close()
