"""Grey image of the pins with pyrender, from the wide-angle camera inside the sensor.

pyrender has no wide-angle lens. Each vertex is placed at its pixel as the lens projects it, with its distance as depth, and
an orthographic camera renders the result: the lens is exact at every vertex, and the edges between vertices are shorter
than a pixel. Light is computed per vertex from the LED ring (optics.py), so the scene needs no lights.

A pixel at a pin's edge is covered in part. pyrender samples four points of it, which moves a blob of six pixels by 0.03
pixels and made networks err by a fifth more at light touch. So each disc has a soft edge instead: its cover, which is
the green of a vertex, falls from one to zero over the width of a pixel. Its grey level is the red.

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
from tactip_twin.tactip_model.opengl import remedy
from tactip_twin.tactip_model.optics import LedRing, Lens, inner_skin, perpendicular_axes, pin_radii
from tactip_twin.tactip_model.raster_renderer import blur_and_quantize

if TYPE_CHECKING:
    import pyrender

_SIDES = 16
"""Sides of the polygon that approximates a pin's round tip; its radius makes up for the 3 % of the area it lacks.
With 24 sides, frames are 6 % closer to the exact ones and take a third longer [M]."""

_BACKDROP_DEPTH = 9.0
"""Depth of the backdrop, in the renderer's range."""

_EDGE_DEPTH = 8.0
"""Depth of the outer side of soft edges: behind all pins, so the edge of a near pin covers no other."""

_EDGE_PX = 1.25
"""Reach of the ring of a soft edge to both sides, px: the half pixel over which its cover falls, and half a
pixel's diagonal, so pixels whose cover is between zero and one lie in it as a whole."""


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
            f"OpenGL cannot be used here ({type(error).__name__}: {_first_line(error)}): {remedy()}, or use --renderer "
            "raster, which does not need it"
        ) from error
    return pyrender, renderer


def check_opengl() -> None:
    """Render a square off screen; raise TactipError if OpenGL cannot be used."""
    renderer = OffscreenRenderer(16, 16)
    corners = np.array([[-1, -1, 1.0], [40, -1, 1.0], [-1, 40, 1.0]])
    image = renderer.render(renderer.mesh(corners, np.array([[0, 1, 2]]), np.full((3, 2), 255.0)))
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

    def mesh(self, vertices: np.ndarray, triangles: np.ndarray, levels: np.ndarray) -> "pyrender.Mesh":
        """Return a mesh.

        Args:
            vertices: (n, 3): pixels x, y and depth 0.01 to 10.
            triangles: (m, 3).
            levels: Two levels of each vertex (n, 2), 0 to 255, which are interpolated between vertices.
        """
        colour = np.ones((len(vertices), 4), np.float32)
        colour[:, :2] = levels / 255
        material = self._pyrender.MetallicRoughnessMaterial(doubleSided=True, baseColorFactor=[1.0, 1.0, 1.0, 1.0])
        primitive = self._pyrender.Primitive(
            positions=vertices.astype(np.float32), indices=triangles, color_0=colour, material=material
        )
        return self._pyrender.Mesh([primitive])

    def render(self, mesh: "pyrender.Mesh") -> np.ndarray:
        """Render a mesh on black; return its two levels (h, w, 2) float32, 0 to 255."""
        node = self._scene.add(mesh)
        flags = self._pyrender.RenderFlags
        self._renderer.viewport_width, self._renderer.viewport_height = self._size
        colour = self._renderer.render(self._scene, flags=flags.FLAT)[0]
        self._scene.remove_node(node)
        return colour[..., :2].astype(np.float32)


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
        # Vertices of a disc: its centre, the inner and the outer side of its soft edge.
        inner, following = 1 + np.arange(_SIDES), 1 + (np.arange(_SIDES) + 1) % _SIDES
        outer = inner + _SIDES
        fan = np.stack([np.zeros(_SIDES, int), inner, following], 1)
        edge = np.concatenate([np.stack([inner, outer, following], 1), np.stack([following, outer, following + _SIDES], 1)])
        triangles, pins = np.concatenate([fan, edge]), np.arange(len(self._radii))
        self._triangles = (triangles + (1 + 2 * _SIDES) * pins[:, None, None]).reshape(-1, 3)
        self._renderer = OffscreenRenderer(self._lens.width, self._lens.width)
        # The backdrop never moves, so it is rendered once, which saves more than half of an image's time.
        self._backdrop = self._renderer.render(self._skin())[..., 0]

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
        centres, rims = self._project(pin_tips), self._project(pin_tips[:, None] + self._radii[:, None, None] * plane)
        grey = self._leds.grey(pin_tips, directions, self._design.optics.pin_albedo)
        vertices, cover = _soft_discs(centres, rims)
        # Beyond 0 to 255, the renderer clips the cover where it is interpolated.
        levels = np.stack([np.broadcast_to(grey[:, None], cover.shape), 255 * cover], 2)
        image = self._renderer.render(self._renderer.mesh(vertices.reshape(-1, 3), self._triangles, levels.reshape(-1, 2)))
        cover = image[..., 1] / 255
        return blur_and_quantize(cover * image[..., 0] + (1 - cover) * self._backdrop, self._design.optics)

    def _project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels and depth (..., 3) of points (..., 3), m."""
        depth = np.linalg.norm(points - self._lens.position, axis=-1)
        # Depth in units of 10 mm, inside the renderer's range.
        return np.concatenate([self._lens.project(points), depth[..., None] * 100], -1)

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
        levels = np.concatenate([grey, grey[-sides:]])
        return self._renderer.mesh(np.concatenate([vertices, rim]), triangles, np.repeat(levels[:, None], 2, 1))


def _soft_discs(centres: np.ndarray, rims: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (p, 1 + 2 s, 3) of discs with soft edges, and their cover (p, 1 + 2 s).

    The order is the centre, the inner, then the outer side of the soft edge. Along the normal of the disc's edge, the cover
    is one half less the distance outward in pixels, so it is below zero outside and above one inside.

    Args:
        centres: (p, 3) and
        rims: (p, s, 3), points on the discs' edges: pixels x, y and depth.
    """
    spokes = rims[..., :2] - centres[:, None, :2]
    along = np.roll(rims[..., :2], -1, 1) - np.roll(rims[..., :2], 1, 1)
    normals = np.stack([along[..., 1], -along[..., 0]], 2) / np.linalg.norm(along, axis=2, keepdims=True)
    # A projection may turn the polygon's sense, so the side that is farther from the centre is outside.
    normals *= np.sign(np.sum(normals * spokes, 2, keepdims=True))
    # The edge of a disc of few pixels ends before its centre.
    inward_px = np.minimum(_EDGE_PX, 0.9 * np.linalg.norm(spokes, axis=2))
    inner, outer = rims.copy(), rims.copy()
    inner[..., :2] -= inward_px[..., None] * normals
    outer[..., :2] += _EDGE_PX * normals
    outer[..., 2] = _EDGE_DEPTH
    covers = [inward_px.max(1, keepdims=True), inward_px, np.full(inward_px.shape, -_EDGE_PX)]
    return np.concatenate([centres[:, None], inner, outer], 1), 0.5 + np.concatenate(covers, 1)


if __name__ == "__main__":
    try:
        check_opengl()
    except TactipError as error:
        sys.exit(str(error))
