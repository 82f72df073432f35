"""The pins' grey image by pyrender, from the wide-angle camera inside the sensor.

pyrender has no wide-angle lens. Each vertex is put where the lens sees it, in pixels, with its distance as depth, and
drawn by an orthographic camera: the lens is exact at every vertex, and the edges between them are shorter than pixels
are wide. Light is by vertex, from the LED ring (optics.py), so that the drawing itself needs none.

Run as a program (`python -m tactip_twin.tactip_model.pyrender_renderer`) it draws a square and exits with 0 or, with one
sentence, 1.
"""

import sys
from functools import cache
from typing import Any

import numpy as np

from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.opengl import install_hint
from tactip_twin.tactip_model.optics import LedRing, Lens, inner_skin, perpendicular_axes, tip_radii
from tactip_twin.tactip_model.raster_renderer import blur_and_quantize

_SIDES = 24
"""Sides of the polygon that stands for a pin's round tip: 1 % of its area is missing, made up in its radius."""

_BACKDROP_DEPTH = 9.0
"""Depth of the backdrop, in the canvas's range."""


@cache
def renderer() -> tuple[Any, Any]:
    """The process's pyrender renderer. There can be only one: a second one's end takes the first one's display away.

    Raises TactipError where OpenGL cannot be used.
    """
    try:
        import pyrender

        renderer = pyrender.OffscreenRenderer(16, 16)
    # What a missing or broken OpenGL raises depends on which part is missing: import errors, attribute errors of absent
    # functions, EGL's own errors and value errors come through pyrender and PyOpenGL alike.
    except (ImportError, AttributeError, OSError, RuntimeError, ValueError, TypeError, *_gl_error()) as error:
        raise TactipError(
            f"OpenGL cannot be used here ({type(error).__name__}: {_first_line(error)}): on Debian install it with "
            f"'{install_hint()}', or draw without it by --renderer raster"
        ) from error
    return pyrender, renderer


def check_opengl():
    """Draw off screen. Raises TactipError where OpenGL cannot be used."""
    canvas = OffscreenRenderer(16, 16)
    corners = np.array([[-1, -1, 1.0], [40, -1, 1.0], [-1, 40, 1.0]])
    drawn, _ = canvas.draw(canvas.mesh(corners, np.array([[0, 1, 2]]), np.full(3, 255.0)))
    if drawn.min() < 255:
        raise TactipError(
            f"OpenGL draws wrongly here: a white square came out {drawn.min():.0f} of 255; draw without it by "
            "--renderer raster"
        )


class OffscreenRenderer:
    """An off-screen OpenGL drawing in pixel coordinates."""

    def __init__(self, width, height):
        """width, height: int, px. Raises TactipError where OpenGL cannot be used."""
        self._pyrender, self._renderer = renderer()
        self._size = width, height
        self._scene = self._pyrender.Scene(bg_color=[0, 0, 0, 0], ambient_light=[1.0, 1.0, 1.0])
        camera = self._pyrender.OrthographicCamera(xmag=width / 2, ymag=height / 2, znear=0.01, zfar=10.0)
        # Pixels count from the top left pixel's centre, y down; OpenGL's camera looks along -z with y up.
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[:3, 3] = (width - 1) / 2, (height - 1) / 2, 0.0
        self._scene.add(camera, pose=pose)

    def mesh(self, vertices, triangles, grey):
        """A mesh of vertices (n, 3): pixels x, y and depth 0.01 to 10; triangles (m, 3); grey levels (n,), or red, green
        and blue (n, 3), 0 to 255."""
        colour = np.ones((len(vertices), 4), np.float32)
        colour[:, :3] = np.reshape(grey, (len(vertices), -1)) / 255
        material = self._pyrender.MetallicRoughnessMaterial(doubleSided=True, baseColorFactor=[1.0, 1.0, 1.0, 1.0])
        primitive = self._pyrender.Primitive(
            positions=vertices.astype(np.float32), indices=triangles, color_0=colour, material=material
        )
        return self._pyrender.Mesh([primitive])

    def add(self, mesh):
        """Keep a mesh in every drawing."""
        self._scene.add(mesh)

    def draw(self, mesh):
        """Draw `mesh` and what was added: image (h, w) float, 0 to 255, and the share (h, w) of each pixel that is covered.

        What is not covered is black.
        """
        node = self._scene.add(mesh)
        colour = self._drawn(self._pyrender.RenderFlags.RGBA)
        self._scene.remove_node(node)
        return colour[..., 0].astype(np.float64), colour[..., 3] / 255

    def picture(self):
        """Draw what was added: image (h, w, 3) uint8, red, green and blue."""
        return self._drawn(0)[..., :3]

    def _drawn(self, flags):
        self._renderer.viewport_width, self._renderer.viewport_height = self._size
        return self._renderer.render(self._scene, flags=self._pyrender.RenderFlags.FLAT | flags)[0]


