"""The designs that have a name: two TacTips that were fitted to real frames, and the same two as one would describe them.

The fitted ones are files in designs/, as `tactip calibrate` wrote them, with their provenance. A nominal one is where the
calibration of another sensor of its kind begins.
"""

from pathlib import Path

from tactip_twin.tactip_model.design import Design, Optics, Pins
from tactip_twin.tactip_model.design_file import read_design
from tactip_twin.tactip_model.errors import TactipError, lookup

NOMINAL = {
    # The first ring is turned by 29.5 degrees; the centre is at (126.2, 129.8), counted from the middle of the first pixel
    # of a 256 px image [M].
    "nominal-127": Design("nominal-127", pins=Pins(rotation_deg=29.5), optics=Optics(centre=(126.7 / 256, 130.3 / 256))),
    "nominal-331": Design(
        "nominal-331",
        # Pitch by the same extent as the other's; blob sizes by those of its neutral image [M].
        pins=Pins("circular", rings=10, pitch_m=1.8e-3, diameter_m=0.76e-3, rim_diameter_m=1.34e-3, rotation_deg=-2.05),
        optics=Optics(neutral_radius=(7.946, 0.0200, -3.18e-5), centre=(178.4 / 360, 175.5 / 360)),
    ),
}

FITTED = {name: Path(__file__).with_name("designs") / f"{name}.json" for name in ("tactip-127", "tactip-331")}

DESIGNS = (*FITTED, *NOMINAL)
"""Names of all presets."""


def design_named(name):
    """Return the preset Design called `name`; raise TactipError that lists the presets where there is none."""
    chosen = lookup("design", name, FITTED | NOMINAL)
    return read_design(chosen) if isinstance(chosen, Path) else chosen


def find_design(name):
    """The Design of a preset's name, or of a JSON file's path (anything that ends in .json).

    Raises TactipError where there is neither, and where a file is no design: it names the field and what is allowed.
    """
    name = str(name)
    if not name.endswith(".json"):
        return design_named(name)
    if not Path(name).is_file():
        raise TactipError(f"the design file {name} does not exist; presets are {', '.join(DESIGNS)}")
    return read_design(name)
