"""Grey image of the pins with pyrender, from the wide-angle camera inside the sensor.

pyrender has no wide-angle lens. Each vertex is placed at its pixel as the lens projects it, with its distance as depth, and
an orthographic camera renders the result: the lens is exact at every vertex, and the edges between vertices are shorter
than a pixel. Light is computed per vertex from the LED ring (optics.py), so the scene needs no lights.

Run as a program (`python -m tactip_twin.tactip_model.pyrender_renderer`) it renders a square and exits with status 0,
or prints one sentence and exits with status 1.
"""

import sys
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.opengl import install_hint
from tactip_twin.tactip_model.optics import LedRing, Lens, inner_skin, perpendicular_axes, pin_radii
from tactip_twin.tactip_model.raster_renderer import blur_and_quantize

if TYPE_CHECKING:
    import pyrender

_SIDES = 24
"""Sides of the polygon that approximates a pin's round tip; its radius makes up for the 1 % of the area it lacks."""

_BACKDROP_DEPTH = 9.0
"""Depth of the backdrop, in the renderer's range."""


@cache
def renderer() -> tuple[ModuleType, Any]:
    """Return pyrender and the process's only renderer, because deleting a second one would close the first one's display.

    Raises:
        TactipError: OpenGL cannot be used.
    """
    try:
        import pyrender

        renderer = pyrender.OffscreenRenderer(16, 16)
    # What a missing or broken OpenGL raises depends on which part is missing: import errors, attribute errors of absent
    # functions, EGL's own errors and value errors come through pyrender and PyOpenGL alike.
    except (ImportError, AttributeError, OSError, RuntimeError, ValueError, TypeError, *_gl_error()) as error:
        raise TactipError(
            f"OpenGL cannot be used here ({type(error).__name__}: {_first_line(error)}): on Debian install it with "
            f"'{install_hint()}', or use --renderer raster, which does not need it"
        ) from error
    return pyrender, renderer


def check_opengl() -> None:
    """Render a square off screen; raise TactipError if OpenGL cannot be used."""
    renderer = OffscreenRenderer(16, 16)
    corners = np.array([[-1, -1, 1.0], [40, -1, 1.0], [-1, 40, 1.0]])
    image, _ = renderer.render(renderer.mesh(corners, np.array([[0, 1, 2]]), np.full(3, 255.0)))
    if image.min() < 255:
        raise TactipError(
            f"OpenGL renders incorrectly here: a white square must have the grey level 255, got {image.min():.0f}; "
            "use --renderer raster, which does not need OpenGL"
        )


class OffscreenRenderer:
    """An off-screen OpenGL renderer in pixel coordinates."""

    def __init__(self, width: int, height: int) -> None:
        """Make a renderer of images of a width and height, px; raise TactipError if OpenGL cannot be used."""
        self._pyrender, self._renderer = renderer()
        self._size = width, height
        self._scene = self._pyrender.Scene(bg_color=[0, 0, 0, 0], ambient_light=[1.0, 1.0, 1.0])
        camera = self._pyrender.OrthographicCamera(xmag=width / 2, ymag=height / 2, znear=0.01, zfar=10.0)
        # Pixels count from the top left pixel's centre, y down; OpenGL's camera looks along -z with y up.
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = (width - 1) / 2, (height - 1) / 2, 0.0
        self._scene.add(camera, pose=pose)

    def mesh(self, vertices: np.ndarray, triangles: np.ndarray, grey: np.ndarray) -> "pyrender.Mesh":
        """Return a mesh.

        Args:
            vertices: (n, 3): pixels x, y and depth 0.01 to 10.
            triangles: (m, 3).
            grey: Grey levels (n,), 0 to 255.
        """
        colour = np.ones((len(vertices), 4), np.float32)
        colour[:, :3] = grey[:, None] / 255
        material = self._pyrender.MetallicRoughnessMaterial(doubleSided=True, baseColorFactor=[1.0, 1.0, 1.0, 1.0])
        primitive = self._pyrender.Primitive(
            positions=vertices.astype(np.float32), indices=triangles, color_0=colour, material=material
        )
        return self._pyrender.Mesh([primitive])

    def render(self, mesh: "pyrender.Mesh") -> tuple[np.ndarray, np.ndarray]:
        """Render a mesh on black.

        Returns:
            The image (h, w) float, 0 to 255, and the fraction (h, w) of each pixel that the mesh covers.
        """
        node = self._scene.add(mesh)
        flags = self._pyrender.RenderFlags
        self._renderer.viewport_width, self._renderer.viewport_height = self._size
        colour = self._renderer.render(self._scene, flags=flags.FLAT | flags.RGBA)[0]
        self._scene.remove_node(node)
        return colour[..., 0].astype(np.float64), colour[..., 3] / 255


