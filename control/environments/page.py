"""The page of an environment with render_mode="human": the scene in a browser, with the tactile image beside it."""

from collections.abc import Sequence

import numpy as np
import viser

from tactip_twin.sim.view.camera_fit import beside
from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.tactile_picture import tactile_picture
from tactip_twin.sim.view.viser_utils import (
    IMAGE_PANEL_PX,
    LOCAL,
    add_image_panel,
    add_mesh,
    covered_fraction,
    keep_in_view,
    serve,
    stop,
)


class EnvironmentPage:
    """A page that shows the last state of an environment."""

    def __init__(self, port: int, eye_m: np.ndarray, field_deg: float) -> None:
        """Serve the page.

        Args:
            port: Port; the next free one is taken if it is in use.
            eye_m: (3,), position of the eye relative to the middle of the view, base frame.
            field_deg: Vertical field of view.

        Raises:
            TactipError: The page cannot be served.
        """
        self._eye_m, self._field_rad, self._middle = eye_m, float(np.radians(field_deg)), np.zeros(3)
        self._static: Sequence[ColoredMesh] = ()
        self._fixed: list[viser.MeshHandle] = []
        self._moved: list[viser.MeshHandle] = []
        self._server = serve(LOCAL, port)
        self.address = f"http://{LOCAL}:{self._server.get_port()}"
        """Address of the page."""
        self._server.scene.set_up_direction("+z")
        self._image = add_image_panel(self._server.gui, np.zeros((1, 1), np.uint8), with_arrows=False)
        self._text = self._server.gui.add_markdown("")
        self._server.on_client_connect(lambda client: keep_in_view(client, lambda: self._look(client)))

    def show(
        self, static: Sequence[ColoredMesh], moving: Sequence[ColoredMesh], middle: np.ndarray, image: np.ndarray, text: str
    ) -> None:
        """Show a state.

        Args:
            static: Meshes that stay for an episode, base frame: the same object at each of its steps.
            moving: Meshes that move, base frame.
            middle: (3,) m, middle of the view.
            image: (n, n) uint8, tactile image.
            text: Markdown of the panel.
        """
        begins = len(static) != len(self._static) or any(a is not b for a, b in zip(static, self._static, strict=True))
        with self._server.atomic():
            if begins:
                self._static = tuple(static)
                self._fixed = self._replaced(self._fixed, "static", static)
            self._moved = self._replaced(self._moved, "moving", moving)
            self._image.image = tactile_picture(image)
            self._text.content = text
        self._middle = middle
        if begins:
            for client in self._server.get_clients().values():
                self._look(client)

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)

    def _replaced(
        self, handles: Sequence[viser.MeshHandle], name: str, meshes: Sequence[ColoredMesh]
    ) -> list[viser.MeshHandle]:
        """Show meshes under a name instead of others, and return their handles."""
        for handle in handles[len(meshes) :]:
            handle.remove()
        return [add_mesh(self._server.scene, f"/{name}/{k}", mesh) for k, mesh in enumerate(meshes)]

    def _look(self, client: viser.ClientHandle) -> None:
        """Show a viewer the middle of the view, beside the tactile image."""
        camera = client.camera
        covered = covered_fraction(camera, IMAGE_PANEL_PX)
        eye, target = beside(self._middle + self._eye_m, self._middle, self._field_rad, camera.aspect, covered)
        with client.atomic():
            camera.position, camera.look_at, camera.fov = tuple(eye), tuple(target), self._field_rad
