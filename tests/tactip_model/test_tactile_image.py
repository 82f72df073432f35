"""Lens, light, the two renderers, and the tactile image."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.numbers import rms
from tactip_twin.tactip_model.design import TactileImage
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.optics import REFERENCE_PX, LedRing, Lens
from tactip_twin.tactip_model.pins import neutral_pins, plan_positions
from tactip_twin.tactip_model.presets import DESIGNS, FITTED, NOMINAL, design_named
from tactip_twin.tactip_model.pyrender_renderer import PinCamera
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import binary_frame, tactile_image

# Mean blob diameter (px of a 256 px image) by shell N = i² + ij + j² of the real 127-pin tip's neutral image.
REAL_BLOBS = {1: 4.39, 3: 4.32, 4: 4.34, 7: 4.32, 9: 4.37, 12: 4.46, 13: 4.59, 16: 4.61, 19: 4.90, 21: 4.99, 25: 5.04}
REAL_BLOBS |= {27: 5.18, 28: 5.35, 31: 5.45, 36: 5.50}


@pytest.fixture(scope="module")
def camera(design):
    return PinCamera(design)


@pytest.fixture(scope="module")
def raster(design):
    return Raster(design)


def blobs(frame, settings):
    """Return centres (n, 2) and diameters (n,), px of 256, of the white blobs of a thresholded frame."""
    block, constant = settings.threshold
    binary = cv2.adaptiveThreshold(frame, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, constant)
    _, _, stats, centres = cv2.connectedComponentsWithStats(binary)
    scale = 256 / frame.shape[0]
    return (centres[1:] + 0.5) * scale - 0.5, 2 * np.sqrt(stats[1:, cv2.CC_STAT_AREA] / np.pi) * scale


@pytest.mark.parametrize("renderer", ["camera", "raster"])
def test_neutral_image_of_127_pin_tip_matches_real_one(request, design, renderer):
    """The real map: r = 11.31 ρ + 0.0516 ρ³ + 0.00235 ρ⁵ about (126.2, 129.8), first ring rotated by 29 degrees."""
    tips, directions = neutral_pins(design)
    frame = request.getfixturevalue(renderer).render(tips, directions)
    centres, diameters = blobs(frame, design.image)
    assert len(centres) == 127
    lattice = np.array([(i, j) for i in range(-6, 7) for j in range(-6, 7) if abs(i + j) <= 6])
    flat = np.stack([lattice[:, 0] + lattice[:, 1] / 2, np.sqrt(3) / 2 * lattice[:, 1]], 1)
    shell = (lattice**2).sum(1) + lattice.prod(1)
    rho = np.sqrt(shell)
    radius = 11.31 * rho + 0.0516 * rho**3 + 0.00235 * rho**5
    azimuth = np.arctan2(flat[:, 1], flat[:, 0]) + np.radians(29)
    real = np.array([126.2, 129.8]) + radius[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    distance = np.linalg.norm(real[:, None] - centres[None], axis=2)
    assert len(set(distance.argmin(1))) == 127
    assert rms(distance.min(1)) < 1.0
    for n, size in REAL_BLOBS.items():
        mean = diameters[distance.argmin(1)[shell == n]].mean()
        assert mean == pytest.approx(size, rel=0.1), f"shell {n}"


def test_neutral_image_of_331_pin_tip_has_its_rings():
    tip = design_named("nominal-331")
    frame = Raster(tip).render(*neutral_pins(tip))
    centres, _ = blobs(frame, tip.image)
    radius = np.linalg.norm(centres - np.array(tip.optics.centre) * 256 + 0.5, axis=1)
    rings = np.array([7.946 * k + 0.0200 * k**3 - 3.18e-5 * k**5 for k in range(11)])
    nearest = np.abs(radius[:, None] - rings).argmin(1)
    assert np.bincount(nearest).tolist() == [1, *(6 * k for k in range(1, 11))]
    assert np.abs(radius - rings[nearest]).max() < 1.0


@pytest.mark.parametrize("name", DESIGNS)
def test_lens_is_monotonic_and_invertible(name):
    design = design_named(name)
    lens = Lens(design)
    angle = np.linspace(0, 1.4, 500)
    radius = lens.radius(angle)
    assert (np.diff(radius) > 0).all()
    assert np.abs(lens.angle(radius) - angle).max() < 1e-4
    # With the camera off the dome's axis, a lens cannot match the map exactly; the pins' offsets absorb the rest.
    lattice = replace(design, pins=replace(design.pins, as_built_m=()))
    tips, _ = neutral_pins(lattice)
    off_axis = np.linalg.norm(plan_positions(lattice.pins) - design.optics.camera_offset_m, axis=1) / design.pins.pitch_m
    radii = np.stack([off_axis, off_axis**3, off_axis**5], -1) @ design.optics.neutral_radius
    residual = lens.radius(lens.angle_to(tips)) * REFERENCE_PX / lens.width - radii
    assert np.sqrt((residual**2).mean()) < (0.5 if name in NOMINAL else 1.0)


@pytest.mark.parametrize("name", FITTED)
def test_fitted_pins_stay_near_lattice_and_are_visible(name):
    """About a tenth of a millimetre off the lattice, and all visible where the lens projects them."""
    tip = design_named(name)
    offsets = np.array(tip.pins.as_built_m)
    assert rms(offsets) > 0.02e-3 and np.abs(offsets).max() < 0.3 * tip.pins.pitch_m
    assert tip.optics.zoom == 1 and tip.optics.drift == (0, 0)
    centres, _ = blobs(Raster(tip).render(*neutral_pins(tip)), tip.image)
    distance = np.linalg.norm(neutral_px(tip)[:, None] - centres[None], axis=2)
    assert len(centres) == len(offsets) and len(set(distance.argmin(1))) == len(offsets)
    assert rms(distance.min(1)) < 0.5


def test_led_ring_follows_inverse_square_law(design):
    leds = LedRing(design)
    facing = np.array([0, 0, -1.0])
    far, farther = (leds._irradiance(np.array([0, 0, z]), facing) for z in (10.0, 20.0))
    assert far / farther == pytest.approx(4, rel=0.02)
    assert leds._irradiance(np.zeros(3), -facing) == 0


def deformed(on_edge):
    for pose, shear in (
        ([0, 0, -5, 0, 0, 0], [0] * 6),
        ([3, 0, -4, 12, -10, 40], [4, -4, 0, 3, 3, -5]),
        ([-4, 0, -2, -15, 15, -45], [-5, 5, 0, -5, 5, 5]),
    ):
        yield on_edge(pose, shear)


def test_renderers_agree_on_deformed_pins(camera, raster, on_edge, design):
    """Mean difference below 0.1 grey levels, 2.5 rms on the pins, and 0.1 % of the tactile image's pixels."""
    for contact in deformed(on_edge):
        a = camera.render(contact.pin_tips, contact.directions).astype(float)
        b = raster.render(contact.pin_tips, contact.directions).astype(float)
        assert np.abs(a - b).mean() < 0.1
        assert rms((a - b)[np.maximum(a, b) > 40]) < 2.5
        binary = [tactile_image(x.astype(np.uint8), design.image) for x in (a, b)]
        assert (binary[0] != binary[1]).mean() < 0.001


