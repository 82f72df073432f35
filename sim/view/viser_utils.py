"""Pages in a browser, by viser: how they are served, and how surfaces, pins and images are put on them.

A page is served to this machine alone unless another address is asked for, and to pages of its own alone: a browser that
is on another site is not let in.
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

from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError

LOCAL = "127.0.0.1"

_LAST_PORT = 65535

_PIN_M = 1.1e-3
"""Length at which a pin is drawn, m: less than its own, which goes into the skin."""


def serve(host, port):
    """A viser server at an address (str) and a port (int), or the next that is free; it lets in pages of its own alone.

    Raises TactipError where the address cannot be had.
    """
    require(1 <= port <= _LAST_PORT, "the port", port, f"a number from 1 to {_LAST_PORT}")
    pages = re.compile(r"https?://(127\.0\.0\.1|localhost|\[::1\]|" + re.escape(host) + r")(:\d+)?")
    try:
        # viser waits for ever for an address that is not this machine's.
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise TactipError(f"cannot serve at {host}: {error.strerror or error}") from error
    plain = websockets.asyncio.server.serve
    # viser takes no list of origins, and its library does: None is a program that is no browser.
    websockets.asyncio.server.serve = functools.partial(plain, origins=[pages, None], logger=_logger())
    try:
        with _unsaid():
            server = viser.ViserServer(host=host, port=port, verbose=False)
    finally:
        websockets.asyncio.server.serve = plain
    # Shadows and a mirrored surrounding cost a browser without a GPU five sixths of its pictures.
    server.scene.configure_default_lights(cast_shadow=False)
    server.scene.configure_environment_map(None)
    return server


def stop(server):
    """Stop a server."""
    with _unsaid():
        server.stop()


def _logger():
    """A log without what comes of browsers that open a connection to have one, and then do not need it."""
    logger = logging.getLogger("tactip.page")
    logger.addFilter(lambda record: not record.getMessage().startswith("opening handshake failed"))
    return logger


def _unsaid():
    """What viser prints, its verbosity aside, is not printed: what is printed is the command's own."""
    return contextlib.redirect_stdout(io.StringIO())


def mesh(scene, name, prop, colour=None):
    """Put a stage.Prop into a scene (viser's) by a name (str), in its own colour or another. Returns viser's handle."""
    vertices, triangles = prop.vertices.astype(np.float32), prop.triangles.astype(np.uint32)
    return scene.add_mesh_simple(name, vertices, triangles, color=rgb(colour or prop.colour), side="double")


def place(handle, T):
    """Put what viser's handle is of at a pose (4, 4)."""
    handle.position = T[:3, 3]
    handle.wxyz = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


def pin_lines(tips, directions):
    """Segments (p, 2, 3) m, float32, of pins: tips and directions (p, 3), sensor frame."""
    return np.stack([tips - _PIN_M * directions, tips], 1).astype(np.float32)


def grey(image):
    """A tactile image (n, n) as viser takes it: (n, n, 3)."""
    return np.repeat(image[..., None], 3, axis=-1)


def rgb(colour):
    """A colour of stage.Prop as viser takes it: a tuple of int."""
    return tuple(round(c) for c in colour)
