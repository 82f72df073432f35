"""Design of a real sensor from its neutral image: lens, camera and pins are fitted, the rest is nominal.

No label is needed, unless the set has no such image and frames replace it (sim2real/importing/missing_neutral.py). Changes
of the camera since that image are measured by the light at the rim of unlabelled frames, if there is some. The mechanics,
which neither shows, are randomized instead (sim/dataset/mechanics_randomization.py).
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim2real.importing.import_set import NEUTRAL, NEUTRAL_TACTILE, read_report
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_images import read_image
from tactip_twin.tactip_model.neutral_image import fit_neutral
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import NOMINAL, nearest_nominal
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.sensor_of_image import sensor_of
from tactip_twin.tactip_model.tactile_image import tactile_image

_ROUNDS = 4
"""Number of iterations that correct the pins' sizes."""

_KINETIC_FRACTION = 0.63
"""Ratio of kinetic to static friction of a fitted design: the middle of the 0.4 to 0.99 that `real` mechanics make of it.
Both calibrated tips have 0.55 [M] (docs/your-own-sensor.md); the nominal ones have 1."""


def fit_design_to_neutral_image(folder: Path, size_px: int) -> tuple[Design, dict[str, Any]]:
    """Return the design that fits the neutral image of an imported set, and the figures of the fit.

    Args:
        folder: Folder of the set.
        size_px: Width of its tactile images, px.

    Raises:
        TactipError: If there is no neutral image, or it does not show pins.
    """
    image, tactile = (read_image(folder / name) if (folder / name).exists() else None for name in (NEUTRAL, NEUTRAL_TACTILE))
    if image is None:
        raise TactipError(
            f"{folder} has no {NEUTRAL}, so it was not made by this version of tactip import: import the set, or give a "
            "design with --design"
        )
    if tactile is None:
        raise TactipError(
            f"{folder} has no {NEUTRAL_TACTILE}, so it was not made by this version of tactip import: import the set"
        )
    report = read_report(folder)
    if report and not report["neutral_image"] and "press_removed" not in report.get("stand_in", {}):
        raise TactipError(
            f"{folder} has no neutral image, and an earlier version made its replacement: import the set again"
        )
    nominal = sensor_of(image)
    materials = replace(nominal.materials, kinetic_fraction=_KINETIC_FRACTION)
    design, fit = fit_neutral(replace(nominal, name=folder.resolve().name, materials=materials), image)
    design = replace(design, image=replace(design.image, size_px=size_px))
    design = with_pin_sizes(design, tactile > 127)
    camera = camera_of(folder)
    design = with_camera_drift(design, camera)
    found = {
        "layout": nominal.name,
        "pins": len(neutral_pins(design)[0]),
        "before_px": fit.before_px,
        "lattice_px": fit.lattice_px,
    }
    return design, found | {"camera": camera}


def camera_of(folder: Path) -> dict[str, Any] | None:
    """Return the change of an imported set's camera since its neutral image: zoom (-), drift (2,) in image widths, and
    their deviations by one frame (`of_one_frame`); None if there is too little light at the rim."""
    report = read_report(folder)
    return report.get("camera") if report else None  # a simulated set has no report


def with_camera_drift(design: Design, camera: dict[str, Any] | None) -> Design:
    """Return a design that was fitted to a neutral image with the later change of its camera, from `camera_of`."""
    if not camera:
        return design
    return replace(design, optics=replace(design.optics, zoom=camera["zoom"], drift=tuple(camera["drift"])))


def nearest_nominal_design(pins: float, size_px: int) -> Design:
    """Return the nominal design whose number of pins is nearest to `pins`, with images `size_px` wide."""
    design = NOMINAL[nearest_nominal(pins)]
    return replace(design, image=replace(design.image, size_px=size_px))


def with_pin_sizes(design: Design, image: np.ndarray) -> Design:
    """Return the design with the pin sizes of a tactile image of the tip at rest, in the middle and at the rim.

    Args:
        design: The design.
        image: (size, size) bool, the tactile image.
    """
    radius = np.linalg.norm(np.indices(image.shape) - (np.array(image.shape)[:, None, None] - 1) / 2, axis=0)
    white = radius[image]
    middle = radius < np.median(white)
    for _ in range(_ROUNDS):
        rendered = tactile_image(Raster(design).render(*neutral_pins(design)), design.image) > 127
        inner, outer = (np.sqrt(max(image[part].sum(), 1) / max(rendered[part].sum(), 1)) for part in (middle, ~middle))
        # Half of the pins lie outside the middle, most of them near the rim.
        sized = replace(
            design.pins,
            diameter_m=float(np.clip(design.pins.diameter_m * inner, 0.1e-3, design.pins.pitch_m)),
            rim_diameter_m=float(np.clip(design.pins.rim_diameter_m * outer, 0.1e-3, design.pins.pitch_m)),
        )
        design = replace(design, pins=sized)
    return design
