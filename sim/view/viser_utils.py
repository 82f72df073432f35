"""Helpers for browser pages made with viser: serving them, and showing meshes, pins and images.

A page is served to this machine only unless another address is given. Requests must name the address that is served as their
Host, and connections must come from a page of that address: requests from another site's page are refused, even if the
site's name resolves to this machine, and so are programs other than browsers.
"""

import asyncio
import contextlib
import html
import io
import logging
import math
import socket
import time
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server
import websockets.exceptions
from scipy.spatial.transform import Rotation
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.palette import Color, css_gradient, linear
from tactip_twin.sim.view.tactile_picture import ARROW_TEXT, tactile_picture
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError

LOCAL = "127.0.0.1"

_MAX_PORT = 65535

_SKY_COLOR, _GROUND_COLOR = (255, 255, 255), (172, 166, 160)
_SKY, _SUN, _HEADLIGHT = 1.1, 1.5, 0.8
"""Colors and strengths of the lights: from all around, from above, and from the viewer's camera."""

IMAGE_PANEL_PX = 344
"""Width of the window with the tactile image, with its margins, px."""

_SMALL = "font-size:12px;margin:3px 10px"
"""Style of small text."""

_BACKGROUND = (255, 255, 255), (222, 226, 232)
"""Colors of the background at the top and at the bottom."""

_SUN_FROM = (0.3, -0.5, 0.9)


def serve(host: str, port: int) -> viser.ViserServer:
    """Start a server that accepts connections from its own pages only.

    Args:
        host: Address to serve at.
        port: Port; the next free one is taken if it is in use.

    Returns:
        The running server.

    Raises:
        TactipError: If the address cannot be served at.
    """
    # An empty address would mean every address of this machine.
    require(host != "", "the address of the page", repr(host), "one of this machine, such as 127.0.0.1")
    require(1 <= port <= _MAX_PORT, "the port", port, f"a number from 1 to {_MAX_PORT}")
    try:
        # viser waits forever for an address that is not this machine's.
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise TactipError(f"cannot serve at {host}: {error.strerror or error}") from error
    unrestricted = websockets.asyncio.server.serve

    def restricted(
        handle: Callable[[ServerConnection], Awaitable[None]],
        *arguments: Any,
        process_request: Callable[[ServerConnection, Request], Response | None],
        **options: Any,
    ) -> Any:
        """Return viser's server, which refuses other sites, programs, and messages that cannot be read."""

        def check(connection: ServerConnection, request: Request) -> Response | None:
            problem = _refusal(request.headers, host)
            return connection.respond(HTTPStatus.FORBIDDEN, problem) if problem else process_request(connection, request)

        return unrestricted(_guarded(handle), *arguments, process_request=check, logger=_logger(), **options)

    websockets.asyncio.server.serve = restricted  # viser has no option for it
    try:
        with _silenced():
            server = viser.ViserServer(host=host, port=port, verbose=False)
    finally:
        websockets.asyncio.server.serve = unrestricted
    # In a browser without a GPU, shadows and reflections would take five sixths of the frame rate.
    server.scene.configure_default_lights(enabled=False, cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere("/lights/sky", sky_color=_SKY_COLOR, ground_color=_GROUND_COLOR, intensity=_SKY)
    server.scene.add_light_directional("/lights/sun", intensity=_SUN, position=_SUN_FROM)
    server.scene.set_background_image(_background(), format="png")
    server.on_client_connect(_add_headlight)
    return server


def keep_in_view(client: viser.ClientHandle, look: Callable[[], None]) -> None:
    """Move a viewer's camera by `look`, now and whenever the size of the scene changes, as by the panel beside it."""
    look()
    size = [client.camera.image_width, client.camera.image_height]

    @client.camera.on_update
    def _(camera: viser.CameraHandle) -> None:
        if size != [camera.image_width, camera.image_height]:
            size[:] = camera.image_width, camera.image_height
            look()


def covered_fraction(camera: viser.CameraHandle, width_px: int) -> float:
    """Return the fraction of the width of a viewer's scene that a window at its left covers."""
    return min(0.5, width_px / max(camera.image_width, 1))


def _background() -> np.ndarray:
    """Return the background (h, w, 3) uint8: white above, a light grey below."""
    rows = np.linspace(_BACKGROUND[0], _BACKGROUND[1], 256).round().astype(np.uint8)
    return np.repeat(rows[:, None], 4, 1)


def _add_headlight(client: viser.ClientHandle) -> None:
    """Give a viewer a light that shines from where it looks, so what it sees is never dark."""
    light = client.scene.add_light_directional("/lights/head", intensity=_HEADLIGHT)

    @client.camera.on_update
    def _(camera: viser.CameraHandle) -> None:
        light.position = camera.position - camera.look_at


def _refusal(headers: Headers, served: str) -> str:
    """Return why a request is refused; an empty string if it is not.

    Args:
        headers: Headers of the request.
        served: Address at which the page is served.
    """
    host = (headers.get_all("Host") or [""])[0]
    name = urlsplit(f"//{host}").hostname or ""
    if name not in (LOCAL, "localhost", "::1", served.lower()) and not (_is_wildcard(served) and _is_own_name(name)):
        return f"this page is not served at {host!r}\n"
    if headers.get("Upgrade", "").lower() == "websocket" and headers.get_all("Origin") not in (
        [f"http://{host}"],
        [f"https://{host}"],
    ):
        return "connections are accepted from this page only\n"
    if headers.get("Upgrade", "").lower() == "websocket" and _PROTOCOL not in _protocols(headers):
        return "the page is of another version of this program: reload it\n"
    return ""


_PROTOCOL = f"viser-v{viser.__version__}"
"""Protocol of the messages. viser would tell a connection of another one on the standard output."""


def _protocols(headers: Headers) -> set[str]:
    return {name.strip() for value in headers.get_all("Sec-WebSocket-Protocol") for name in value.split(",")}


def _guarded(handle: Callable[[ServerConnection], Awaitable[None]]) -> Callable[[ServerConnection], Awaitable[None]]:
    """Return a handler of connections that logs a line about a message that cannot be read, and closes the connection."""

    async def guarded(connection: ServerConnection) -> None:
        # What is done with a message runs in tasks of its own, whose errors end there.
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: _log_error(context.get("exception")))
        try:
            await handle(connection)
        except websockets.exceptions.ConnectionClosed:
            raise
        except Exception as error:  # viser raises anything for bytes that are no message
            _log_error(error)
            await connection.close(1003, "the message cannot be read")

    return guarded


