"""The live page: it shows the state of the tip, and applies requests or refuses them with a message."""

import numpy as np
import pytest

from helpers.viewers import Viewer
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.contact.stimuli import STIMULI
from tactip_twin.sim.dataset.object_options import ObjectOptions
from tactip_twin.sim.dataset.pressed_object import PressedObject, PressPlaces
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact, to_mm_deg
from tactip_twin.sim.view.live_page import _T_WORLD_SENSOR, LivePage, ranges_of
from tactip_twin.sim.view.viser_utils import set_pose
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.renderer import renderer_named


@pytest.fixture(scope="module")
def page():
    design = design_named("nominal-127")
    read = lambda image: {"z": -9.0, "Rx": float(image.mean())}  # noqa: E731
    page = LivePage(design, "edge", fidelity_named("draft"), renderer_named("raster", design), read, port=8441)
    page._welcome(Viewer(page._server, 1))
    page._welcome(Viewer(page._server, 2))
    yield page
    page.close()


def _drag(page, label):
    """Drag the first viewer's handle to a label (6,), mm and degrees."""
    set_pose(page._handles[1], _T_WORLD_SENSOR @ inverse(sensor_in_contact(from_mm_deg(label))))
    page._on_drag(page._handles[1])


def _until_rest(page):
    for _ in range(100):
        page.run(seconds=0.1)
        if page._contact.at_rest and not page._changed and page._requested is None:
            return
    raise AssertionError("it does not come to rest")


def test_sliders_move_the_stimulus_and_deform_the_tip(page):
    for slider, value in zip(page._sliders, (2.0, -1.0, -3.0, 5.0, 0.0, 20.0), strict=True):
        slider.value = value
    page._on_slider()
    _until_rest(page)
    state = page._contact.tip_state()
    assert np.allclose(to_mm_deg(page._contact.label), [2, -1, -3, 5, 0, 20])
    assert np.array_equal(page._tip._skin.glb_data, page._tip._skin_glb(state.skin))
    assert np.allclose(page._tip.pins.points[:, 1], state.pin_tips, atol=1e-7)
    wanted = _T_WORLD_SENSOR @ inverse(sensor_in_contact(page._contact.label))
    assert np.allclose(page._stimulus.position, wanted[:3, 3])
    assert all(np.allclose(handle.position, wanted[:3, 3]) for handle in page._handles.values())
    assert f"force {np.linalg.norm(state.force):.2f} N" in page._status.content
    assert "| depth, mm | -3.00 | -9.00 |" in page._status.content
    assert "at rest" in page._status.content


def test_dragging_moves_the_sliders_and_the_stimulus(page):
    _drag(page, [-1, 2, -2, 0, 5, -10])
    assert np.allclose([s.value for s in page._sliders], [-1, 2, -2, 0, 5, -10], atol=1e-9)
    _until_rest(page)
    assert np.allclose(to_mm_deg(page._contact.label), [-1, 2, -2, 0, 5, -10])
    assert np.allclose(page._handles[2].position, page._handles[1].position)


def test_dragged_too_far_it_goes_to_the_end_of_the_sliders(page):
    _drag(page, [-90, 2, 40, 0, 5, -10])
    low, high = ranges_of("edge")
    assert np.allclose([s.value for s in page._sliders[:3]], [low[0], 2, high[2]])


def test_each_viewer_has_a_view_and_a_handle(page):
    one = Viewer(page._server, 3)
    page._welcome(one)
    page._set_view("inside", one)
    assert not page._handles[3].visible
    assert page._handles[1].visible
    assert one.camera.up_direction == pytest.approx(-_T_WORLD_SENSOR[:3, 1])
    page._forget(one)
    assert list(page._handles) == [1, 2]


def test_lifting_forgets_the_shear(page):
    page._on_reset()
    _until_rest(page)
    first = page._contact.tip_state()
    for x in (4.0, 0.0):
        page._request([x, 0, -2, 0, 0, 0])
        _until_rest(page)
    page._on_reset()
    _until_rest(page)
    assert np.array_equal(page._contact.tip_state().pin_tips, first.pin_tips)


def test_out_of_reach_is_said(page):
    page._request([0, 0, -20, 0, 0, 0])
    page.run(seconds=0.3)
    assert "**the depth of the pose" in page._status.content
    page._on_reset()
    _until_rest(page)
    assert "depth of the pose" not in page._status.content


def test_diverged_tip_is_lifted_and_reported(page, monkeypatch):
    def lose(steps):
        monkeypatch.undo()
        raise Diverged("the simulated tip is lost")

    page._on_reset()
    page._on_input()
    monkeypatch.setattr(page._contact, "advance", lose)
    page.run(seconds=0.01)
    assert "the simulated tip is lost; the tip was lifted" in page._status.content
    _until_rest(page)


@pytest.mark.parametrize("name", list(STIMULI))
def test_every_stimulus_has_a_look_and_ranges(name):
    from tactip_twin.sim.contact.scene import Scene
    from tactip_twin.sim.view.geometry import body_meshes
    from tactip_twin.sim.view.palette import OBJECT_COLOR

    meshes = body_meshes(Scene(design_named("nominal-127"), name, fidelity_named("draft")).model, "stimulus", OBJECT_COLOR)
    assert meshes
    # The mesh is shown at the stimulus: its vertices lie on the true surface.
    stimulus = STIMULI[name]
    for mesh in meshes:
        near = mesh.vertices[np.linalg.norm(mesh.vertices, axis=1) < 5e-3]
        assert np.all(np.abs(stimulus.distance(near)) < 0.2e-3)
    low, high = ranges_of(name)
    assert np.all(low <= high)


def test_object_is_shown_and_touched():
    design, ball = design_named("nominal-127"), ObjectOptions("sphere").solid()
    stimulus = SolidStimulus(PressPlaces(PressedObject("sphere", ""), ball).sample(np.random.default_rng(0)))
    render = renderer_named("raster", design)
    page = LivePage(design, "surface", fidelity_named("draft"), render, port=8442, stimulus=stimulus)
    try:
        _until_rest(page)
        assert page._contact.scene.contact_force()[2] < -0.1
    finally:
        page.close()
