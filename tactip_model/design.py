"""The design of a TacTip: dimensions, materials, pins, optics. Data only; presets are in presets.py.

Sources, here and below: [P] Lepora & Lloyd, RAM 2020; [M] measured on public images of real sensors (Tac-VGNN);
[R] read in a public source; [?] disputed, a prior to calibrate.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from tactip_twin.tactip_model.bounds import check, require, within

PinLayout = Literal["hexagonal", "circular", "free"]
"""hexagonal: a hexagon of a triangular lattice; circular: rings of 6k pins. Both surround a centre pin [R]."""

MAX_LAYOUT_RADIUS = 0.95
"""Maximum distance of the outermost pins from the axis, in dome radii; farther out there is no skin to hold a pin."""

MAX_SKIN_TO_GEL_RATIO = 500.0
"""Largest ratio of the skin's modulus to the gel's, -; the sensor's is about 30. At 500 every depth up to 8 mm and every
thickness from 0.2 to 2 mm converges. At 1000 the skin buckles like a shell on a soft bed, in an arbitrary shape."""


@dataclass(frozen=True)
class TipGeometry:
    """Dimensions of the soft tip: a hemisphere whose rim is bonded to the housing."""

    radius_m: float = within(10e-3, 40e-3, default=20e-3)
    """Outer radius of the dome, m. 40 mm across [R: RAM Dec 2021, p. 49]."""
    cylinder_m: float = within(0, 20e-3, default=0.0)
    """Height of the gel behind the rim, m; at most about 5e-3, since a tip holds 20 ml of gel [R]. Zero by default because
    the measured depth response of the 127-pin tip is reproduced as well without it (docs/architecture.md)."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Materials:
    """Materials of the tip and its friction."""

    skin_thickness_m: float = within(0.2e-3, 3e-3, default=1e-3)
    """Thickness of the rubber skin, m [?]."""
    skin_young_pa: float = within(1, 1e8, default=0.6e6)
    """Young's modulus of the skin, Pa; 0.4e6 to 0.8e6 for TangoBlack+ and Agilus30 [?]."""
    skin_poisson: float = within(0, 0.499, default=0.45)
    """Poisson's ratio of the skin, - [?]."""
    gel_young_pa: float = within(1e3, 1e6, default=2e4)
    """Young's modulus of the gel, Pa; 1e4 to 5e4 [?]. 2e4 reproduces the measured force [R: load cell] and depth
    response [M]."""
    gel_poisson: float = within(0, 0.499, default=0.49)
    """Poisson's ratio of the gel, - [?]. The mesh may use a smaller one: see `mesh.Resolution`."""
    density_kg_m3: float = within(105, 10500, default=1050.0)
    """Density of skin and gel, kg/m^3 (silicone rubber)."""
    friction: float = within(0, 2, default=0.6)
    """Coulomb friction coefficient of the skin on the stimulus, -; 0.55 to 0.7 was measured with a load cell [R], and frames
    of real tips are reproduced with similar values [M]."""
    kinetic_fraction: float = within(0.1, 1, default=1.0)
    """Ratio of the friction that remains once the skin has slid to `friction`, -; 1 is Coulomb's law. Frames of two real
    tips are reproduced with about a half [M]."""
    slip_weakening_m: float = within(0.1e-3, 20e-3, default=1e-3)
    """Slip-weakening distance, m: the sliding distance over which friction falls to that ratio. About 1e-3 from frames of a
    real tip [M]; no effect if the ratio is 1."""
    damping_s: float = within(0.5e-3, 50e-3, default=0.005)
    """Stiffness-proportional Rayleigh damping of gel and skin, s: stress per strain rate over stiffness. Motions are
    quasi-static, so it affects how fast the tip settles, but not where."""

    def __post_init__(self) -> None:
        check(self)
        max_young = MAX_SKIN_TO_GEL_RATIO * self.gel_young_pa
        require(
            self.skin_young_pa <= max_young,
            "skin_young_pa",
            self.skin_young_pa,
            f"at most {MAX_SKIN_TO_GEL_RATIO:g} times gel_young_pa, {max_young:g}, or the skin buckles as a shell",
        )


