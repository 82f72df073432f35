"""What draws the camera's frame, by name."""

from tactip_twin.tactip_model.errors import lookup


def renderer_named(name, design):
    """The function of pins' tips and directions (p, 3) each, sensor frame, to a grey frame of a Design's camera (uint8).

    name: pyrender, or raster: the same without OpenGL. Raises TactipError that lists them.
    """
    return lookup("renderer", name, RENDERERS)(design)


def _pyrender(design):
    from tactip_twin.tactip_model.pyrender_renderer import PinCamera

    return PinCamera(design).render


def _raster(design):
    from tactip_twin.tactip_model.raster_renderer import Raster

    return Raster(design).render


RENDERERS = {"pyrender": _pyrender, "raster": _raster}
"""Functions that make them, by name."""
