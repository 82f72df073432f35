"""Lens and light: where a point inside the sensor appears in the frame, and how bright.

Both renderers (pyrender_renderer.py, raster_renderer.py) use these functions, so they differ only in rasterization.
The camera looks along +z of the sensor frame, x to the right and y down in the image.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.pins import neutral_pins, plan_positions

REFERENCE_PX = 256
"""Image width, px, in which `Optics.neutral_radius` is given."""


class Lens:
    """A rotationally symmetric wide-angle lens: image radius k1 a + k3 a³ + k5 a⁵ of a ray at angle a to the axis.

    The coefficients are fitted by least squares, so the design's undeformed pins appear where its neutral image has them.
    Beyond the outermost undeformed pin the radius continues in a straight line, because a polynomial extrapolates badly.
    """

    def __init__(self, design: Design) -> None:
        """Fit the coefficients to a design."""
        optics = design.optics
        free = design.pins.layout == "free"
        lattice = design if free else replace(design, pins=replace(design.pins, as_built_m=()))
        self.width = optics.frame_px
        self.centre = (np.array(optics.centre) + optics.drift) * self.width
        self.position = np.array([*optics.camera_offset_m, -design.shape.radius_m - optics.camera_height_m])
        self.scale = optics.zoom * self.width / REFERENCE_PX
        pin_tips, _ = neutral_pins(lattice)
        off_axis = np.linalg.norm(plan_positions(lattice.pins) - optics.camera_offset_m, axis=1)
        radii = _odd(off_axis / design.pins.pitch_m) @ optics.neutral_radius
        angle = self.angle_to(pin_tips)
        self.coefficients = np.linalg.lstsq(_odd(angle), radii, rcond=None)[0]
        self.straight = angle.max()
        self.slope = float((_odd(self.straight) / self.straight) @ (self.coefficients * [1, 3, 5]))

    def angle_to(self, points: np.ndarray) -> np.ndarray:
        """Return the angles (...), rad, between the axis and the rays to points (..., 3), m, sensor frame."""
        rays = points - self.position
        return np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])

    def _polynomial(self, angle: np.ndarray) -> np.ndarray:
        k1, k3, k5 = self.coefficients
        square = angle * angle
        return angle * (k1 + square * (k3 + square * k5))

    def radius(self, angle: np.ndarray) -> np.ndarray:
        """Return the distance from the image centre, px of the frame, of rays at an angle to the axis, rad."""
        near = np.minimum(angle, self.straight)
        return (self._polynomial(near) + self.slope * (angle - near)) * self.scale

    def angle(self, radius: np.ndarray) -> np.ndarray:
        """Return the angle to the axis, rad, of rays at a distance from the image centre, px: the inverse of `radius`."""
        table = np.linspace(0, np.pi / 2, 2000)
        return np.interp(radius, self.radius(table), table)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (..., 2) of points (..., 3), m, sensor frame. The centre of the top left pixel is (0, 0)."""
        rays = points - self.position
        plan = np.hypot(rays[..., 0], rays[..., 1])
        scale = self.radius(np.arctan2(plan, rays[..., 2])) / np.maximum(plan, 1e-12)
        return self.centre - 0.5 + rays[..., :2] * scale[..., None]


def _odd(x: ArrayLike) -> np.ndarray:
    """Return the first, third and fifth powers (..., 3) of values (...)."""
    x = np.asarray(x)
    return np.stack([x, x**3, x**5], -1)


