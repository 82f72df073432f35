"""The tip in a browser page by viser: its housing, its skin colored by displacement, its pins, and the force on it."""

from collections.abc import Sequence

import numpy as np
import viser

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

_FORCE_M_PER_N = 0.02
_MIN_ARROW_M = 1e-3
"""Length of the force arrow, and below which it is hidden."""


_BESIDE_M, _RAISED_M = 8e-3, 12e-3
"""Distance of the force arrow from the tip along x of the sensor frame, and its height over the apex, m."""

_LEANING = 0.1
"""Fraction of the force against x beyond which the arrow stands on the other side."""


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
        radius = float(np.hypot(*rest_skin[:, :2].T).max())
        self._beside_m = radius + _BESIDE_M
        # Arrows themselves ignore that they are invisible.
        self._force_frame = scene.add_frame("/tip/force", show_axes=False, visible=False)
        color = line_colors(np.array([FORCE_COLOR]))[0, 0]
        self._force = scene.add_arrows(
            "/tip/force/arrow", nowhere, color, shaft_radius=0.9e-3, head_radius=2.4e-3, head_length=5e-3
        )

    def show(self, skin: np.ndarray, pin_tips: np.ndarray, directions: np.ndarray, force: np.ndarray) -> None:
        """Show a state of the tip: vertices of the skin (s, 3) m, pins (p, 3), and force (3,) N, sensor frame."""
        self._skin.glb_data = self._skin_glb(skin)
        self.pins.points = np.stack([pin_tips - _PIN_M * directions, pin_tips], 1).astype(np.float32)
        # At the apex the tip or the object would hide the arrow: it stands beside the tip, so that it leans away from it.
        self._force_frame.visible = _FORCE_M_PER_N * float(np.linalg.norm(force)) > _MIN_ARROW_M
        if self._force_frame.visible:
            side = -1.0 if force[0] < -_LEANING * np.linalg.norm(force) else 1.0
            start = np.array([side * self._beside_m, 0.0, skin[:, 2].max() - _RAISED_M])
            self._force.points = np.stack([start, start + _FORCE_M_PER_N * force])[None].astype(np.float32)

    def _skin_glb(self, skin: np.ndarray) -> bytes:
        """Return the skin with vertices (s, 3) m as it is shown now."""
        skin, see_through = np.asarray(skin, float), self.skin_style == "see through"
        colors = None
        if self.skin_style != "plain":
            moved_mm = 1e3 * np.linalg.norm(skin - self._rest, axis=1)
            colors = ramp_colors(moved_mm, self._largest_mm, SKIN_RAMP) * (SEE_THROUGH if see_through else 1.0)
        mesh = ColoredMesh(skin, self._triangles, skin_normals(skin, self._triangles), SKIN_COLOR, colors)
        return glb(mesh, SEE_THROUGH if see_through else 1.0)
