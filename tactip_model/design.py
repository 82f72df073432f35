"""What a TacTip is: dimensions, materials, pins, optics. Data only; presets are in presets.py.

Sources, here and below: [P] Lepora & Lloyd, RAM 2020; [M] measured on public images of real sensors (Tac-VGNN);
[R] read in a public source; [?] disputed, a prior to calibrate.
"""

from dataclasses import dataclass, field

from tactip_twin.tactip_model.bounds import check, require, within

WIDEST_LAYOUT = 0.95
"""Farthest that the outermost pins may be from the axis, in radii of the dome: beyond, there is no skin to root in."""

STIFFEST_SKIN = 500.0
"""Greatest ratio of the skin's modulus to the gel's, -; that of the sensor is about 30. At 500 every depth to 8 mm and
thickness of 0.2 to 2 mm converges; at 1000 the skin buckles like a shell on a soft bed, and in which shape is chance."""


@dataclass(frozen=True)
class TipGeometry:
    """Dimensions of the soft tip. A hemisphere, its rim bonded to the housing."""

    radius_m: float = within(10e-3, 40e-3, default=20e-3)
    """Outer radius of the dome, m. 40 mm across [R: RAM Dec 2021, p. 49]."""
    cylinder_m: float = within(0, 20e-3, default=0.0)
    """Height of gel behind the rim, m; at most about 5e-3 by the 20 ml of gel in a tip [R]. The measured depth response
    of the 127-pin tip is met as well without it (docs/architecture.md), so that it is left out."""

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Materials:
    """What the tip is made of."""

    skin_thickness_m: float = within(0.2e-3, 3e-3, default=1e-3)
    """Thickness of the rubber skin, m [?]."""
    skin_young_pa: float = within(1, 1e8, default=0.6e6)
    """Young's modulus of the skin, Pa; 0.4e6 to 0.8e6 for TangoBlack+ and Agilus30 [?]."""
    skin_poisson: float = within(0, 0.499, default=0.45)
    """Poisson's ratio of the skin, - [?]."""
    gel_young_pa: float = within(1e3, 1e6, default=2e4)
    """Young's modulus of the gel, Pa; 1e4 to 5e4 [?]. 2e4 meets the measured force [R: load cell] and depth response [M]."""
    gel_poisson: float = within(0, 0.499, default=0.49)
    """Poisson's ratio of the gel, - [?]. The mesh may use less than this: see `mesh.Resolution`."""
    density_kg_m3: float = within(105, 10500, default=1050.0)
    """Density of skin and gel, kg/m^3 (silicone rubber)."""
    friction: float = within(0, 2, default=0.6)
    """Coulomb friction of skin on the stimulus, -; 0.55 to 0.7 was seen under a load cell [R], and frames of real tips are
    met with about as much [M]."""
    kinetic_share: float = within(0.1, 1, default=1.0)
    """Share of that friction that is left where the skin has slid, -; 1 is Coulomb's law. The frames of two real tips are
    met with about a half [M]."""
    kinetic_after_m: float = within(0.1e-3, 20e-3, default=1e-3)
    """Slide after which no more than that share is left, m: friction falls along the way. About 1e-3 by the frames of a real
    tip [M]; without effect if the share is 1."""
    damping_s: float = within(0.5e-3, 50e-3, default=0.005)
    """Rayleigh damping of gel and skin, s: stress per strain rate over stiffness. Motions are quasi-static, so that it
    sets how fast the tip comes to rest and not where."""

    def __post_init__(self):
        check(self)
        most = STIFFEST_SKIN * self.gel_young_pa
        require(
            self.skin_young_pa <= most,
            "skin_young_pa",
            self.skin_young_pa,
            f"at most {STIFFEST_SKIN:g} times gel_young_pa, {most:g}, or the skin buckles as a shell",
        )


@dataclass(frozen=True)
class Pins:
    """The white pins inside the skin."""

    layout: str = "hexagonal"
    """`hexagonal`: a hexagon of a triangular lattice; `circular`: rings of 6k pins. Both round a centre pin [R]."""
    rings: int = within(1, 20, default=6)
    """Rings round the centre pin; 6 hexagonal rings make 127 pins, 10 circular ones 331 [R]."""
    pitch_m: float = within(0.5e-3, 10e-3, default=3.0e-3)
    """Distance of neighbours in plan view, m; 2.8e-3 to 3.1e-3 by the neutral images [M]."""
    length_m: float = within(0.5e-3, 5e-3, default=1.8e-3)
    """Depth of the pin's tip below the outer surface, m; about 2e-3 was remembered [?], 1.8e-3 fits the depth response
    of the 127-pin tip best [M]."""
    diameter_m: float = within(0.1e-3, 5e-3, default=0.90e-3)
    """Diameter of the white tip at the centre, m; fitted to the blobs of the neutral image [M], which the threshold
    makes larger than the pins (about 1.2e-3 was remembered [?])."""
    rim_diameter_m: float = within(0.1e-3, 5e-3, default=0.78e-3)
    """The same as it appears at the outermost ring, m: light and focus differ there; fitted [M]. It goes from
    `diameter_m` with the square of the distance from the axis."""
    rotation_deg: float = within(-360, 360, default=0.0)
    """Turn of the lattice from the image's x axis towards its y axis (down), degrees."""
    as_built_m: tuple[tuple[float, float], ...] = ()
    """How far each pin's root is off the lattice in plan, x and y, m, in the layout's order; none for a perfect tip.
    Printed tips are some 0.15 mm off. Measured by the neutral image (neutral.py)."""

    def __post_init__(self):
        check(self)
        for offset in self.as_built_m:
            close = len(offset) == 2 and all(abs(x) <= self.pitch_m / 2 for x in offset)
            require(close, "as_built_m", offset, "an x and a y of at most half the pitch for each pin")