class LedRing:
    """Light of the LED ring on matt surfaces: Lambert's cosine law and the inverse-square law."""

    def __init__(self, design: Design) -> None:
        """Place a design's LEDs and scale the light to its exposure."""
        optics = design.optics
        azimuth = 2 * np.pi * np.arange(optics.leds) / optics.leds
        self.lamps = np.stack(
            [
                optics.led_ring_radius_m * np.cos(azimuth),
                optics.led_ring_radius_m * np.sin(azimuth),
                np.full(optics.leds, -design.shape.radius_m - optics.led_height_m),
            ],
            1,
        )
        apex = np.array([0.0, 0.0, -design.pins.length_m])
        self.scale = 255 * optics.exposure / (optics.pin_albedo * self._irradiance(apex, np.array([0.0, 0.0, -1.0])))

    def _irradiance(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        (x, y, z), (nx, ny, nz) = np.moveaxis(points, -1, 0)[..., None], np.moveaxis(normals, -1, 0)[..., None]
        right, down, away = self.lamps[:, 0] - x, self.lamps[:, 1] - y, self.lamps[:, 2] - z
        distance2 = right * right + down * down + away * away
        return (np.maximum(right * nx + down * ny + away * nz, 0) / (distance2 * np.sqrt(distance2))).sum(-1)

    def grey(self, points: np.ndarray, normals: np.ndarray, albedo: float) -> np.ndarray:
        """Return grey levels (...), 0 to 255, of surface points (..., 3) m with unit normals (..., 3) towards the camera."""
        return np.minimum(self.scale * albedo * self._irradiance(points, normals), 255.0)


def pin_radii(design: Design) -> np.ndarray:
    """Return the apparent radius (p,), m, of each pin's white tip; see design.Pins.diameter_m."""
    _, directions = neutral_pins(design)
    plan = np.linalg.norm(directions[:, :2], axis=1)
    fraction = (plan / plan.max()) ** 2
    return 0.5 * (design.pins.diameter_m + fraction * (design.pins.rim_diameter_m - design.pins.diameter_m))


def perpendicular_axes(directions: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, p, 3) that span the discs perpendicular to directions (p, 3)."""
    x, y, z = directions.T
    # Perpendicular to the direction and to x, or to y where the direction is near x. Written out for speed.
    steep, flat = np.abs(x) >= 0.9, np.zeros_like(x)
    u = np.stack([np.where(steep, -z, flat), np.where(steep, flat, z), np.where(steep, x, -y)])
    u /= np.sqrt((u * u).sum(0))
    a, b, c = u
    return np.stack([u.T, np.stack([y * c - z * b, z * a - x * c, x * b - y * a], 1)])


def dome_centre(design: Design) -> np.ndarray:
    """Return the centre (3,) of the dome, m, sensor frame."""
    return np.array([0.0, 0.0, -design.shape.radius_m])


def inner_skin(design: Design, polar: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (..., 3), m, and inward unit normals (..., 3) of the undeformed inner skin.

    Args:
        design: The design.
        polar: Polar angles (...), rad.
        azimuth: Azimuths (...), rad.
    """
    outward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth], -1)
    return dome_centre(design) + (design.shape.radius_m - design.materials.skin_thickness_m) * outward, -outward


def backdrop(design: Design, lens: Lens, leds: LedRing) -> np.ndarray:
    """Return the grey image (frame_px, frame_px) float of the undeformed inner skin without pins.

    Outside the skin the image is as grey as at the rim.
    """
    px = np.arange(lens.width) + 0.5
    offset = np.stack(np.meshgrid(px - lens.centre[0], px - lens.centre[1]), -1)
    angle = lens.angle(np.linalg.norm(offset, axis=-1))
    around = np.arctan2(offset[..., 1], offset[..., 0])
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    # Where each ray leaves the sphere of the inner skin; the camera may be in it or behind it.
    radius = design.shape.radius_m - design.materials.skin_thickness_m
    start = lens.position - dome_centre(design)
    along = -rays @ start
    exit_points = start + rays * (along + np.sqrt(np.maximum(along**2 - start @ start + radius**2, 0)))[..., None]
    polar = np.minimum(np.arctan2(np.hypot(exit_points[..., 0], exit_points[..., 1]), exit_points[..., 2]), np.pi / 2)
    azimuth = np.arctan2(exit_points[..., 1], exit_points[..., 0])
    return leds.grey(*inner_skin(design, polar, azimuth), design.optics.skin_albedo)
