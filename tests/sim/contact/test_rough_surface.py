"""Rough surfaces: their shape, and data sets of contacts with them."""

import numpy as np
import pytest
import trimesh

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.rough_surface import sample_heights, sample_rough_surface, smooth_maximum
from tactip_twin.sim.dataset.format import read_dataset


@pytest.mark.parametrize("seed", range(6))
def test_rough_surface_is_closed_and_level_at_the_pressed_place(seed):
    solid = sample_rough_surface(np.random.default_rng(seed), -28.0, 80.0)
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert abs(float(solid.distance(np.zeros(3)))) < 0.1e-3
    # Over the same distance as the slope was measured, a crest of 2 mm radius turns by 11 degrees.
    assert solid.smooth_normal(np.zeros((1, 3)))[0, 2] > np.cos(np.radians(12))


def test_rough_surfaces_have_more_curvature_than_curved_ones():
    """The extreme second derivatives within the patch exceed 100 1/m, the limit of curved surfaces, on both sides."""
    step, line = 0.5e-3, np.linspace(-10e-3, 10e-3, 41)
    at = np.stack(np.meshgrid(line, line), -1)
    extremes = []
    for seed in range(40):
        height = sample_heights(np.random.default_rng(seed), 0.0, 0.0)
        bend = -(height(at + [step, 0]) - 2 * height(at) + height(at - [step, 0])) / step**2
        extremes.append((bend.min(), bend.max()))
    low, high = np.array(extremes).T
    assert (low < -100).mean() > 0.5 and (high > 100).mean() > 0.5
    # What is far from the tip's reach is the base, which is flat here.
    assert np.isfinite(extremes).all()


def test_smooth_maximum_is_the_maximum_except_where_both_are_near():
    a, b = np.zeros(5), np.array([-2.0, -0.5, 0.0, 0.5, 2.0])
    found = smooth_maximum(a, b, 1.0)
    assert np.allclose(found[[0, -1]], [0.0, 2.0])
    assert np.allclose(found[1:-1], [1 / 16, 1 / 4, 0.5 + 1 / 16])
    # Its slope is continuous, and so are its values.
    fine = smooth_maximum(0.0 * (t := np.linspace(-3, 3, 6001)), t, 1.0)
    assert np.abs(np.diff(fine, 2)).max() < 1e-6


@pytest.mark.slow
def test_set_with_rough_surfaces_names_them_and_others_do_not(tmp_path):
    command = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--samples", "2", "--workers", "1"]
    assert tactip.main([*command, "--rough-fraction", "1", "--out", str(tmp_path / "rough")]) == 0
    assert tactip.main([*command, "--out", str(tmp_path / "flat")]) == 0
    rough, flat = (read_dataset(tmp_path / name) for name in ("rough", "flat"))
    assert rough.meta["configuration"]["rough_fraction"] == 1 and "rough_fraction" not in flat.meta["configuration"]
    # About every third contact on such a surface fails the checks of a sample: the second does.
    assert np.allclose(rough.poses, flat.poses[:1])
    assert tactip.main(["dataset", "verify", str(tmp_path / "rough")]) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rough-fraction", "1.5"], "rough_fraction must be between 0 and 1, got 1.5"),
        (
            ["--rough-fraction", "0.5", "--task", "edge"],
            "rough_fraction applies to the task 'surface' only, got the task 'edge'",
        ),
        (["--rough-fraction", "0.5", "--fidelity", "fast"], "rough_fraction needs a simulated tip"),
        (["--rough-fraction", "0.5", "--object", "sphere"], "an object cannot be combined with rough_fraction"),
    ],
)
def test_unfit_options_give_one_sentence(tmp_path, capsys, options, words):
    assert tactip.main(["dataset", "make", *options, "--out", str(tmp_path / "set")]) == 1
    assert words in capsys.readouterr().err
