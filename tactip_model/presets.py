"""Preset designs: two TacTips fitted to real frames, and a nominal version of each.

The fitted designs are files in designs/, written by `tactip calibrate`, with their provenance. The nominal ones are
starting points for calibrating another sensor of the same kind.
"""

from pathlib import Path

from tactip_twin.tactip_model.design import Design, Optics, Pins
from tactip_twin.tactip_model.design_file import read_design
from tactip_twin.tactip_model.errors import TactipError, lookup

NOMINAL = {
    # The first ring is rotated by 29.5 degrees; the centre is at (126.2, 129.8), counted from the middle of the first pixel
    # of a 256 px image [M].
    "nominal-127": Design("nominal-127", pins=Pins(rotation_deg=29.5), optics=Optics(centre=(126.7 / 256, 130.3 / 256))),
    "nominal-331": Design(
        "nominal-331",
        # The pitch gives the same extent as the other's; the length is that of the calibrated tip, whose denser pins are
        # shorter; the diameters follow the blobs of its neutral image [M].
        pins=Pins(
            "circular",
            rings=10,
            pitch_m=1.8e-3,
            length_m=1.2e-3,
            diameter_m=0.76e-3,
            rim_diameter_m=1.34e-3,
            rotation_deg=-2.05,
        ),
        optics=Optics(neutral_radius=(7.946, 0.0200, -3.18e-5), centre=(178.4 / 360, 175.5 / 360)),
    ),
}
"""Nominal designs, by name."""

PINS_EXTENT_M = 18e-3
"""Distance of their outermost pins from the axis in plan view, m."""

FITTED = {name: Path(__file__).with_name("designs") / f"{name}.json" for name in ("tactip-127", "tactip-331")}
"""Files of the fitted designs, by name."""

DESIGNS = (*FITTED, *NOMINAL)
"""Names of all presets."""


def design_named(name: str) -> Design:
    """Return a preset design; raise TactipError that lists the presets if there is none of this name."""
    chosen = lookup("design", name, FITTED | NOMINAL)
    return read_design(chosen) if isinstance(chosen, Path) else chosen


def load_design(name: str | Path) -> Design:
    """Return a preset design by its name, or the design in a JSON file by its path (anything that ends in .json).

    Raises:
        TactipError: There is no such preset or file, or the file holds no design; the message names the field and what is
            allowed.
    """
    name = str(name)
    if not name.endswith(".json"):
        return design_named(name)
    if not Path(name).is_file():
        raise TactipError(f"the design file {name} does not exist; presets are {', '.join(DESIGNS)}")
    return read_design(name)


def nearest_nominal(pins: float) -> str:
    """Return the name of the nominal preset whose number of pins is nearest to `pins`."""
    from tactip_twin.tactip_model.pins import neutral_pins

    return min(NOMINAL, key=lambda name: abs(len(neutral_pins(NOMINAL[name])[0]) - pins))
