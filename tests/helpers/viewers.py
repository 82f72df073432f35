"""Viewers of a page without a browser: a camera, and nodes of their own in the page's scene."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import viser


class Camera:
    """A camera with the attributes that pages set and read."""

    position = look_at = (0.0, 0.0, 0.0)
    up_direction = (0.0, 0.0, 1.0)
    fov, aspect, image_width, image_height = 1.0, 1.6, 1400, 900

    def on_update(self, callback: Callable[[Any], None]) -> None:
        """Accept a callback: this camera never moves by itself."""


class _Scene:
    """A part of a server's scene."""

    def __init__(self, scene: viser.SceneApi, prefix: str) -> None:
        self._scene, self._prefix = scene, prefix

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """Return a method that adds a node, under the prefix."""
        add = getattr(self._scene, name)
        return lambda path, *values, **options: add(self._prefix + path, *values, **options)


class Viewer:
    """A stand-in for viser.ClientHandle."""

    def __init__(self, server: viser.ViserServer, number: int) -> None:
        """Take the page's server and the viewer's number."""
        self.client_id, self.camera = number, Camera()
        self.scene = _Scene(server.scene, f"/viewer-{number}")

    @contextlib.contextmanager
    def atomic(self) -> Iterator[None]:
        """Send several changes at once."""
        yield