def covered_parts(centre, axes, pixels, points=16):
    """Return the part of each pixel that an ellipse covers, around the pixel at its centre, from points in each pixel."""
    steps = (np.arange(points * pixels) + 0.5) / points - pixels / 2
    grid = np.stack(np.meshgrid(steps, steps)).reshape(2, -1) + (np.rint(centre) - centre)[:, None]
    inside = (np.linalg.solve(axes, grid) ** 2).sum(0) <= 1
    return inside.reshape(pixels, points, pixels, points).mean((1, 3))


@pytest.mark.parametrize("renderer", ["camera", "raster"])
def test_pixels_at_the_edge_of_a_pin_are_as_bright_as_the_part_that_it_covers(request, design, on_edge, renderer):
    """Against 256 points per pixel, without blur; four points per pixel, as pyrender has by itself, err twice as much."""
    sharp = replace(design, optics=replace(design.optics, blur_px=0.0))
    render = (PinCamera if renderer == "camera" else Raster)(sharp).render
    contact = list(deformed(on_edge))[1]
    frame = render(contact.pin_tips, contact.directions).astype(float)
    centres, axes = Raster(sharp).ellipses(contact.pin_tips, contact.directions)
    grey = LedRing(sharp).grey(contact.pin_tips, contact.directions, sharp.optics.pin_albedo)
    alone = np.sort(np.linalg.norm(centres[:, None] - centres, axis=2), 1)[:, 1] > 9
    errors = []
    for centre, half_axes, level in zip(centres[alone], axes[alone], grey[alone], strict=True):
        column, row = np.rint(centre).astype(int)
        window = frame[row - 4 : row + 5, column - 4 : column + 5]
        background = window.min()
        exact = background + covered_parts(centre, half_axes, 9) * (level - background)
        errors.append((window - exact) / (level - background))
    assert len(errors) > 30
    assert rms(np.array(errors)) < 0.025
    assert abs(np.mean(np.sum(errors, (1, 2)))) < 0.65  # of 26 pixels


