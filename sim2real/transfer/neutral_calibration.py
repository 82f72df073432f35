"""A design of a real sensor from its neutral image: lens, camera and pins are fitted, the rest is as the field has it.

No label is needed, but where pressed frames stand for that image: their press, by the depth that a table has, is simulated
and taken off. How the camera has changed since that image is told by the light at the rim of unlabelled frames, where it
shows. What neither tells, the mechanics, is varied instead (sim/dataset/mechanics_randomization.py).
"""

from dataclasses import replace

import cv2
import numpy as np

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.format import read_meta
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.import_set import NEUTRAL, NEUTRAL_TACTILE, read_report
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import fit_neutral, fit_pins, neutral_px, reference_pixels
from tactip_twin.tactip_model.optics import Lens
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import NOMINAL
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

_ROUNDS = 4
"""Times that the pins' sizes are corrected."""

_SHARE = 0.75
"""Share of the depth, as a table has it, whose press is taken off what stands for a neutral image. Of two real sets, the
pins come nearest to where they are at all of it (0.44 mm, 127 pins) and at 0.6 of it (1.07 mm, 331 pins): a tip may touch
later than its table says, and gives way as the twin does only when the twin is calibrated. Taken off whole, the pins of the
331-pin tip are 0.40 px of 256 off in place of 0.24, and a network that has seen no label errs by 0.34 mm of depth in place
of 0.29."""

_PRESSED_MM = 3.0
"""The deepest press that is taken off what stands for a neutral image, mm: of one deeper than that it is likelier that a
table's depth has its zero elsewhere. An estimate [?]."""


def fit_design_to_neutral_image(folder, size_px):
    """The Design that fits the neutral image of an imported set, and the figures (dict) of the fit.

    folder: path. size_px: int, width of its tactile images. Raises TactipError where there is no neutral image, and
    where its pins are of no known layout.
    """
    image, tactile = (cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in (NEUTRAL, NEUTRAL_TACTILE))
    if image is None:
        raise TactipError(
            f"{folder} has no {NEUTRAL}, it was imported by an earlier version: import the set anew, or name a design by "
            "--design"
        )
    if tactile is None:
        raise TactipError(f"{folder} has no {NEUTRAL_TACTILE}, it was imported by an earlier version: import the set anew")
    blobs = len(find_blobs(image).centres)
    name = _nearest(blobs)
    design, fit = fit_neutral(replace(NOMINAL[name], name=folder.resolve().name), image)
    pressed_mm = _pressed_mm(folder)
    pressed = _contact(design, pressed_mm)
    if pressed:
        # Of a tip that is fitted a little off, the motion under a press is nearly that of the right one.
        moved = _positions_px(design, pressed) - neutral_px(design)
        design, _ = fit_pins(design, fit.pins_px - moved)
    design = replace(design, image=replace(design.image, size_px=size_px))
    design = with_pin_sizes(design, tactile > 127, pressed and (pressed.tips, pressed.directions))
    camera = camera_of(folder)
    design = with_camera_drift(design, camera)
    found = {"layout": name, "pins": blobs, "before_px": fit.before_px, "lattice_px": fit.lattice_px}
    return design, found | {"pressed_mm": pressed_mm, "camera": camera}


def _pressed_mm(folder):
    """Depth, mm, at which the tip is that an imported set has for its neutral image; 0 if at rest, and over an edge.

    Of frames that are tilted and sheared in turn, the middle is near an upright press.
    """
    report = read_report(folder)
    if report is None or report["neutral_image"] or read_meta(folder)["configuration"]["task"] != "surface":
        return 0.0
    return float(np.clip(-_SHARE * np.mean(report["stand_in"]["pose_z"]), 0.0, _PRESSED_MM))


def _contact(design, depth_mm):
    """The Contact of a Design pressed upright on a flat surface; None where it is not pressed."""
    if not depth_mm:
        return None
    return ContactSimulator(design, "surface", fidelity_named("draft")).play(
        from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), np.zeros(6)
    )


def _positions_px(design, contact):
    """Where a Design's pins appear in a Contact, (p, 2) px of a 256 px image."""
    lens = Lens(design)
    return reference_pixels(lens.project(contact.tips), lens.width)


def camera_of(folder):
    """How the camera of an imported set (path) has changed since its neutral image: dict of zoom (-), drift (2, of width)
    and what one frame tells of them (`of_one_frame`); None where the light at the rim does not tell it."""
    report = read_report(folder)
    return report and report.get("camera")  # a simulated set has no report


def with_camera_drift(design, camera):
    """A Design that was fitted to a neutral image, with its camera as it was after that. camera: of camera_of."""
    if not camera:
        return design
    return replace(design, optics=replace(design.optics, zoom=camera["zoom"], drift=tuple(camera["drift"])))


def nearest_nominal_design(pins, size_px):
    """The preset Design, fitted to nothing, whose number of pins is nearest to `pins` (float). size_px: as of
    fit_design_to_neutral_image."""
    design = NOMINAL[_nearest(pins)]
    return replace(design, image=replace(design.image, size_px=size_px))


def _nearest(pins):
    """Name of the preset whose number of pins is nearest."""
    counts = {name: len(neutral_pins(design)[0]) for name, design in NOMINAL.items()}
    return min(counts, key=lambda name: abs(counts[name] - pins))


def with_pin_sizes(design, image, pins=None):
    """The Design with pins as large as in a tactile image (size, size) bool: in the middle, and at the rim.

    pins: tips and directions, (p, 3) each, of the pins in that image; at rest if None.
    """
    radius = np.linalg.norm(np.indices(image.shape) - (np.array(image.shape)[:, None, None] - 1) / 2, axis=0)
    white = radius[image]
    middle = radius < np.median(white)
    for _ in range(_ROUNDS):
        drawn = tactile_image(Raster(design).render(*(pins or neutral_pins(design))), design.image) > 127
        inner, outer = (np.sqrt(max(image[part].sum(), 1) / max(drawn[part].sum(), 1)) for part in (middle, ~middle))
        # Half of the pins are outside of the middle, most of them near the rim.
        sized = replace(
            design.pins,
            diameter_m=float(np.clip(design.pins.diameter_m * inner, 0.1e-3, design.pins.pitch_m)),
            rim_diameter_m=float(np.clip(design.pins.rim_diameter_m * outer, 0.1e-3, design.pins.pitch_m)),
        )
        design = replace(design, pins=sized)
    return design