def _gl_error():
    """PyOpenGL's error class in a tuple, or an empty one where PyOpenGL itself cannot be imported."""
    try:
        from OpenGL.error import Error
    except (ImportError, AttributeError, OSError):
        return ()
    return (Error,)


def _first_line(error):
    return (str(error).strip().splitlines() or ["no message"])[0].rstrip(":")


class PinCamera:
    """Draws the grey frame of a design from pin records by pyrender. Cheap to use, dear to make: keep it."""

    def __init__(self, design):
        """design: Design. Raises TactipError where OpenGL cannot be used."""
        self._design = design
        self._lens = Lens(design)
        self._leds = LedRing(design)
        angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
        # A polygon of the disc's area.
        radius = np.sqrt(np.pi / (_SIDES / 2 * np.sin(2 * np.pi / _SIDES)))
        self._rim = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        self._radii = tip_radii(design)
        fan = np.stack([np.zeros(_SIDES, int), 1 + np.arange(_SIDES), 1 + (np.arange(_SIDES) + 1) % _SIDES], 1)
        self._fans = (fan + (_SIDES + 1) * np.arange(len(self._radii))[:, None, None]).reshape(-1, 3)
        self._canvas = OffscreenRenderer(self._lens.width, self._lens.width)
        # Nothing moves it: it is drawn once, which is more than half of what an image would cost.
        self._backdrop, _ = self._canvas.draw(self._skin())

    def render(self, tips, directions):
        """Grey frame (h, w) uint8 of pins with tips (p, 3) m and directions (p, 3), sensor frame."""
        tips, directions = np.asarray(tips, float), np.asarray(directions, float)
        plane = np.einsum("sk,kpj->psj", self._rim, perpendicular_axes(directions))
        discs = np.concatenate([tips[:, None], tips[:, None] + self._radii[:, None, None] * plane], 1)
        grey = self._leds.grey(tips, directions, self._design.optics.pin_albedo)
        mesh = self._canvas.mesh(self._seen(discs.reshape(-1, 3)), self._fans, np.repeat(grey, _SIDES + 1))
        drawn, covered = self._canvas.draw(mesh)
        return blur_and_quantize(drawn + (1 - covered) * self._backdrop, self._design.optics)

    def _seen(self, points):
        """Pixels and depth (n, 3) of points (n, 3)."""
        depth = np.linalg.norm(points - self._lens.position, axis=1)
        # Depth in units of 10 mm, inside the canvas's range.
        return np.concatenate([self._lens.project(points), depth[:, None] * 100], 1)

    def _skin(self):
        """The undeformed inner skin as a mesh: a backdrop, behind all pins, since the real skin moves with them."""
        rings, sides = 40, 96
        polar, azimuth = np.meshgrid(
            np.linspace(0, np.pi / 2, rings + 1), 2 * np.pi * np.arange(sides) / sides, indexing="ij"
        )
        points, normals = inner_skin(self._design, polar.ravel(), azimuth.ravel())
        grey = self._leds.grey(points, normals, self._design.optics.skin_albedo)
        vertices = self._seen(points)
        vertices[:, 2] = _BACKDROP_DEPTH
        # One ring more, far outside the frame and as grey as the rim: there is no edge to be seen there.
        rim = vertices[-sides:].copy()
        rim[:, :2] = self._lens.centre + 10 * (rim[:, :2] - self._lens.centre)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(rings + 1), np.arange(sides), indexing="ij"))
        a, b, c, d = i * sides + j, i * sides + (j + 1) % sides, (i + 1) * sides + j, (i + 1) * sides + (j + 1) % sides
        triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
        return self._canvas.mesh(np.concatenate([vertices, rim]), triangles, np.concatenate([grey, grey[-sides:]]))


if __name__ == "__main__":
    try:
        check_opengl()
    except TactipError as error:
        sys.exit(str(error))
