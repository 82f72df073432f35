"""What pages, videos and figures share: colors, curves, the camera's place, and the arrows on the tactile image."""

import io
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import trimesh

from helpers.recordings import STEPS, arrays_of
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim.view.camera_fit import beside, fitted_camera
from tactip_twin.sim.view.curves import curves_of, position_errors_mm
from tactip_twin.sim.view.geometry import ColoredMesh
from tactip_twin.sim.view.glb import glb
from tactip_twin.sim.view.offscreen import look_at
from tactip_twin.sim.view.palette import ERROR_RAMP, ramp_colors, scale_end
from tactip_twin.sim.view.tactile_picture import pin_projection, tactile_picture
from tactip_twin.tactip_model.pin_detection import find_blobs
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import load_design
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image


def _on_screen(points, eye, target, field, aspect):
    """Return the places (n, 2) of points on the screen, -1 to 1."""
    x, y, z = (np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(look_at(eye, target)).T)[:, :3].T
    assert np.all(z < 0)
    return np.stack([x / aspect, y], 1) / (-z * np.tan(field / 2))[:, None]


@pytest.mark.parametrize(("aspect", "left"), [(1.8, 0.0), (0.6, 0.0), (1.4, 0.3)])
def test_fitted_camera_sees_every_point_and_no_nearer_one_does(aspect, left):
    points, field = np.random.default_rng(1).normal(size=(200, 3)) * [0.3, 0.1, 0.2] + [0.4, 0, 0.2], 0.7
    margin = 0.05
    eye, target = fitted_camera(points, (0.5, -0.7, 0.4), field, aspect, left, margin)
    places = _on_screen(points, eye, target, field, aspect)
    low, high = np.array([-1 + 2 * margin + 2 * left, -1 + 2 * margin]), 1 - 2 * margin
    assert np.all(places > low - 1e-9) and np.all(places < high + 1e-9)
    touched = [places.min(0) < low + 1e-9, places.max(0) > high - 1e-9]
    assert np.all(touched, axis=0).any()  # both borders of one direction


def test_target_beside_a_cover_is_in_the_middle_of_the_rest():
    eye, target = beside(np.array([0.3, -0.4, 0.2]), np.zeros(3), 0.7, 1.5, 0.3)
    assert np.allclose(_on_screen(np.zeros((1, 3)), eye, target, 0.7, 1.5), [[0.3, 0]])


def test_ramp_ends_at_its_colors():
    colors = ramp_colors([0, 0.5, 1, 7, np.nan], 1.0, ERROR_RAMP)
    assert np.allclose(colors, [*ERROR_RAMP, ERROR_RAMP[-1], ERROR_RAMP[0]])


@pytest.mark.parametrize(
    ("values", "end"), [([0.3], 0.3), ([0.31], 0.5), ([-7], 10), ([np.nan, 12], 20), ([], 1), ([0.0], 1)]
)
def test_scale_ends_at_a_round_number(values, end):
    assert scale_end(values) == end


def test_glb_is_read_by_another_library():
    ball = trimesh.creation.icosphere(1, 0.02)
    colors = 255.0 * np.random.default_rng(0).random(ball.vertices.shape)
    data = glb(ColoredMesh(ball.vertices, ball.faces, ball.vertex_normals, (0.0, 0, 0), colors), 0.5)
    read = trimesh.load(io.BytesIO(data), file_type="glb", process=False).to_geometry()
    assert np.allclose(read.vertices, ball.vertices) and np.array_equal(read.faces, ball.faces)
    assert np.allclose(read.vertex_normals, ball.vertex_normals, atol=1e-6)
    assert read.visual.material.alphaMode == "BLEND" and np.allclose(read.visual.material.baseColorFactor[3], 127, atol=1)


def test_curves_leave_out_estimates_without_contact():
    arrays = arrays_of("edge")
    arrays["predicted"][:2] = from_mm_deg([9, 0, 9, 90, 90, 90])  # while searching
    force, error, *components = curves_of(arrays, "edge")
    assert np.allclose(force.true, np.sqrt(3))
    assert np.isnan(error.true[:2]).all() and np.allclose(error.true[2:], 0.1)
    assert [c.name for c in components] == ["x", "depth", "Rx", "Ry", "Rz"]
    for curve in components:
        assert np.isnan(curve.estimated[:2]).all() and np.isfinite(curve.estimated[2:]).all()
        assert -6 < curve.span[0] < curve.span[1] < 6
    assert np.allclose(components[1].deviations[2:], 0.2)


def test_position_error_is_of_the_estimated_translations():
    arrays = arrays_of("surface")
    arrays["true"][:, 0] = -5e-3  # which no estimate on a surface tells
    assert np.allclose(position_errors_mm(arrays, "surface")[2:], 0.1)
    assert np.allclose(position_errors_mm(arrays, "edge")[2:], np.hypot(5, 0.1))
    assert [c.name for c in curves_of(arrays, "surface")][2:] == ["depth", "Rx", "Ry"]
    arrays["predicted"][5:, 1] = 1e-3  # as where a moving object is tracked
    assert np.allclose(position_errors_mm(arrays, "surface")[2:5], 0.1)
    assert np.allclose(position_errors_mm(arrays, "surface")[5:], np.hypot(1, 0.1))
    assert [c.name for c in curves_of(arrays, "surface")][2:] == ["y", "depth", "Rx", "Ry"]


@pytest.mark.parametrize("width", [128, 256])
def test_projected_pins_are_where_the_image_shows_them(width):
    """The images of a recording have the width that its network takes."""
    design = load_design("tactip-127")
    tips, directions = neutral_pins(design)
    image = tactile_image(renderer_named("raster", design)(tips, directions), replace(design.image, size_px=width))
    project = pin_projection({"design": json.loads(json.dumps(asdict(design))), "size_px": width})
    shown, places = find_blobs(image).centres, project(tips)
    nearest = np.linalg.norm(shown[:, None] - places[None], axis=2).min(1)
    assert len(shown) > 80 and np.median(nearest) < 0.5 and nearest.max() < 1.5


def test_picture_shows_the_image_and_an_arrow_for_each_moved_pin():
    image = np.zeros((64, 64), np.uint8)
    image[10, 12] = 255
    plain = tactile_picture(image)
    assert plain.shape == (384, 384, 3) and np.all(plain[60:66, 72:78] == 255) and (plain > 0).all(2).sum() == 36
    arrows = np.array([[[20.0, 40], [24, 40]], [[50, 50], [50, 50]], [[np.nan, 1], [1, 1]]])
    marked = tactile_picture(image, arrows)
    colored = np.argwhere(marked[..., 0] - marked[..., 2].astype(int) > 60)
    # Only the first pin has moved: to the right, drawn three times as long.
    assert np.all(abs(colored[:, 0] - (40.5 * 6 - 0.5)) < 12)
    assert colored[:, 1].min() > 20 * 6 - 4 and abs(colored[:, 1].max() - (32.5 * 6)) < 8


def test_curve_spans_have_a_width():
    for curve in curves_of(arrays_of("surface"), "surface"):
        assert len(curve.true) == STEPS and curve.span[1] > curve.span[0]