@dataclass(frozen=True)
class Pins:
    """The white pins inside the skin."""

    layout: PinLayout = "hexagonal"
    """Arrangement of the pins: `hexagonal` or `circular`; `free`: no lattice, `as_built_m` has each pin's position."""
    rings: int = within(1, 20, default=6)
    """Number of rings around the centre pin; 6 hexagonal rings make 127 pins, 10 circular ones 331 [R].
    If `free`, only the extent in pitches."""
    pitch_m: float = within(0.5e-3, 10e-3, default=3.0e-3)
    """Distance between neighbouring pins in plan view, m; 2.8e-3 to 3.1e-3 in the neutral images [M]. If `free`, only the
    unit of `Optics.neutral_radius`, and the largest diameter."""
    length_m: float = within(0.5e-3, 5e-3, default=1.8e-3)
    """Depth of the pin tip below the outer surface, m; 1.8e-3 fits the depth response of the 127-pin tip best [M], the
    estimate before was about 2e-3 [?]."""
    diameter_m: float = within(0.1e-3, 5e-3, default=0.90e-3)
    """Diameter of the white pin tip at the centre, m; fitted to the blobs of the neutral image [M], which the threshold
    makes larger than the pins. The estimate before was about 1.2e-3 [?]."""
    rim_diameter_m: float = within(0.1e-3, 5e-3, default=0.78e-3)
    """Apparent diameter at the outermost ring, m, where light and focus differ; fitted [M]. In between, the diameter
    changes from `diameter_m` with the square of the distance from the axis."""
    rotation_deg: float = within(-360, 360, default=0.0)
    """Rotation of the lattice from the image's x axis towards its y axis (down), degrees."""
    as_built_m: tuple[tuple[float, float], ...] = ()
    """Offset of each pin's root from the lattice in plan, x and y, m, in the layout's order; empty for a perfect tip.
    Offsets of printed tips are about 0.15 mm. Measured from the neutral image (neutral_image.py). If the layout is `free`,
    the positions themselves, from the tip's axis."""

    def __post_init__(self) -> None:
        check(self)
        free = self.layout == "free"
        if free:
            require(bool(self.as_built_m), "as_built_m", self.as_built_m, "the positions of the pins, if the layout is free")
        for offset in self.as_built_m:
            close = len(offset) == 2 and all(math.isfinite(x) and (free or abs(x) <= self.pitch_m / 2) for x in offset)
            allowed = "an x and a y for each pin" if free else "an x and a y of at most half the pitch for each pin"
            require(close, "as_built_m", offset, allowed)