def _log_error(error: BaseException | None) -> None:
    """Log an error of a page in one line, with the traceback for debugging only. Repeated at once, it is not logged."""
    what = str(error).splitlines()[0] if str(error or "") else ""
    text = f"a message of the page was refused: {type(error).__name__} {what!r:.200}"
    # Several handlers may fail at one message, and a broken page may send it again and again.
    if time.monotonic() > _logged.get(text, -math.inf) + _REPEAT_S:
        _logged.clear()
        _logged[text] = time.monotonic()
        _logger().warning(text)
    _logger().debug("its traceback", exc_info=error)


_REPEAT_S = 1.0
"""Time after which the same line is logged again, s."""

_logged: dict[str, float] = {}
"""The line that was logged last, and when."""


def _is_wildcard(address: str) -> bool:
    """Return whether an address stands for all addresses of this machine."""
    try:
        return ip_address(address).is_unspecified
    except ValueError:
        return False


def _is_own_name(name: str) -> bool:
    """Return whether a name is a numeric address or that of this machine, so no other site can have it."""
    try:
        ip_address(name)
    except ValueError:
        return name == socket.gethostname().lower()
    return True


def stop(server: viser.ViserServer) -> None:
    """Stop a server."""
    with _silenced():
        server.stop()


def _logger() -> logging.Logger:
    """Return a logger without the failed handshakes of browsers that open a spare connection and drop it."""
    logger = logging.getLogger("tactip.page")
    logger.addFilter(lambda record: not record.getMessage().startswith("opening handshake failed"))
    return logger


def _silenced() -> contextlib.redirect_stdout[io.StringIO]:
    """Return a context without standard output, because viser prints there even when it is not verbose."""
    return contextlib.redirect_stdout(io.StringIO())


def add_mesh(scene: viser.SceneApi, name: str, mesh: ColoredMesh) -> viser.MeshHandle:
    """Add a mesh to a scene under a name, and return its handle."""
    vertices, triangles = mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
    return scene.add_mesh_simple(name, vertices, triangles, color=rgb(mesh.color), side="double")


def set_pose(handle: viser.SceneNodeHandle, T: np.ndarray) -> None:
    """Place a node of a scene at a pose (4, 4)."""
    handle.position = T[:3, 3]
    handle.wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


def line_colors(colors: np.ndarray) -> np.ndarray:
    """Return colors (n, 3), 0 to 255, of lines as viser needs them, (n, 2, 3) uint8: for both ends, and linear."""
    return np.repeat((255 * linear(np.asarray(colors) / 255)).round().astype(np.uint8)[:, None], 2, 1)


def rgb(color: Color) -> tuple[int, int, int]:
    """Return a color in whole numbers, as viser needs it."""
    red, green, blue = color
    return round(red), round(green), round(blue)


def add_image_panel(
    gui: viser.GuiApi, image: np.ndarray, with_arrows: bool, width_px: int = IMAGE_PANEL_PX - 24
) -> viser.GuiImageHandle:
    """Add a window with the tactile image (n, n) at the top left of the scene, and return the image's handle."""
    panel = gui.add_panel()
    panel.float(x=12, y=12, width=width_px)
    with panel.add_tab("tactile image"):
        handle = gui.add_image(tactile_picture(image), format="png")
        if with_arrows:
            gui.add_html(f'<div style="{_SMALL}">{ARROW_TEXT}</div>')
    return handle


def color_scale(title: str, largest: float, ramp: tuple[Color, ...]) -> str:
    """Return the HTML of a color scale from 0 to `largest`."""
    bar = f'<span style="flex:1;height:10px;border-radius:3px;background:{css_gradient(ramp)}"></span>'
    row = f"<span>{html.escape(title)}</span><span>0</span>{bar}<span>{largest:g}</span>"
    return f'<div style="display:flex;gap:6px;align-items:center;{_SMALL}">{row}</div>'