def test_renderers_show_every_pin(camera, raster, on_edge, design):
    for contact in deformed(on_edge):
        for renderer in (camera, raster):
            centres, _ = blobs(renderer.render(contact.pin_tips, contact.directions), design.image)
            assert len(centres) == 127


def test_raster_of_batch_equals_single_images(raster, on_edge):
    contacts = list(deformed(on_edge))
    tips = np.stack([c.pin_tips for c in contacts])
    directions = np.stack([c.directions for c in contacts])
    batch = raster.render(tips, directions)
    assert batch.shape == (3, 360, 360)
    assert (batch[1] == raster.render(tips[1], directions[1])).all()


@pytest.mark.parametrize("blur_px", [0.0, 0.5, 1.1, 2.0])
@pytest.mark.parametrize("shift_mm", [0.0, 9.0, 40.0])
def test_raster_blurs_the_whole_frame_though_it_paints_a_part(design, blur_px, shift_mm):
    """Also at the frame's border, and where no pin is in the frame."""
    sharp, blurred = (Raster(replace(design, optics=replace(design.optics, blur_px=b))) for b in (0.0, blur_px))
    tips, directions = neutral_pins(design)
    tips = tips + [1e-3 * shift_mm, 0, 0]
    expected = sharp.render(tips, directions).astype(np.float32)
    if blur_px:
        expected = cv2.GaussianBlur(expected, (0, 0), blur_px)
    # The blur receives whole grey levels here, and fractions in the renderer.
    assert np.abs(blurred.render(tips, directions) - expected).max() <= 1 + 1e-3


def test_raster_paints_overlapping_pins_in_any_order(design):
    """Pins of one size, every other one moved half onto its neighbour."""
    uniform = replace(design, pins=replace(design.pins, rim_diameter_m=design.pins.diameter_m))
    tips, directions = neutral_pins(uniform)
    tips[1::2] = tips[:-1:2] + [0.4e-3, 0, 0]
    order, raster = np.random.default_rng(0).permutation(len(tips)), Raster(uniform)
    assert (raster.render(tips, directions) == raster.render(tips[order], directions[order])).all()


def test_pyrender_renders_two_designs_in_one_process(camera, design):
    other = design_named("tactip-331")
    before = camera.render(*neutral_pins(design))
    PinCamera(other).render(*neutral_pins(other))
    assert (camera.render(*neutral_pins(design)) == before).all()


