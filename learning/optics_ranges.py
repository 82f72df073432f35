"""Ranges of the random optics of a sensor, from image to image, by name."""

from dataclasses import dataclass, replace

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class OpticsRanges:
    """Uniform ranges, in both directions unless stated otherwise. Lengths in px are of a tactile image of 128 px."""

    zoom: float = within(0, 0.1, default=0.012)
    """Size of the image, -; 1 % was seen between a neutral image and the frames after it [M]."""
    turn_deg: float = within(0, 10, default=0.5)
    """Turn of the image about its middle [?]."""
    drift: float = within(0, 0.05, default=0.008)
    """Place of the image, in its widths [?]."""
    pin_size: float = within(0, 0.5, default=0.12)
    """Diameter of the pins, of theirs: their make, light and threshold [?]."""
    camera_height_m: float = within(0, 10e-3, default=0.0)
    """Distance of the camera behind the tip, m: how much larger a pin looks that comes nearer. The neutral image does not
    tell it, for the lens is fitted to that; pressed frames tell it to 1.4e-3 [M]."""
    camera_offset_m: float = within(0, 5e-3, default=0.0)
    """Place of the camera beside the tip's axis, m, x and y; the neutral image stays as it is, here too."""
    distortion: float = within(0, 0.2, default=0.0)
    """Radial distortion that the lens's fit has not met: of the radius, at the image's edge, - [?]."""
    stretch: float = within(0, 0.1, default=0.0)
    """Width over height, -; published crops are off by 1.5 % [M]."""
    pin_each: float = within(0, 0.5, default=0.0)
    """Diameter of each pin by itself, of its own [?]."""
    jitter_px: float = within(0, 3, default=0.0)
    """Standard deviation of each pin's place, px: noise of the threshold, and what the mechanics leave unexplained."""
    missing: float = within(0, 0.5, default=0.0)
    """Greatest share of the pins that are not seen; from 0 to it by image."""
    merged_px: float = within(0, 3, default=0.0)
    """Greatest gap between two pins that is bridged, px: blur and a low threshold; from 0 to it by image."""
    speckles: float = within(0, 20, default=0.0)
    """Most specks of light, 1 to 3 px wide, anywhere; from 0 to so many by image."""
    rim_lights: float = within(0, 12, default=0.0)
    """Most arcs of light at the rim, from 0 to so many by image. For frames whose rim is not masked."""

    def __post_init__(self) -> None:
        check(self)


_REAL = OpticsRanges(
    zoom=0.02,
    turn_deg=1.0,
    drift=0.01,
    pin_size=0.25,
    camera_height_m=3e-3,
    camera_offset_m=0.5e-3,
    distortion=0.02,
    stretch=0.015,
    pin_each=0.15,
    jitter_px=0.2,
    missing=0.02,
    merged_px=0.6,
    speckles=2.0,
)

_STEADY = {"zoom": 0.002, "drift": 0.003, "distortion": 0.0, "stretch": 0.0}
"""What is left where zoom and drift since the neutral image were measured, by the light at the rim: one frame tells the zoom
to 3e-4 [M]. How lens and crop distort is in the neutral image: the twin has its pins where that shows them."""

_NO_NOISE = dict.fromkeys(("pin_each", "jitter_px", "missing", "merged_px", "speckles", "rim_lights"), 0.0)

OPTICS: dict[str, OpticsRanges] = {
    "lens": OpticsRanges(),
    "real": _REAL,
    "rim": replace(_REAL, rim_lights=8.0),
    "steady": replace(_REAL, **_STEADY),
}
OPTICS |= {f"{name}-clean": replace(ranges, **_NO_NOISE) for name, ranges in OPTICS.items()}
"""By name: `lens`, what the paper's own sensor may do from day to day; `real`, what real sensors of a kind differ in, after
the calibration to a neutral image; `rim`, the same with light at the rim, for frames that are not masked; `steady`, as
`real`, of a camera whose zoom and drift since the neutral image were measured, which is worth much: a pin of a larger image
lies farther out, as of a deeper contact. Each with `-clean`: without what is not the camera's, and without rim lights."""


def noiseless(name: str) -> str:
    """Return the name of the same ranges without noise."""
    return name if name.endswith("-clean") else f"{name}-clean"