@dataclass(frozen=True)
class Optics:
    """Camera, lens and light inside the sensor."""

    camera_height_m: float = within(1e-3, 100e-3, default=8e-3)
    """Distance of the camera's pinhole behind the plane of the rim, m; fitted to the depth response [M]."""
    neutral_radius: tuple[float, float, float] = within(-100, 100, default=(11.31, 0.0516, 0.00235))
    """The neutral image: distance of a pin from the image centre is c1 u + c3 u^3 + c5 u^5 pixels (256 px wide), u its
    distance from the camera's axis in pitches. The lens is derived from it (optics.py)."""
    centre: tuple[float, float] = within(0, 1, default=(0.5, 0.5))
    """Image of the camera's axis, in image widths from the left and from the top."""
    camera_offset_m: tuple[float, float] = within(-5e-3, 5e-3, default=(0.0, 0.0))
    """The camera's axis is parallel to the tip's and this far off it, x and y, m. Fitted to the neutral image [M]."""
    zoom: float = within(0.8, 1.25, default=1.0)
    """Size of the image in use over that in the neutral image, -. Cameras grow warm: the reflections at the rim of the
    measured tips were 1 % farther out in their pressed frames than in their neutral ones, whatever the contact [M]."""
    drift: tuple[float, float] = within(-0.05, 0.05, default=(0.0, 0.0))
    """How far the image in use lies off the neutral image, to the right and down, in image widths."""
    frame_px: int = within(16, 4096, default=360)
    """Width and height of the square grey frame, px: the part of a real 640×480 frame that sees the pins is about 360."""
    leds: int = within(1, 64, default=6)
    """LEDs in the ring [R: a ring; six reflections in the neutral image, M]."""
    led_ring_radius_m: float = within(0, 100e-3, default=15e-3)
    """Radius of the ring of LEDs, m [?]."""
    led_height_m: float = within(0, 100e-3, default=10e-3)
    """Distance of the LEDs behind the plane of the rim, m [?]."""
    pin_albedo: float = within(0.01, 1, default=0.9)
    """Diffuse reflectance of the pins' tips, - [?]."""
    skin_albedo: float = within(0, 1, default=0.06)
    """Diffuse reflectance of the black inner skin, - [?]."""
    exposure: float = within(0.01, 1, default=0.4)
    """Brightness of the neutral centre pin, of full white."""
    blur_px: float = within(0, 20, default=0.5)
    """Standard deviation of the lens's blur, px of the grey frame [?]."""

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class TactileImage:
    """From a grey frame to the binary tactile image. The same settings and code take a real frame (image.py)."""

    crop: tuple[int, int, int, int] | None = within(0, 65536, default=None)
    """Left, top, right, bottom of the part of the frame that is used, px; all of it if None."""
    threshold: tuple[int, float] | None = within((3, -255), (65535, 255), default=(61, -5.0))
    """Block (odd, px of the frame) and constant (grey levels) of the mean adaptive threshold: a pixel is white when it
    is brighter than its block's mean minus the constant. (61, -5) is the setting used on real frames [R]. None for
    frames that are binary already."""
    size_px: int = within(8, 4096, default=128)
    """Width and height of the tactile image, px [P]."""

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Design:
    """A tactile fingertip."""

    name: str
    """What it is called: a preset's name, or what its file says."""
    shape: TipGeometry = field(default_factory=TipGeometry)
    """Dimensions of the soft tip."""
    materials: Materials = field(default_factory=Materials)
    """What the tip is made of."""
    pins: Pins = field(default_factory=Pins)
    """The pins inside the skin."""
    optics: Optics = field(default_factory=Optics)
    """Camera, lens and light."""
    image: TactileImage = field(default_factory=TactileImage)
    """How a frame becomes the tactile image."""

    def __post_init__(self):
        """Refuse parts that do not fit each other."""
        radius, pins, materials = self.shape.radius_m, self.pins, self.materials
        thickest = 0.15 * radius
        require(
            materials.skin_thickness_m <= thickest,
            "skin_thickness_m",
            materials.skin_thickness_m,
            f"at most 0.15 of the dome's radius, {thickest:g} m",
        )
        require(pins.length_m <= radius / 4, "length_m", pins.length_m, "at most a quarter of the dome's radius")
        widest = WIDEST_LAYOUT * radius
        require(
            pins.rings * pins.pitch_m <= widest,
            "pitch_m",
            pins.pitch_m,
            f"at most {widest / pins.rings:g} m with {pins.rings} rings, within {WIDEST_LAYOUT} of the dome's radius",
        )
        for name in ("diameter_m", "rim_diameter_m"):
            value = getattr(pins, name)
            require(value <= pins.pitch_m, f"Pins.{name}", value, f"at most the pitch, {pins.pitch_m:g} m")
