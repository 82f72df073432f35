"""Curved surfaces: their shape, and data sets of contacts with them."""

import json

import numpy as np
import pytest
import trimesh
from scipy.integrate import cumulative_trapezoid

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact import curved_surface as curved_surface_module
from tactip_twin.sim.contact.curved_surface import MAX_CURVATURE_PER_M, Profile, curved_surface
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.solid_stimulus import SolidStimulus
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.dataset.sampling import Ranges
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.design_file import from_dict
from tactip_twin.tactip_model.presets import load_design


@pytest.mark.parametrize("curvature", [(0.0, 0.0, 0.0), (50.0, -20.0, 0.4), (MAX_CURVATURE_PER_M, MAX_CURVATURE_PER_M, 1.0)])
def test_curved_surface_top_is_paraboloid_and_solid_is_closed(curvature):
    first, second, turn = curvature
    solid = curved_surface(*curvature)
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    u, v = np.random.default_rng(0).uniform(-0.008, 0.008, (2, 200))
    c, s = np.cos(turn), np.sin(turn)
    top = np.stack([c * u - s * v, s * u + c * v, -(first * u**2 + second * v**2) / 2], -1)
    assert np.abs(solid.distance(top)).max() < 40e-6
    slope = np.stack([first * u, second * v], -1)
    normal = np.stack([c * slope[:, 0] - s * slope[:, 1], s * slope[:, 0] + c * slope[:, 1], np.ones(200)], -1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    assert np.abs(solid.distance(top + 2e-3 * normal) - 2e-3).max() < 40e-6
    assert np.degrees(np.arccos(np.clip((solid.smooth_normal(top) * normal).sum(1), -1, 1))).max() < 0.8


def test_force_falls_with_curvature_as_in_hertz():
    """The force is proportional to (1/R + k)^(-1/2). A hollow confines the gel, and its force is a fifth higher."""
    stimulus = SolidStimulus(curved_surface(0, 0, 0), min_radius_m=0.01)
    simulator = ContactSimulator(load_design("tactip-127"), stimulus, fidelity_named("draft"))
    forces = []
    for curvature in (-20.0, 0.0, 30.0, 60.0):
        stimulus.solid = curved_surface(curvature, curvature, 0.0)
        contact = simulator.simulate(from_mm_deg([0, 0, -2.0, 0, 0, 0]), np.zeros(6))
        assert not contact.violations(QualityLimits(penetration_m=0.1e-3))
        forces.append(contact.normal_force_n)
    hertz = [(1 / 0.02 + k) ** -0.5 for k in (-20.0, 0.0, 30.0, 60.0)]
    assert np.allclose(np.array(forces) / forces[1], np.array(hertz) / hertz[1], rtol=[0.25, 0, 0.1, 0.1])
    stimulus.solid = curved_surface(0.0, 0.0, 0.0)
    flat = ContactSimulator(load_design("tactip-127"), "surface", fidelity_named("draft"))
    pose = from_mm_deg([0, 0, -3.0, 5, 0, 0]), from_mm_deg([2.0, 0, 0, 0, 0, 0])
    assert np.allclose(simulator.simulate(*pose).pin_tips, flat.simulate(*pose).pin_tips, atol=2e-6)


@pytest.mark.slow
def test_curved_set_does_not_depend_on_worker_count(tmp_path):
    command = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--curvature-per-m", "-20", "60"]
    for name, workers in (("a", "1"), ("b", "2")):
        assert tactip.main([*command, "--samples", "3", "--workers", workers, "--out", str(tmp_path / name)]) == 0
    one, other = (read_dataset(tmp_path / name) for name in "ab")
    assert one.meta["files"] == other.meta["files"]
    assert one.meta["configuration"]["curvature_per_m"] == [-20, 60]
    assert tactip.main(["dataset", "verify", str(tmp_path / "a")]) == 0
    assert tactip.main([*command[:-3], "--samples", "3", "--out", str(tmp_path / "flat")]) == 0
    flat = read_dataset(tmp_path / "flat")
    assert np.allclose(flat.poses, one.poses)
    assert flat.meta["configuration"]["curvature_per_m"] == [0, 0]
    with np.load(tmp_path / "flat" / "pins.npz") as a, np.load(tmp_path / "a" / "pins.npz") as b:
        assert np.abs(a["pin_tips"] - b["pin_tips"]).max() > 0.1e-3


def test_flat_configuration_round_trips_as_json():
    zero = Ranges()
    tip, fidelity = load_design("tactip-127"), fidelity_named("draft")
    made = Configuration(
        task="surface", split="train", samples=1, renderer="raster", design=tip, fidelity=fidelity, pose=zero, shear=zero
    )
    assert from_dict(Configuration, json.loads(json.dumps(made.as_json())), "configuration") == made


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--curvature-per-m", "0", "500"], "between -30 and 100 1/m, got (0.0, 500.0)"),
        (["--curvature-per-m", "10", "-10"], "curvature_per_m must be a low and a high"),
        (["--task", "edge", "--curvature-per-m", "0", "10"], "applies to the task 'surface' only, got the task 'edge'"),
    ],
)
def test_invalid_curvatures_give_one_sentence(tmp_path, capsys, options, words):
    assert tactip.main(["dataset", "make", *options, "--out", str(tmp_path / "set")]) == 1
    assert words in capsys.readouterr().err