def _gl_error() -> tuple[type[Exception], ...]:
    """Return PyOpenGL's error class in a tuple, or an empty tuple if PyOpenGL itself cannot be imported."""
    try:
        from OpenGL.error import Error
    except (ImportError, AttributeError, OSError):
        return ()
    return (Error,)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or ["no message"])[0].rstrip(":")


class PinCamera:
    """Renderer of a design's grey frame with pyrender. Making one is expensive, so keep it."""

    def __init__(self, design: Design) -> None:
        """Prepare the rendering of a design; raise TactipError if OpenGL cannot be used."""
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
        # The polygon has the disc's area.
        radius = np.sqrt(np.pi / (_SIDES / 2 * np.sin(2 * np.pi / _SIDES)))
        self._rim = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        self._radii = pin_radii(design)
        fan = np.stack([np.zeros(_SIDES, int), 1 + np.arange(_SIDES), 1 + (np.arange(_SIDES) + 1) % _SIDES], 1)
        self._fans = (fan + (_SIDES + 1) * np.arange(len(self._radii))[:, None, None]).reshape(-1, 3)
        self._renderer = OffscreenRenderer(self._lens.width, self._lens.width)
        # The backdrop never moves, so it is rendered once, which saves more than half of an image's time.
        self._backdrop, _ = self._renderer.render(self._skin())

    def render(self, pin_tips: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Return the grey frames (..., h, w) uint8 of pins.

        Args:
            pin_tips: (..., p, 3), m, sensor frame.
            directions: (..., p, 3), unit, sensor frame.
        """
        pin_tips, directions = np.asarray(pin_tips, float), np.asarray(directions, float)
        if pin_tips.ndim > 2:
            return np.stack([self.render(*one) for one in zip(pin_tips, directions, strict=True)])
        plane = np.einsum("sk,kpj->psj", self._rim, perpendicular_axes(directions))
        discs = np.concatenate([pin_tips[:, None], pin_tips[:, None] + self._radii[:, None, None] * plane], 1)
        grey = self._leds.grey(pin_tips, directions, self._design.optics.pin_albedo)
        mesh = self._renderer.mesh(self._project(discs.reshape(-1, 3)), self._fans, np.repeat(grey, _SIDES + 1))
        image, covered = self._renderer.render(mesh)
        return blur_and_quantize(image + (1 - covered) * self._backdrop, self._design.optics)

    def _project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels and depth (n, 3) of points (n, 3), m."""
        depth = np.linalg.norm(points - self._lens.position, axis=1)
        # Depth in units of 10 mm, inside the renderer's range.
        return np.concatenate([self._lens.project(points), depth[:, None] * 100], 1)

    def _skin(self) -> "pyrender.Mesh":
        """Return the undeformed inner skin as a mesh behind all pins, because the real skin moves with them."""
        rings, sides = 40, 96
        polar, azimuth = np.meshgrid(
            np.linspace(0, np.pi / 2, rings + 1), 2 * np.pi * np.arange(sides) / sides, indexing="ij"
        )
        points, normals = inner_skin(self._design, polar.ravel(), azimuth.ravel())
        grey = self._leds.grey(points, normals, self._design.optics.skin_albedo)
        vertices = self._project(points)
        vertices[:, 2] = _BACKDROP_DEPTH
        # One more ring, far outside the frame and as grey as the rim, so no edge is visible there.
        rim = vertices[-sides:].copy()
        rim[:, :2] = self._lens.centre + 10 * (rim[:, :2] - self._lens.centre)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(rings + 1), np.arange(sides), indexing="ij"))
        a, b, c, d = i * sides + j, i * sides + (j + 1) % sides, (i + 1) * sides + j, (i + 1) * sides + (j + 1) % sides
        triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
        return self._renderer.mesh(np.concatenate([vertices, rim]), triangles, np.concatenate([grey, grey[-sides:]]))


if __name__ == "__main__":
    try:
        check_opengl()
    except TactipError as error:
        sys.exit(str(error))