def resident_mib():
    """Return the resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.slow
def test_pyrender_does_not_leak_memory(camera, design):
    """300 images add less than 10 MiB, 35 KiB per image; a single RGB frame has 390 KB."""
    pins = neutral_pins(design)
    for _ in range(30):
        camera.render(*pins)
    before = resident_mib()
    for _ in range(300):
        camera.render(*pins)
    assert resident_mib() - before < 10


def test_tactile_image_is_binary_and_128_px_wide(raster, design):
    image = tactile_image(raster.render(*neutral_pins(design)), design.image)
    assert image.shape == (128, 128)
    assert image.dtype == np.uint8
    assert set(np.unique(image)) == {0, 255}


def test_tactile_image_of_cropped_real_size_frame_is_the_same(raster, design):
    """A 640×480 colour frame with the pins off its centre, cropped as on real rigs."""
    grey = raster.render(*neutral_pins(design))
    frame = np.full((480, 640), grey[0, 0], np.uint8)
    frame[60:420, 140:500] = grey
    cropped = replace(design.image, crop=(140, 60, 500, 420))
    colour = tactile_image(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR), cropped)
    assert (colour != tactile_image(grey, design.image)).mean() < 0.002


def test_tactile_image_without_threshold_keeps_binary_frame(design):
    rng = np.random.default_rng(0)
    small = np.where(rng.random((128, 128)) < 0.1, 255, 0).astype(np.uint8)
    doubled = np.kron(small, np.ones((2, 2), np.uint8))
    assert (tactile_image(doubled, replace(design.image, threshold=None)) == small).all()


@pytest.mark.parametrize("block", [3, 15, 61])
@pytest.mark.parametrize("constant", [-5.0, -3.2, -0.5, 0.0, 0.5, 3.7, 5.0])
def test_threshold_is_that_of_opencv(block, constant):
    frame = np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8)
    expected = cv2.adaptiveThreshold(frame, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, block, constant)
    assert (binary_frame(frame, (block, constant)) == expected).all()


@pytest.mark.parametrize(
    "height,width,size", [(360, 360, 128), (361, 443, 128), (360, 360, 256), (480, 640, 200), (1000, 720, 37)]
)
def test_binary_frame_shrinks_as_opencv_shrinks_it(height, width, size):
    rng = np.random.default_rng(0)
    frame = np.where(cv2.GaussianBlur(rng.random((height, width)), (0, 0), 2) > 0.5, 255, 0).astype(np.uint8)
    settings = TactileImage(threshold=(61, -5.0), size_px=size)
    white = binary_frame(frame, settings.threshold)
    expected = cv2.resize(white, (size, size), interpolation=cv2.INTER_AREA)
    shown = tactile_image(frame, settings)
    # OpenCV rounds its sums, so it does not always tell which side of half a pixel is on.
    clear = abs(expected - 127.5) > 1
    assert set(np.unique(shown)) == {0, 255} and shown.flags.c_contiguous
    assert (shown == np.where(expected > 127, 255, 0))[clear].all() and clear.mean() > 0.97


def test_tactile_image_does_not_depend_on_brightness(raster, design):
    grey = raster.render(*neutral_pins(design))
    brighter = np.clip(grey.astype(int) + 60, 0, 255).astype(np.uint8)
    assert (tactile_image(grey, design.image) != tactile_image(brighter, design.image)).mean() < 0.001


@pytest.mark.parametrize(
    ("frame", "settings", "words"),
    [
        (np.zeros((10, 10)), TactileImage(), "uint8"),
        (np.zeros((10, 10, 4), np.uint8), TactileImage(), "uint8"),
        (np.zeros((100, 100), np.uint8), TactileImage(crop=(0, 0, 101, 50)), "crop"),
        (np.zeros((100, 100), np.uint8), TactileImage(threshold=(60, 5.0)), "odd"),
    ],
)
def test_tactile_image_of_invalid_frame_raises_error(frame, settings, words):
    with pytest.raises(TactipError, match=words):
        tactile_image(frame, settings)
