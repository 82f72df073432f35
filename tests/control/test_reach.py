"""What the tip can touch, and the local curvature, against closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.special import j0

from helpers.profiles import profiled_block
from tactip_twin.control.reach import fits, touchable
from tactip_twin.control.score import coverage, touched_places
from tactip_twin.control.surface_score import extreme_curvature
from tactip_twin.sim.contact.curved_surface import slab
from tactip_twin.sim.contact.patch_normals import mean_normals
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.robot.recording import PHASES

RADIUS_M, DEPTH_M = 20e-3, 2e-3


def solid(mesh):
    return SignedDistanceMesh(mesh.vertices, mesh.faces)


def grooved(width_mm, depth_mm):
    """Return a block with its top at z = 0 and a groove with almost upright walls along y."""
    inner, outer = width_mm / 2 - 1e-3, width_mm / 2
    return solid(profiled_block([(-60, 0), (-outer, 0), (-inner, -depth_mm), (inner, -depth_mm), (outer, 0), (60, 0)]))


def test_a_plane_is_touchable_everywhere_and_the_tip_fits():
    block = solid(trimesh.creation.box([0.12, 0.12, 0.04]))
    points = np.array([[x, y, 0.02] for x in (-0.03, 0, 0.03) for y in (-0.03, 0.03)])
    assert touchable(block, points, RADIUS_M, DEPTH_M).all()
    assert fits(block, points, RADIUS_M, DEPTH_M).all()
    assert extreme_curvature(block, points) == pytest.approx(0, abs=1e-9)


def test_the_bottom_of_a_groove_is_touchable_if_the_tip_reaches_it():
    """A ball that sinks by 2 mm into the borders of a groove 16 mm wide reaches 2 mm + R - sqrt(R² - 8²) deep: 3.7 mm."""
    for depth_mm, expected in ((3.0, True), (5.5, False)):
        groove = grooved(16, depth_mm)
        bottom = np.array([[0.0, 0.0, -depth_mm / 1e3]])
        assert touchable(groove, bottom, RADIUS_M, DEPTH_M).all() == expected
        assert not fits(groove, bottom, RADIUS_M, DEPTH_M).any()
    beside = np.array([[0.04, 0, 0]])
    assert touchable(grooved(16, 5.5), beside, RADIUS_M, DEPTH_M).all()


def test_a_deep_shaft_is_closed_to_the_housing():
    """The dome alone would fit into a groove 41 mm wide and 36 mm deep, but the housing is 44 mm wide."""
    groove = grooved(41, 36)
    bottom = np.array([[0.0, 0.0, -36e-3]])
    assert not touchable(groove, bottom, RADIUS_M, DEPTH_M).any()
    assert touchable(grooved(60, 36), bottom, RADIUS_M, DEPTH_M).all()


def test_curvature_of_a_ball_and_of_a_bore():
    ball = trimesh.creation.icosphere(5, 30e-3)
    top = np.array([[0.0, 0.0, 30e-3], [0.0, 30e-3, 0.0]])
    assert extreme_curvature(solid(ball), top) == pytest.approx(1 / 30e-3, rel=0.03)
    pipe = trimesh.creation.annulus(30e-3, 40e-3, 0.1, sections=256)
    assert extreme_curvature(solid(pipe), np.array([[30e-3, 0.0, 0.0]])) == pytest.approx(-1 / 30e-3, rel=0.05)


def test_coverage_counts_only_steps_at_which_the_apex_touches():
    """Across a hollow, the flanks touch: what lies below the apex is not covered."""
    down = np.diag([1.0, -1, -1, 1])
    poses = np.stack([down, down, down])
    poses[:, 0, 3] = [0.0, 0.02, 0.04]
    true = np.zeros((3, 6))
    true[:, 2] = [-2e-3, 5e-3, -2e-3]
    phase = np.array([PHASES.index(name) for name in ("follow", "follow", "centre")])
    places = touched_places({"phase": phase, "true": true, "T_base_tcp": poses})
    assert places == pytest.approx(np.array([[0, 0, 2e-3]]))
    assert coverage(places, np.array([[0, 0, 0], [0.02, 0, 0]]), 7e-3) == 0.5


def test_mean_normal_on_waves_is_that_of_the_wave_averaged_over_circles():
    """Averaged over a circle of radius r, the slope of a wave of wave number k is J0(k r) times that in the middle."""
    k, slope = 2 * np.pi / 6e-3, 0.05
    waves = SignedDistanceMesh(*slab(lambda at: slope / k * np.sin(k * at[..., 0]), 0.2e-3))
    expected = slope * (1 + 8 * j0(k * 0.75e-3) + 8 * j0(k * 1.5e-3)) / 17
    (normal,) = mean_normals(waves, np.zeros((1, 3)))
    assert -normal[0] / normal[2] == pytest.approx(expected, rel=0.03)
    assert mean_normals(waves, np.zeros((0, 3))).shape == (0, 3)
