"""Helpers for browser pages made with viser: serving them, and showing meshes, pins and images.

A page is served to this machine only unless another address is given, and accepts connections only from pages of its own:
a browser that shows another site's page is refused.
"""

import contextlib
import functools
import io
import logging
import re
import socket

import numpy as np
import viser
import websockets.asyncio.server
from scipy.spatial.transform import Rotation

from tactip_twin.sim.view.geometry import Color, ColoredMesh
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError

LOCAL = "127.0.0.1"

_MAX_PORT = 65535

_PIN_M = 1.1e-3
"""Length at which a pin is shown, m: shorter than the pin, whose root is within the skin."""


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
    # An empty address would be every address of this machine.
    require(host != "", "the address of the page", repr(host), "one of this machine, such as 127.0.0.1")
    require(1 <= port <= _MAX_PORT, "the port", port, f"a number from 1 to {_MAX_PORT}")
    origins = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\]|" + re.escape(host) + r")(:\d+)?")
    try:
        # viser waits for ever for an address that is not this machine's.
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise TactipError(f"cannot serve at {host}: {error.strerror or error}") from error
    unrestricted = websockets.asyncio.server.serve
    # viser takes no list of origins, but its library does. None stands for programs that are not browsers.
    websockets.asyncio.server.serve = functools.partial(unrestricted, origins=[origins, None], logger=_logger())
    try:
        with _silenced():
            server = viser.ViserServer(host=host, port=port, verbose=False)
    finally:
        websockets.asyncio.server.serve = unrestricted
    # In a browser without a GPU, shadows and reflections would take five sixths of the frame rate.
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    return server


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


def pin_lines(tips: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return segments (p, 2, 3) m, float32, that show pins: pin tips and directions (p, 3), sensor frame."""
    return np.stack([tips - _PIN_M * directions, tips], 1).astype(np.float32)


def grey(image: np.ndarray) -> np.ndarray:
    """Return a tactile image (n, n) as (n, n, 3), as viser needs it."""
    return np.repeat(image[..., None], 3, axis=-1)


def rgb(color: Color) -> tuple[int, int, int]:
    """Return a color in whole numbers, as viser needs it."""
    red, green, blue = color
    return round(red), round(green), round(blue)
