"""Named ranges for the optics of a sensor, which augmentation samples for each image."""

from dataclasses import dataclass, replace

from tactip_twin.tactip_model.bounds import check, within


@dataclass(frozen=True)
class OpticsRanges:
    """Half-widths of uniform ranges, unless stated otherwise. Lengths in px refer to a tactile image of 128 px."""

    zoom: float = within(0, 0.1, default=0.012)
    """Relative image size, -; a change of 1 % was measured between a neutral image and later frames [M]."""
    rotation_deg: float = within(0, 10, default=0.5)
    """Rotation of the image about its centre, degrees [?]."""
    drift: float = within(0, 0.05, default=0.008)
    """Translation of the image, as a fraction of its width [?]."""
    pin_size: float = within(0, 0.5, default=0.12)
    """Relative diameter of all pins, -: manufacture, light and threshold [?]."""
    camera_height_m: float = within(0, 10e-3, default=0.0)
    """Height of the camera behind the tip, m: it determines how much a pin grows as it approaches. The neutral image
    does not constrain it, because the lens is fitted to that image; pressed frames determine it to 1.4e-3 [M]."""
    camera_offset_m: float = within(0, 5e-3, default=0.0)
    """Offset of the camera from the tip's axis in x and y, m; this does not change the neutral image either."""
    distortion: float = within(0, 0.2, default=0.0)
    """Residual radial distortion after the lens fit, as a fraction of the radius at the image edge, - [?]."""
    stretch: float = within(0, 0.1, default=0.0)
    """Aspect ratio, -; published crops are off by 1.5 % [M]."""
    pin_each: float = within(0, 0.5, default=0.0)
    """Relative diameter of each pin, sampled independently, - [?]."""
    jitter_px: float = within(0, 3, default=0.0)
    """Standard deviation of each pin's position, px: threshold noise and residuals of the mechanics."""
    missing: float = within(0, 0.5, default=0.0)
    """Maximum fraction of missing pins, sampled from 0 for each image."""
    merged_px: float = within(0, 3, default=0.0)
    """Maximum gap at which two pins merge, px, as with blur or a low threshold; sampled from 0 for each image."""
    speckles: float = within(0, 20, default=0.0)
    """Maximum number of specks of light, 1 to 3 px wide, anywhere; sampled from 0 for each image."""
    salt: float = within(0, 1, default=0.0)
    """Maximum fraction of the pixels that the camera's noise makes white, sampled for each image, most often small [?]."""
    rim_lights: float = within(0, 12, default=0.0)
    """Maximum number of arcs of light at the rim, sampled from 0 for each image. For frames whose rim is not masked."""

    def __post_init__(self) -> None:
        check(self)


_REAL = OpticsRanges(
    zoom=0.02,
    rotation_deg=1.0,
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
"""Residual ranges where zoom and drift since the neutral image were measured by the light at the rim: one frame determines
the zoom to 3e-4 [M]. There is no residual distortion, because the design was fitted to the neutral image."""

_NO_NOISE = dict.fromkeys(("pin_each", "jitter_px", "missing", "merged_px", "speckles", "salt", "rim_lights"), 0.0)

OPTICS: dict[str, OpticsRanges] = {
    "lens": OpticsRanges(),
    "lens-jitter": OpticsRanges(jitter_px=0.5),
    "lens-salt": OpticsRanges(jitter_px=0.5, salt=0.6),
    "real": _REAL,
    "rim": replace(_REAL, rim_lights=8.0),
    "steady": replace(_REAL, **_STEADY),
}
OPTICS |= {f"{name}-clean": replace(ranges, **_NO_NOISE) for name, ranges in OPTICS.items()}
"""Ranges by name: `lens`, day-to-day changes of one sensor; `lens-jitter`, also the chance by which a renderer or a
threshold makes a pixel white, without which single pixels tell the undeformed tip; `lens-salt`, also a camera's noise;
`real`, differences between real sensors of the same design after calibration to a neutral image; `rim`, the same with light
at the rim, for frames that are not masked; `steady`, as `real`, for a camera whose zoom and drift since the neutral image
were measured. Measuring them matters, because both zoom and a deeper contact move pins outwards. Each also exists with the
suffix `-clean`, without pin noise and lights."""


def noiseless(name: str) -> str:
    """Return the name of the same ranges without noise."""
    return name if name.endswith("-clean") else f"{name}-clean"
