"""The page of a replay shows the requested step, to this machine only."""

import asyncio
import http.client
import io

import numpy as np
import pytest
import trimesh
import viser
import websockets
from websockets.datastructures import Headers

from helpers.recordings import RECORD, STEPS, arrays_of, scenery
from helpers.viewers import Viewer
from tactip_twin.sim.view import viser_utils
from tactip_twin.sim.view.follow_camera import FollowCamera
from tactip_twin.sim.view.geometry import path_lines
from tactip_twin.sim.view.palette import ERROR_RAMP
from tactip_twin.sim.view.replay_page import ReplayPage
from tactip_twin.tactip_model.errors import TactipError


@pytest.fixture(scope="module")
def page():
    page = ReplayPage(RECORD, arrays_of(), scenery(), port=8431)
    yield page
    page.close()


def shown_skin(page):
    """Return the skin that a page sends, read by an independent library."""
    return trimesh.load(io.BytesIO(page._tip._skin.glb_data), file_type="glb", process=False).to_geometry()


def test_step_is_shown_as_recorded(page):
    arrays = arrays_of()
    for step in (3, 7, STEPS - 1):
        page.playback.go(step)
        page.show()
        assert np.allclose(page._tip.frame.position, arrays["T_base_tcp"][step, :3, 3])
        assert np.allclose(page._object_frame.position, arrays["T_base_object"][step, :3, 3])
        assert np.allclose(shown_skin(page).vertices, arrays["skin_m"][step], atol=1e-7)
        assert np.allclose(page._tip.pins.points[:, 1], arrays["pin_tips_m"][step])
        poses = page._geometry.body_poses(arrays["angles_rad"][step])
        assert np.allclose(page._links["link_4"].position, poses["link_4"][:3, 3])
        assert page._slider.value == step
        assert f"**step {step} of {STEPS - 1}, " in page._status.content
        assert ("9.0 N on the tip" in page._status.content) == (step == 7)
    assert "ended: the loop is closed" in page._status.content


def test_view_from_inside_turns_with_the_tip_and_is_one_viewers_own(page):
    inside, beside = Viewer(page._server, 1), Viewer(page._server, 2)
    page._welcome(inside)
    page._welcome(beside)
    page._set_view("inside", inside)
    page._set_view("close", beside)
    for step in (2, 6):
        page.playback.go(step)
        page.show()
        T = arrays_of()["T_base_tcp"][step]
        eye = np.linalg.inv(T) @ [*inside.camera.position, 1]
        assert eye[:3] == pytest.approx([0, 0, -0.022])
        assert inside.camera.look_at == pytest.approx(T[:3, 3])
        assert inside.camera.up_direction == pytest.approx(-T[:3, 1])
        assert beside.camera.look_at != inside.camera.look_at
        assert [viewer.path.visible for viewer in page._viewers.values()] == [False, True]
        assert np.array_equal(page._viewers[2].path.points, page._lines[: max(1, page._line_counts[step])])
    page._forget(inside)
    page._forget(beside)
    assert not page._viewers


class Camera:
    """A camera that reports its place only when `report` is called, as a browser does after a delay."""

    position, look_at = np.zeros(3), np.zeros(3)

    def on_update(self, callback):
        self.callback = callback

    def report(self, position, look_at):
        ours = self.position, self.look_at
        self.position, self.look_at = position, look_at
        self.callback(self)
        self.position, self.look_at = ours


def test_camera_follows_in_spite_of_late_reports():
    camera, x = Camera(), np.array([1e-3, 0, 0])
    follow, eye = FollowCamera(camera), np.array([0.1, -0.2, 0.05])
    follow.start(eye, np.zeros(3), np.zeros(3))
    for k in range(1, 8):
        follow.follow(k * x)
        if k > 2:
            camera.report(eye + (k - 2) * x, (k - 2) * x)
    assert np.allclose(camera.position, eye + 7 * x) and np.allclose(camera.look_at, 7 * x)
    turned = np.array([0.1, -0.19, 0.05])
    camera.report(turned + 6 * x, 6 * x)  # the viewer turned it at the step before
    follow.follow(8 * x)
    assert np.allclose(camera.position, turned + 8 * x) and np.allclose(camera.look_at, 8 * x)


def test_close_view_follows_the_tip_and_the_overview_stays(page):
    close, overview = Viewer(page._server, 7), Viewer(page._server, 8)
    page.playback.go(2)
    page.show()
    for viewer, view in ((close, "close"), (overview, "overview")):
        page._welcome(viewer)
        page._set_view(view, viewer)
    places = page._arrays["T_base_tcp"][:, :3, 3]
    beside, before = close.camera.look_at - places[2], overview.camera.look_at
    page.playback.forward(4)
    page.show()
    assert np.allclose(close.camera.look_at - places[6], beside)
    assert overview.camera.look_at == before
    page._forget(close)
    page._forget(overview)


def test_see_through_skin_shows_its_pins(page):
    page._tip.skin_style = "see through"
    page._show_tip()
    material = shown_skin(page).visual.material
    assert material.alphaMode == "BLEND"
    page._tip.skin_style = "displacement"
    page._show_tip()


