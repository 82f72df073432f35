"""Renderers of the camera's grey frame, by name. OpenGL and OpenCV are imported only when a renderer is made."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from tactip_twin.tactip_model.errors import lookup

if TYPE_CHECKING:
    import numpy as np

    from tactip_twin.tactip_model.design import Design

    RenderPins = Callable[[np.ndarray, np.ndarray], np.ndarray]

RendererName = Literal["pyrender", "raster"]
"""pyrender: OpenGL; raster: the same image without OpenGL."""


def renderer_named(name: RendererName, design: "Design") -> "RenderPins":
    """Return a function that renders a design's pins.

    The function takes pin tips (..., p, 3), m, and directions (..., p, 3), both in the sensor frame, and returns the
    camera's grey frames (..., h, w) uint8.

    Raises:
        TactipError: The name is unknown, or OpenGL is needed and cannot be used.
    """
    return lookup("renderer", name, RENDERERS)(design)


def _pyrender(design: "Design") -> "RenderPins":
    from tactip_twin.tactip_model.pyrender_renderer import PinCamera

    return PinCamera(design).render


def _raster(design: "Design") -> "RenderPins":
    from tactip_twin.tactip_model.raster_renderer import Raster

    return Raster(design).render


RENDERERS: "dict[RendererName, Callable[[Design], RenderPins]]" = {"pyrender": _pyrender, "raster": _raster}
"""Functions that make a renderer, by name."""