@dataclass(frozen=True)
class Optics:
    """Camera, lens and light inside the sensor."""

    camera_height_m: float = within(1e-3, 100e-3, default=8e-3)
    """Distance of the camera's pinhole behind the plane of the rim, m; fitted to the depth response [M]."""
    neutral_radius: tuple[float, float, float] = within(-100, 100, default=(11.31, 0.0516, 0.00235))
    """Radial map of the neutral image: a pin's distance from the image centre is c1 u + c3 u^3 + c5 u^5 px (of 256), where u
    is its distance from the camera's axis in pitches. The lens is derived from it (optics.py)."""
    centre: tuple[float, float] = within(0, 1, default=(0.5, 0.5))
    """Position of the camera's axis in the image, in image widths from the left and from the top."""
    camera_offset_m: tuple[float, float] = within(-5e-3, 5e-3, default=(0.0, 0.0))
    """Offset of the camera's axis from the tip's, x and y, m; the axes are parallel. Fitted to the neutral image [M]."""
    zoom: float = within(0.8, 1.25, default=1.0)
    """Ratio of the size of the image in use to that of the neutral image, -. Cameras warm up: in the measured tips' pressed
    frames the reflections at the rim were 1 % farther out than in the neutral ones, whatever the contact [M]."""
    drift: tuple[float, float] = within(-0.05, 0.05, default=(0.0, 0.0))
    """Shift of the image in use relative to the neutral image, to the right and down, in image widths."""
    frame_px: int = within(16, 4096, default=360)
    """Width and height of the square grey frame, px: the pins cover about 360 px of a real 640×480 frame."""
    leds: int = within(1, 64, default=6)
    """Number of LEDs in the ring [R: a ring; six reflections in the neutral image, M]."""
    led_ring_radius_m: float = within(0, 100e-3, default=15e-3)
    """Radius of the ring of LEDs, m [?]."""
    led_height_m: float = within(0, 100e-3, default=10e-3)
    """Distance of the LEDs behind the plane of the rim, m [?]."""
    pin_albedo: float = within(0.01, 1, default=0.9)
    """Diffuse reflectance of the pin tips, - [?]."""
    skin_albedo: float = within(0, 1, default=0.06)
    """Diffuse reflectance of the black inner skin, - [?]."""
    exposure: float = within(0.01, 1, default=0.4)
    """Brightness of the neutral centre pin, as a fraction of full white."""
    blur_px: float = within(0, 20, default=0.5)
    """Standard deviation of the lens's blur, px of the grey frame [?]."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class TactileImage:
    """Conversion of a grey frame to the tactile image. Simulated and real frames share it (tactile_image.py)."""

    crop: tuple[int, int, int, int] | None = within(0, 65536, default=None)
    """Left, top, right and bottom of the part of the frame that is used, px; None for the whole frame."""
    threshold: tuple[int, float] | None = within((3, -255), (65535, 255), default=(61, -5.0))
    """Block (odd, px of the frame) and constant (grey levels) of the mean adaptive threshold: a pixel is white when it
    is brighter than its block's mean minus the constant. Real frames were thresholded with (61, -5) [R]. None for
    frames that are already binary."""
    size_px: int = within(8, 4096, default=128)
    """Width and height of the tactile image, px [P]."""
    grey: bool = False
    """Whether the tactile image keeps the frame's grey levels instead of being thresholded; binary [P]."""

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Design:
    """A tactile fingertip."""

    name: str
    """Name of the design, as the preset's or in its file."""
    shape: TipGeometry = field(default_factory=TipGeometry)
    """Dimensions of the soft tip."""
    materials: Materials = field(default_factory=Materials)
    """Materials of the tip and its friction."""
    pins: Pins = field(default_factory=Pins)
    """The pins inside the skin."""
    optics: Optics = field(default_factory=Optics)
    """Camera, lens and light."""
    image: TactileImage = field(default_factory=TactileImage)
    """Conversion of a frame to the tactile image."""

    def __post_init__(self) -> None:
        """Check that the parts fit each other."""
        radius, pins, materials = self.shape.radius_m, self.pins, self.materials
        max_thickness = 0.15 * radius
        require(
            materials.skin_thickness_m <= max_thickness,
            "skin_thickness_m",
            materials.skin_thickness_m,
            f"at most 0.15 of the dome's radius, {max_thickness:g} m",
        )
        require(pins.length_m <= radius / 4, "length_m", pins.length_m, "at most a quarter of the dome's radius")
        max_extent = MAX_LAYOUT_RADIUS * radius
        if pins.layout == "free":
            extent = max(math.hypot(*place) for place in pins.as_built_m)
            allowed = f"at most {max_extent:g} m from the tip's axis, {MAX_LAYOUT_RADIUS} of the dome's radius"
            require(extent <= max_extent, "as_built_m", extent, allowed)
        require(
            pins.layout == "free" or pins.rings * pins.pitch_m <= max_extent,
            "pitch_m",
            pins.pitch_m,
            f"at most {max_extent / pins.rings:g} m with {pins.rings} rings, "
            f"within {MAX_LAYOUT_RADIUS} of the dome's radius",
        )
        for name in ("diameter_m", "rim_diameter_m"):
            value = getattr(pins, name)
            require(value <= pins.pitch_m, name, value, f"at most the pitch, {pins.pitch_m:g} m")
