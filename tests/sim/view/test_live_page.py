"""The page of the live scene: what it shows is what the tip is, and what it is asked for is done or refused in words."""

import numpy as np
import pytest

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.stimuli import STIMULI
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.view.live_page import _T_WORLD_SENSOR, LivePage, ranges_of
from tactip_twin.sim.view.viser_utils import place
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.renderer import renderer_named


@pytest.fixture(scope="module")
def live():
    design = design_named("nominal-127")
    read = lambda image: {"z": -9.0, "Rx": float(image.mean())}  # noqa: E731
    live = LivePage(design, "edge", fidelity_named("draft"), renderer_named("raster", design), read, port=8441)
    yield live
    live.close()


def _until_rest(live):
    for _ in range(100):
        live.run(seconds=0.1)
        if live._press.at_rest and not live._moved and live._wanted is None:
            return
    raise AssertionError("it does not come to rest")


def test_the_sliders_move_the_stimulus_and_the_tip_feels_it(live):
    for slider, value in zip(live._sliders, (2.0, -1.0, -3.0, 5.0, 0.0, 20.0), strict=True):
        slider.value = value
    live._slid()
    _until_rest(live)
    touch = live._press.touch()
    assert np.allclose(to_mm_deg(live._press.label), [2, -1, -3, 5, 0, 20])
    assert np.allclose(live._skin.vertices, touch.skin, atol=1e-7)
    assert np.allclose(live._pins.points[:, 1], touch.tips, atol=1e-7)
    wanted = _T_WORLD_SENSOR @ inverse(sensor_in_contact(live._press.label))
    assert np.allclose(live._stimulus.position, wanted[:3, 3])
    assert np.allclose(live._handle.position, wanted[:3, 3])
    assert f"force {np.linalg.norm(touch.force):.2f} N" in live._told.content
    assert "| depth, mm | -3.00 | -9.00 |" in live._told.content
    assert "at rest" in live._told.content


def test_dragging_moves_the_sliders_and_the_stimulus(live):
    place(live._handle, _T_WORLD_SENSOR @ inverse(sensor_in_contact(from_mm_deg([-1, 2, -2, 0, 5, -10]))))
    live._dragged()
    assert np.allclose([s.value for s in live._sliders], [-1, 2, -2, 0, 5, -10], atol=1e-9)
    _until_rest(live)
    assert np.allclose(to_mm_deg(live._press.label), [-1, 2, -2, 0, 5, -10])


def test_dragged_too_far_it_goes_to_the_end_of_the_sliders(live):
    place(live._handle, _T_WORLD_SENSOR @ inverse(sensor_in_contact(from_mm_deg([-90, 2, 40, 0, 5, -10]))))
    live._dragged()
    low, high = ranges_of("edge")
    assert np.allclose([s.value for s in live._sliders[:3]], [low[0], 2, high[2]])


def test_lifting_forgets_the_shear(live):
    live._back()
    _until_rest(live)
    first = live._press.touch()
    for x in (4.0, 0.0):
        live._want([x, 0, -2, 0, 0, 0])
        _until_rest(live)
    live._back()
    _until_rest(live)
    assert np.array_equal(live._press.touch().tips, first.tips)


def test_out_of_reach_is_said(live):
    live._want([0, 0, -20, 0, 0, 0])
    live.run(seconds=0.3)
    assert "**the depth of the pose" in live._told.content
    live._back()
    _until_rest(live)
    assert "depth of the pose" not in live._told.content


def test_a_lost_tip_is_lifted_and_said(live, monkeypatch):
    def lose(steps):
        monkeypatch.undo()
        raise Diverged("the simulated tip is lost")

    live._back()
    live._heed()
    monkeypatch.setattr(live._press, "advance", lose)
    live.run(seconds=0.01)
    assert "the simulated tip is lost: it was lifted" in live._told.content
    _until_rest(live)


@pytest.mark.parametrize("name", list(STIMULI))
def test_every_stimulus_has_a_look_and_ranges(name):
    from tactip_twin.sim.contact.scene import Scene
    from tactip_twin.sim.view.geometry import PORCELAIN, body_props

    props = body_props(Scene(design_named("nominal-127"), name, fidelity_named("draft")).model, "stimulus", PORCELAIN)
    assert props
    # What is drawn is where the stimulus is: its surface is at no distance.
    stimulus = STIMULI[name]
    for prop in props:
        near = prop.vertices[np.linalg.norm(prop.vertices, axis=1) < 5e-3]
        assert np.all(np.abs(stimulus.distance(near)) < 0.2e-3)
    low, high = ranges_of(name)
    assert np.all(low <= high)
