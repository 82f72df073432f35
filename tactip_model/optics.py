"""The lens and the light: where a point inside the sensor appears in the frame, and how bright.

Both renderers (camera.py, raster.py) stand on these functions, so that they can only differ in how they draw.
The camera looks along +z of the sensor frame, x to the right and y down in the image.
"""

from dataclasses import replace

import numpy as np

from tactip_twin.tactip_model.pins import neutral_pins, plan_positions

REFERENCE_PX = 256
"""Image width, px, in which `Optics.neutral_radius` is given."""


class Lens:
    """A rotationally symmetric wide-angle lens: image radius k1 a + k3 a³ + k5 a⁵ of a ray at angle a to the axis.

    The coefficients are those that put the design's undeformed pins where its neutral image has them (least squares). Beyond
    the outermost undeformed pin the radius goes on in a straight line: a polynomial is not to be trusted there.
    """

    def __init__(self, design):
        """design: Design."""
        optics = design.optics
        lattice = replace(design, pins=replace(design.pins, as_built_m=()))
        self.width = optics.frame_px
        self.centre = (np.array(optics.centre) + optics.drift) * self.width
        self.position = np.array([*optics.camera_offset_m, -design.shape.radius_m - optics.camera_height_m])
        self._scale = optics.zoom * self.width / REFERENCE_PX
        tips, _ = neutral_pins(lattice)
        off_axis = np.linalg.norm(plan_positions(lattice.pins) - optics.camera_offset_m, axis=1)
        wanted = _odd(off_axis / design.pins.pitch_m) @ optics.neutral_radius
        angle = self.angle_to(tips)
        self.coefficients = np.linalg.lstsq(_odd(angle), wanted, rcond=None)[0]
        self._straight = angle.max()
        self._slope = float((_odd(self._straight) / self._straight) @ (self.coefficients * [1, 3, 5]))

    def angle_to(self, points):
        """Angles (...) rad to the axis of the rays to points (..., 3), m, sensor frame."""
        rays = points - self.position
        return np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])

    def _polynomial(self, angle):
        k1, k3, k5 = self.coefficients
        square = angle * angle
        return angle * (k1 + square * (k3 + square * k5))

    def radius(self, angle):
        """Distance from the image centre, px of the frame, of rays at `angle` (rad, array)."""
        near = np.minimum(angle, self._straight)
        return (self._polynomial(near) + self._slope * (angle - near)) * self._scale

    def angle(self, radius):
        """Angle (rad) of the rays seen at `radius` px of the frame from the image centre: the inverse of `radius`."""
        table = np.linspace(0, np.pi / 2, 2000)
        return np.interp(radius, self.radius(table), table)

    def project(self, points):
        """Pixels (..., 2) of points (..., 3), m, sensor frame. The centre of the top left pixel is (0, 0)."""
        rays = points - self.position
        plan = np.hypot(rays[..., 0], rays[..., 1])
        scale = self.radius(self.angle_to(points)) / np.maximum(plan, 1e-12)
        return self.centre - 0.5 + rays[..., :2] * scale[..., None]


def _odd(x):
    x = np.asarray(x)
    return np.stack([x, x**3, x**5], -1)


class LedRing:
    """Brightness of matt surfaces under the ring of LEDs: Lambert's cosine law, inverse squares."""

    def __init__(self, design):
        """design: Design."""
        optics = design.optics
        azimuth = 2 * np.pi * np.arange(optics.leds) / optics.leds
        self._lamps = np.stack(
            [
                optics.led_ring_radius_m * np.cos(azimuth),
                optics.led_ring_radius_m * np.sin(azimuth),
                np.full(optics.leds, -design.shape.radius_m - optics.led_height_m),
            ],
            1,
        )
        apex = np.array([0.0, 0.0, -design.pins.length_m])
        self._scale = 255 * optics.exposure / (optics.pin_albedo * self._irradiance(apex, np.array([0.0, 0.0, -1.0])))

    def _irradiance(self, points, normals):
        (x, y, z), (nx, ny, nz) = np.moveaxis(points, -1, 0)[..., None], np.moveaxis(normals, -1, 0)[..., None]
        right, down, away = self._lamps[:, 0] - x, self._lamps[:, 1] - y, self._lamps[:, 2] - z
        distance2 = right * right + down * down + away * away
        return (np.maximum(right * nx + down * ny + away * nz, 0) / (distance2 * np.sqrt(distance2))).sum(-1)

    def grey(self, points, normals, albedo):
        """Grey levels (...), 0 to 255, of surface points (..., 3) m with unit normals (..., 3) towards the camera."""
        return np.minimum(self._scale * albedo * self._irradiance(points, normals), 255.0)


def tip_radii(design):
    """Radius (p,) of each pin's white tip as it appears, m: see design.Pins.diameter_m."""
    _, directions = neutral_pins(design)
    plan = np.linalg.norm(directions[:, :2], axis=1)
    share = (plan / plan.max()) ** 2
    return 0.5 * (design.pins.diameter_m + share * (design.pins.rim_diameter_m - design.pins.diameter_m))


def perpendicular_axes(directions):
    """Two unit vectors (2, p, 3) that span the discs square to directions (p, 3)."""
    x, y, z = directions.T
    # Square to the direction and to an axis that is not near it: y, where it is near x. Written out: it is asked a lot.
    steep, flat = np.abs(x) >= 0.9, np.zeros_like(x)
    u = np.stack([np.where(steep, -z, flat), np.where(steep, flat, z), np.where(steep, x, -y)])
    u /= np.sqrt((u * u).sum(0))
    a, b, c = u
    return np.stack([u.T, np.stack([y * c - z * b, z * a - x * c, x * b - y * a], 1)])


def dome_centre(design):
    """Centre (3,) of the dome, m."""
    return np.array([0.0, 0.0, -design.shape.radius_m])


def inner_skin(design, polar, azimuth):
    """Points and inward unit normals (..., 3) of the undeformed inner skin at polar angle and azimuth (arrays, rad)."""
    outward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth], -1)
    return dome_centre(design) + (design.shape.radius_m - design.materials.skin_thickness_m) * outward, -outward


def backdrop(design, lens, leds):
    """Grey image (frame_px, frame_px) float of the undeformed inner skin without pins; as at the rim outside of it."""
    px = np.arange(lens.width) + 0.5
    offset = np.stack(np.meshgrid(px - lens.centre[0], px - lens.centre[1]), -1)
    angle = lens.angle(np.linalg.norm(offset, axis=-1))
    around = np.arctan2(offset[..., 1], offset[..., 0])
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    # Where each ray leaves the sphere of the inner skin, that the camera may be in or behind.
    radius = design.shape.radius_m - design.materials.skin_thickness_m
    start = lens.position - dome_centre(design)
    along = -rays @ start
    met = start + rays * (along + np.sqrt(np.maximum(along**2 - start @ start + radius**2, 0)))[..., None]
    polar = np.minimum(np.arctan2(np.hypot(met[..., 0], met[..., 1]), met[..., 2]), np.pi / 2)
    azimuth = np.arctan2(met[..., 1], met[..., 0])
    return leds.grey(*inner_skin(design, polar, azimuth), design.optics.skin_albedo)
