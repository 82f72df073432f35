"""Colors of scenes and pages, and the ramps by which skin and path are colored."""

import numpy as np
from numpy.typing import ArrayLike

Color = tuple[float, float, float]
"""Red, green and blue, 0 to 255."""

OBJECT_COLOR: Color = (226.0, 222.0, 214.0)
SKIN_COLOR: Color = (128.0, 136.0, 152.0)
HOUSING_COLOR: Color = (92.0, 99.0, 114.0)
TABLE_COLOR: Color = (196.0, 199.0, 204.0)
PIN_COLOR: Color = (250.0, 250.0, 250.0)
FORCE_COLOR: Color = (0.0, 130.0, 90.0)
LEFT_OUT_COLOR: Color = (40.0, 42.0, 48.0)

TRUE_COLOR, ESTIMATED_COLOR = "#22262e", "#c2410c"
"""Colors of curves."""

SKIN_RAMP: tuple[Color, ...] = (SKIN_COLOR, (250.0, 190.0, 80.0), (222.0, 84.0, 32.0), (150.0, 14.0, 42.0))
"""Colors of the skin from no displacement to the largest on the scale."""

ERROR_RAMP: tuple[Color, ...] = ((0.0, 114.0, 178.0), (230.0, 159.0, 0.0), (200.0, 20.0, 20.0))
"""Colors of the path from no error to the largest on the scale."""


def ramp_colors(values: ArrayLike, largest: float, ramp: tuple[Color, ...]) -> np.ndarray:
    """Return colors (n, 3), 0 to 255, of values (n,) on a ramp from 0 to `largest`; NaN is colored as 0."""
    at = np.nan_to_num(np.asarray(values, float)) / largest * (len(ramp) - 1)
    return np.stack([np.interp(at, range(len(ramp)), channel) for channel in np.transpose(ramp)], -1)


def scale_end(values: ArrayLike, quantile: float = 0.98) -> float:
    """Return the end of a scale from 0 for values: their quantile, rounded up to 1, 2, 3 or 5 times a power of ten."""
    values = np.abs(np.asarray(values, float))
    high = float(np.quantile(values[np.isfinite(values)], quantile)) if np.isfinite(values).any() else 0.0
    if high <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(high))
    return float(f"{power * next(m for m in (1, 2, 3, 5, 10) if m * power >= high * (1 - 1e-9)):.3g}")


def css_gradient(ramp: tuple[Color, ...]) -> str:
    """Return a ramp as a CSS gradient from left to right."""
    return f"linear-gradient(90deg, {', '.join('rgb({:.0f},{:.0f},{:.0f})'.format(*color) for color in ramp)})"


def linear(srgb: np.ndarray) -> np.ndarray:
    """Return linear intensities of sRGB values, 0 to 1 (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