def test_path_grows_with_the_steps():
    arrays = arrays_of()
    errors = np.arange(STEPS, dtype=float)
    lines, colors, counts = path_lines(arrays, errors, errors[-1])
    assert np.array_equal(colors[-1], np.round(ERROR_RAMP[-1]))
    assert counts[2] <= 1 and counts[-1] == len(lines)
    assert np.all(np.diff(counts) >= 0)
    pieces = [line for line in lines if abs(line[1, 2] - line[0, 2]) < 1e-6]
    assert len(pieces) == STEPS - 3  # between the steps that follow
    normals = [line for line in lines if abs(line[1, 2] - line[0, 2]) > 1e-3]
    assert len(normals) == 4  # every 2.5 mm of 9


def test_click_on_the_path_goes_back_to_its_step(page):
    """As long as the path is drawn, and not where it is not."""
    viewer = Viewer(page._server, 9)
    page._welcome(viewer)
    eye = np.array([0.1, -0.5, 0.9])

    def click(step, beside_m=0.0):
        target = page._path_places[step - page._path_steps[0]] + [0, 0, beside_m]
        ray = (target - eye) / np.linalg.norm(target - eye)
        page._go_to_click(viser.SceneClickEvent(viewer, viewer.client_id, tuple(eye), tuple(ray), (0.5, 0.5), None))
        return page.playback.step

    page.playback.go(9)
    page.show()
    assert click(5, beside_m=0.05) == 9
    assert click(5) == 5
    assert click(8) == 5  # its part of the path is not drawn any more
    page._set_view("inside", viewer)
    assert click(3) == 5
    page._set_view("overview", viewer)
    assert click(3) == 3
    page._forget(viewer)
    assert click(2) == 3


def test_replay_page_plays(page):
    page.playback.go(0)
    page.playback.speed = 4.0
    page.playback.toggle()
    page.run(seconds=0.6)
    assert 4 < page.playback.step <= STEPS - 1
    assert page._shown == page.playback.step
    page.playback.playing = False


def test_page_is_served_locally_only(page):
    connection = http.client.HTTPConnection("127.0.0.1", page._server.get_port(), timeout=20)
    connection.request("GET", "/")
    assert connection.getresponse().status == 200
    connection.close()
    assert page.address == f"http://127.0.0.1:{page._server.get_port()}"
    assert page._server.get_host() == "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "origin", "let_in"),
    [
        ("127.0.0.1:8431", "http://127.0.0.1:8431", True),
        ("localhost:8431", "http://localhost:8431", True),
        ("127.0.0.1:8431", "http://127.0.0.1:9000", False),
        ("127.0.0.1:8431", None, False),
        ("127.0.0.1:8431", "http://example.com", False),
        ("127.0.0.1:8431", "http://127.0.0.1.example.com:8431", False),
        ("127.0.0.1:8431", "null", False),
        ("example.com:8431", "http://example.com:8431", False),
    ],
)
def test_other_sites_are_not_let_in(page, host, origin, let_in):
    """Browsers let any site's page open a socket to this machine, with its Origin."""

    async def knock():
        address, kind = f"ws://{host}", f"viser-v{viser.__version__}"
        place = {"host": "127.0.0.1", "port": page._server.get_port()}
        async with websockets.connect(address, origin=origin, subprotocols=[kind], max_size=None, **place) as socket:
            return await asyncio.wait_for(socket.recv(), 20)

    if let_in:
        assert len(asyncio.run(knock())) > 0
    else:
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            asyncio.run(knock())


@pytest.mark.parametrize(("host", "status"), [("127.0.0.1:8431", 200), ("evil.example:8431", 403)])
def test_page_is_served_under_its_own_name_only(page, host, status):
    """A site's name may resolve to this machine, so a browser takes this page for one of the site's."""
    connection = http.client.HTTPConnection("127.0.0.1", page._server.get_port(), timeout=20)
    connection.request("GET", "/", headers={"Host": host})
    assert connection.getresponse().status == status
    connection.close()


@pytest.mark.parametrize(
    ("served", "host", "allowed"),
    [
        ("192.0.2.2", "192.0.2.2:8080", True),
        ("0.0.0.0", "192.0.2.2:8080", True),  # noqa: S104
        ("0.0.0.0", "evil.example:8080", False),  # noqa: S104
        ("::", "[2001:db8::1]:8080", True),
        ("127.0.0.1", "192.0.2.2:8080", False),
        ("robot.local", "robot.local:8080", True),
    ],
)
def test_page_of_an_address_that_was_asked_for_is_let_in(served, host, allowed):
    version = {"Sec-WebSocket-Protocol": f"viser-v{viser.__version__}"}
    headers = Headers({"Host": host, "Origin": f"http://{host}", "Upgrade": "websocket"} | version)
    assert (viser_utils._refusal(headers, served) == "") == allowed


def test_empty_recording_is_refused():
    with pytest.raises(TactipError, match="the recording has no steps to show"):
        ReplayPage(RECORD | {"steps": 0}, arrays_of(), scenery())


def test_empty_address_is_refused():
    with pytest.raises(TactipError, match="the address of the page must be one of this machine"):
        ReplayPage(RECORD, arrays_of(), scenery(), host="", port=8432)


def test_foreign_address_is_refused():
    with pytest.raises(TactipError, match=r"cannot serve at 192\.0\.2\.1"):
        ReplayPage(RECORD, arrays_of(), scenery(), host="192.0.2.1", port=8432)


@pytest.mark.parametrize("port", [-5, 0, 65536])
def test_impossible_port_is_refused(port):
    with pytest.raises(TactipError, match=f"the port must be a number from 1 to 65535, got {port}"):
        ReplayPage(RECORD, arrays_of(), scenery(), port=port)
