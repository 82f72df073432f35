"""The tip in a browser page by viser: its housing, its skin colored by displacement, its pins, and the force on it."""

from collections.abc import Sequence

import numpy as np
import viser

from tactip_twin.sim.view.force_arrow import HEAD_LENGTH_M, HEAD_M, SHAFT_M, force_arrow, skin_radius_m
from tactip_twin.sim.view.geometry import ColoredMesh, skin_normals
from tactip_twin.sim.view.glb import glb
from tactip_twin.sim.view.palette import FORCE_COLOR, PIN_COLOR, SKIN_COLOR, SKIN_RAMP, ramp_colors
from tactip_twin.sim.view.viser_utils import add_mesh, line_colors, rgb

SKINS = ("displacement", "plain", "see through")
"""How the skin is shown."""

_PIN_M = 1.1e-3
"""Length at which a pin is shown, m: shorter than the pin, whose root is within the skin."""

SEE_THROUGH = 0.45
"""Opacity of what is seen through, and brightness of a skin in front of which white pins can be seen."""


class TipNodes:
    """The tip in the frame /tip of a scene."""

    def __init__(
        self,
        scene: viser.SceneApi,
        sensor: Sequence[ColoredMesh],
        triangles: np.ndarray,
        rest_skin: np.ndarray,
        largest_mm: float,
    ) -> None:
        """Add the tip to a scene.

        Args:
            scene: The scene.
            sensor: Meshes of the sensor without its skin, sensor frame.
            triangles: (t, 3) int, triangles of the skin.
            rest_skin: (s, 3) m, vertices of the undeformed skin, sensor frame.
            largest_mm: Displacement at the end of the color scale, mm.
        """
        self.frame = scene.add_frame("/tip", show_axes=False)
        """The node that moves with the sensor."""
        for n, mesh in enumerate(sensor):
            add_mesh(scene, f"/tip/{n}", mesh)
        self._triangles, self._rest, self._largest_mm = triangles, rest_skin, largest_mm
        self.skin_style = SKINS[0]
        """One of SKINS. It takes effect with the next `show`."""
        self._skin = scene.add_glb("/tip/skin", self._skin_glb(rest_skin), cast_shadow=False, receive_shadow=False)
        nowhere = np.zeros((1, 2, 3), np.float32)
        self.pins = scene.add_line_segments("/tip/pins", nowhere, rgb(PIN_COLOR), thickness=0.8e-3)
        """The pins, as line segments."""
        self._radius_m = skin_radius_m(rest_skin)
        # Arrows themselves ignore that they are invisible.
        self._force_frame = scene.add_frame("/tip/force", show_axes=False, visible=False)
        color = line_colors(np.array([FORCE_COLOR]))[0, 0]
        self._force = scene.add_arrows(
            "/tip/force/arrow", nowhere, color, shaft_radius=SHAFT_M, head_radius=HEAD_M, head_length=HEAD_LENGTH_M
        )

    def show(self, skin: np.ndarray, pin_tips: np.ndarray, directions: np.ndarray, force: np.ndarray) -> None:
        """Show a state of the tip: vertices of the skin (s, 3) m, pins (p, 3), and force (3,) N, sensor frame."""
        self._skin.glb_data = self._skin_glb(skin)
        self.pins.points = np.stack([pin_tips - _PIN_M * directions, pin_tips], 1).astype(np.float32)
        arrow = force_arrow(skin, force, self._radius_m)
        self._force_frame.visible = arrow is not None
        if arrow is not None:
            self._force.points = arrow[None].astype(np.float32)

    def _skin_glb(self, skin: np.ndarray) -> bytes:
        """Return the skin with vertices (s, 3) m as it is shown now."""
        skin, see_through = np.asarray(skin, float), self.skin_style == "see through"
        colors = None
        if self.skin_style != "plain":
            moved_mm = 1e3 * np.linalg.norm(skin - self._rest, axis=1)
            colors = ramp_colors(moved_mm, self._largest_mm, SKIN_RAMP) * (SEE_THROUGH if see_through else 1.0)
        mesh = ColoredMesh(skin, self._triangles, skin_normals(skin, self._triangles), SKIN_COLOR, colors)
        return glb(mesh, SEE_THROUGH if see_through else 1.0)
