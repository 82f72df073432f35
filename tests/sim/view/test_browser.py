"""The pages in a real browser: headless Chromium renders them, and a simulated mouse operates them."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.headless_browser import PROGRAM, Chromium
from helpers.recordings import RECORD, STEPS, arrays_of, scenery
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.view.live_page import LivePage
from tactip_twin.sim.view.replay_page import ReplayPage
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.renderer import renderer_named

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium here")]


def _drag(browser, start, end, pieces=6):
    """Drag the mouse from one place to another, (2,) px each."""
    browser.mouse("mouseMoved", start)
    browser.frames(1)
    browser.mouse("mousePressed", start)
    for share in np.linspace(0, 1, pieces):
        browser.mouse("mouseMoved", [a + share * (b - a) for a, b in zip(start, end, strict=True)])
    browser.mouse("mouseReleased", end)


class PageSession:
    """A page served in the test's process, alternating with the test."""

    def __init__(self, page):
        self.page, self.browser = page, Chromium(page.address)
        # viser ignores clicks until the browser has sent its camera.
        self.until(page._server.get_clients)

    def until(self, holds, seconds=60.0):
        def turn():
            self.page.run(seconds=0.1)
            return holds()

        return self.browser.until(turn, seconds)

    def text(self, pattern):
        """Wait until a pattern is on the page, and return the match."""
        return self.until(lambda: re.search(pattern, self.browser.text()))

    def close(self):
        self.browser.close()
        self.page.close()


@pytest.fixture(scope="module")
def replay():
    session = PageSession(ReplayPage(RECORD, arrays_of(), scenery(), port=8451))
    yield session
    session.close()


def test_replay_is_drawn(replay):
    def drawn(holds):
        scene = replay.browser.screenshot()[:, 350:800].astype(int)
        return len(np.unique(scene.reshape(-1, 3), axis=0)) > 100 and holds(scene)

    replay.text("step 0")
    # The object is warm; the background is not.
    replay.until(lambda: drawn(lambda scene: (scene[..., 0] - scene[..., 2] > 4).mean() > 0.005))
    replay.browser.click("close")
    # The housing and the lit skin fill the middle: neither is black, nor as light as the background.
    replay.until(lambda: drawn(lambda scene: ((scene.max(2) < 150) & (scene.max(2) > 40)).mean() > 0.15))


def test_replay_plays_and_pauses_on_click(replay):
    replay.page.playback.go(0)
    replay.browser.click("Play")
    replay.until(lambda: replay.page.playback.step >= 3)
    replay.text(r"step [1-9]\d* of|step [1-9]")
    if replay.page.playback.playing:
        replay.browser.click("Pause")
        replay.until(lambda: not replay.page.playback.playing)
    replay.text("Play")


def test_replay_follows_the_slider(replay):
    replay.page.playback.playing = False
    replay.page.playback.go(0)
    replay.page.show()
    find = """(() => { const t = document.querySelector('[role=slider]'), r = t.parentElement.getBoundingClientRect();
        const q = t.getBoundingClientRect(); return [q.x + q.width / 2, q.y + q.height / 2, r.x, r.x + r.width]; })()"""
    x, y, low, high = replay.until(lambda: replay.browser.evaluate(find))
    _drag(replay.browser, (x, y), (low + 0.75 * (high - low), y))
    replay.until(lambda: replay.page.playback.step >= STEPS // 2)
    replay.text(f"step {replay.page.playback.step}")


def test_single_steps_and_events(replay):
    replay.page.playback.go(2)
    replay.page.show()
    replay.browser.click("next")
    replay.until(lambda: replay.page.playback.step == 3)
    replay.browser.click("next event")
    replay.until(lambda: replay.page.playback.step == 7)
    replay.text("9.0 N on the tip")
    replay.browser.click("previous")
    replay.until(lambda: replay.page.playback.step == 6)


def test_keys_step_the_replay(replay):
    replay.page.playback.go(4)
    replay.page.show()
    replay.browser.mouse("mousePressed", (300, 400))
    replay.browser.mouse("mouseReleased", (300, 400))
    replay.browser.key("ArrowRight", "ArrowRight")
    replay.until(lambda: replay.page.playback.step == 5)


def test_click_on_the_path_goes_back_to_its_step(replay):
    page, browser = replay.page, replay.browser
    page.playback.playing = False
    page.playback.go(9)
    page.show()
    browser.click("close")
    browser.frames(30)
    camera = next(iter(page._server.get_clients().values())).camera
    find = """(() => { const r = document.querySelector('canvas').getBoundingClientRect();
        return [r.x, r.y, r.width, r.height]; })()"""

    def click():
        x, y, width, height = browser.evaluate(find)
        place = page._path_places[list(page._path_steps).index(4)]
        right, down, ahead = Rotation.from_quat(camera.wxyz, scalar_first=True).inv().apply(place - camera.position)
        focal = height / 2 / np.tan(camera.fov / 2)
        at = (x + width / 2 + focal * right / ahead, y + height / 2 + focal * down / ahead)
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            browser.mouse(kind, at)
        browser.frames(3)
        return page.playback.step == 4

    replay.until(click)
    replay.text("step 4 of")


@pytest.fixture(scope="module")
def live():
    design = design_named("nominal-127")
    session = PageSession(LivePage(design, "surface", fidelity_named("draft"), renderer_named("raster", design), port=8461))
    yield session
    session.close()


def test_typed_number_moves_the_stimulus(live):
    live.text("at rest")
    live.browser.write(".mantine-NumberInput-input", "3")
    live.until(lambda: abs(live.page._contact.label[0] - 3e-3) < 1e-9)
    live.text("at rest")
    assert np.hypot(*live.page._contact.tip_state().force[:2]) > 0.05


def _on_screen(point, camera, browser):
    """Return the page position, px, of a point of the world, m, by a pinhole camera in the middle of the canvas with a
    vertical fov."""
    forward = np.subtract(camera.look_at, camera.position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up_direction)
    right /= np.linalg.norm(right)
    seen = np.array([right, np.cross(right, forward), forward]) @ np.subtract(point, camera.position)
    box = "document.querySelector('canvas').getBoundingClientRect()"
    x, y, w, h = browser.evaluate(f"(() => {{ const q = {box}; return [q.x, q.y, q.width, q.height]; }})()")
    scale = h / 2 / np.tan(camera.fov / 2) / seen[2]
    return x + w / 2 + scale * seen[0], y + h / 2 - scale * seen[1]


def test_stimulus_follows_the_dragged_handle(live):
    """Dragging the arrow of the handle's x axis moves the stimulus as far as the mouse."""
    live.browser.click("reset")
    live.until(lambda: abs(live.page._contact.label[0]) < 1e-9)
    live.text("at rest")
    live.browser.frames()
    camera = next(iter(live.page._server.get_clients().values())).camera
    handle = next(iter(live.page._handles.values()))
    origin, along = np.array(handle.position), Rotation.from_quat(handle.wxyz, scalar_first=True).as_matrix()[:, 0]
    start, end = (_on_screen(origin + d * along, camera, live.browser) for d in (0.022, 0.026))
    _drag(live.browser, start, end, pieces=12)
    live.until(lambda: np.allclose(handle.position, origin + 0.004 * along, atol=1e-3))
    live.until(lambda: abs(abs(live.page._contact.label[0]) - 4e-3) < 1e-3)
    assert np.allclose(live.page._contact.label[3:], 0, atol=1e-3)
    assert abs(live.page._sliders[0].value - 1e3 * live.page._contact.label[0]) < 1e-6
    live.text("at rest")