PROFILES = (Profile((-6e-3, 1e-3, 5e-3), (80.0, -20.0, 60.0, 10.0)), Profile((2e-3,), (-28.0, 30.0)))


def test_varying_curvature_is_that_of_profiles():
    """The curvature, integrated twice from the origin, gives the height."""
    fine = np.linspace(0, 8e-3, 8001)
    for profile in PROFILES:
        for sign in (-1, 1):
            curvature = np.array(profile.per_m)[np.searchsorted(profile.changes_m, sign * fine)]
            slope = cumulative_trapezoid(-curvature, x=fine, initial=0)
            assert np.allclose(
                profile.top(sign * fine), cumulative_trapezoid(slope, x=fine, initial=0), atol=2e-7
            )  # one grid cell at each change
    first, second, turn = 10.0, -10.0, 0.7
    solid = curved_surface(first, second, turn, PROFILES)
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles)
    assert mesh.is_watertight and mesh.volume > 0
    u, v = np.random.default_rng(0).uniform(-0.008, 0.008, (2, 200))
    cos, sin = np.cos(turn), np.sin(turn)
    height = -(first * u**2 + second * v**2) / 2 + PROFILES[0].top(u) + PROFILES[1].top(v)
    assert np.abs(solid.distance(np.stack([cos * u - sin * v, sin * u + cos * v, height], -1))).max() < 40e-6
    # It is level at the origin, where the label's frame is.
    assert np.allclose(solid.smooth_normal(np.zeros((1, 3))), [0, 0, 1], atol=0.02)


def test_sampled_curvatures_stay_in_range():
    """They are often at a limit of the range, and change after stretches of the documented length."""
    low, high = -28.0, 80.0
    sampled = []
    for seed in range(200):
        sampled.append(curved_surface_module.sample_curvatures(np.random.default_rng(seed), low, high, 1.0))
    lengths, values = [], []
    for curvatures in sampled:
        assert curvatures.first_per_m == curvatures.second_per_m == 0
        for profile in curvatures.profiles:
            assert len(profile.per_m) == len(profile.changes_m) + 1
            assert profile.changes_m[0] < 0.05 and np.abs(
                profile.changes_m
            ).max() < curved_surface_module.HALF_WIDTH_M * np.sqrt(2)
            lengths += np.diff(profile.changes_m).tolist()
            values += profile.per_m
    assert curved_surface_module.STRETCHES_M[0] <= min(lengths) and max(lengths) <= curved_surface_module.STRETCHES_M[1]
    values = np.array(values)
    assert (values.min(), values.max()) == (low, high)
    # Half of the values from twice the range lie outside it, a quarter on each side.
    assert np.mean(values == low) == pytest.approx(0.25, abs=0.03)
    assert np.mean(values == high) == pytest.approx(0.25, abs=0.03)


def test_fraction_of_varying_curvature_is_as_configured():
    sampled = []
    for seed in range(400):
        sampled.append(curved_surface_module.sample_curvatures(np.random.default_rng(seed), -28.0, 80.0, 0.3))
    even = np.array([(c.first_per_m, c.second_per_m) for c in sampled if not c.profiles])
    assert len(even) == pytest.approx(280, abs=30)
    assert even.mean() == pytest.approx(26.0, abs=4.0) and even.min() < -20 and even.max() > 70


def test_varying_curvature_changes_digest():
    given = {"task": "surface", "split": "test", "samples": 1, "seed": 0, "renderer": "raster"}
    given |= {"design": load_design("nominal-127"), "fidelity": fidelity_named("draft"), "pose": Ranges(), "shear": Ranges()}
    even = Configuration(**given, curvature_per_m=(-10.0, 30.0))
    assert Configuration(**given, curvature_per_m=(-10.0, 30.0), varying_curvature_fraction=0.5).digest() != even.digest()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--varying-curvature-fraction", "0.5"],
            "varying_curvature_fraction needs a range of curvature: give --curvature-per-m too",
        ),
        (
            ["--varying-curvature-fraction", "2", "--curvature-per-m", "0", "10"],
            "varying_curvature_fraction must be between 0 and 1, got 2.0",
        ),
    ],
)
def test_invalid_varying_curvature_gives_one_sentence(tmp_path, capsys, options, words):
    assert tactip.main(["dataset", "make", *options, "--out", str(tmp_path / "set"), "--samples", "1"]) == 1
    assert words in capsys.readouterr().err
