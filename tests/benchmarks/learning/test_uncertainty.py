"""Benchmark of uncertainty: its page from results, its yardsticks, and images that nothing should trust."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.benchmarks.learning import uncertainty as bench
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import load_network
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip, shipped_fast_tip
from tactip_twin.tactip_model.presets import load_design


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Predicted contacts on edges, 40 of them."""
    tip = shipped_fast_tip("edge", "tactip-127")
    configuration = Configuration(
        task="edge",
        split="test",
        samples=40,
        seed=3,
        renderer="raster",
        design=load_design("tactip-127"),
        fidelity=fidelity_named("standard"),
        pose=replace(POSE_RANGES["edge"], depth_mm=(-5.0, -2.0)),
        shear=SHEAR_RANGES,
        fast_tip=read_fast_tip(tip).digest,
    )
    folder = tmp_path_factory.mktemp("sets") / "test"
    make([Job(configuration, folder, tip)], 1, lambda line: None)
    return read_samples(folder)


def test_errors_from_pins_fall_with_force_and_noise(samples):
    rows = bench.from_pins_by_force(samples, {"128": 0.06, "256": 0.02})
    assert [row["from_N"] for row in rows] == sorted(row["from_N"] for row in rows)
    firm, light = rows[-1], rows[0]
    assert light["bound_128"]["pose_Ry"] > firm["bound_128"]["pose_Ry"]
    for row in rows:
        assert all(row["bound_256"][n] < row["bound_128"][n] for n in row["bound_128"])
    # These pins are the learned tip's own, so nothing but the noise remains.
    assert firm["likelihood_128"]["pose_x"] == pytest.approx(firm["bound_128"]["pose_x"], rel=0.6)
    # A search from anywhere finds them nearly as well as one from the true pose.
    for kind in ("searched", "predicted"):
        assert firm[f"{kind}_256"]["pose_x"] < min(firm[f"{kind}_128"]["pose_x"], 2 * firm["likelihood_256"]["pose_x"])


def test_pin_noise_falls_with_the_size_of_the_image(samples):
    small, large = (bench.pin_noise(samples, size) for size in (128, 256))
    assert 0.02 < large["noise_mm"] < small["noise_mm"] < 0.1
    assert small["found_fraction"] < large["found_fraction"] <= 1.0


def test_odd_images_are_flagged(samples):
    model = load_network("edge-tactip-127")
    rows = {row["images"]: row for row in bench._odd_images(model, samples, bench.evaluate(model, samples))}
    assert rows["as learned"]["check"] <= 0.05
    for kind in ("331 pins", "half of the lens covered", "half of the pins missing"):
        assert rows[kind]["either"] == 1.0, kind
    assert len(bench._altered(samples, load_design("tactip-127"))["331 pins"]) == len(samples)


def test_page_has_a_row_for_each_band(samples):
    model = load_network("edge-tactip-127")
    results = {"tasks": {"edge": bench._task(model, samples, samples)}, "machine": {"processor": "x"}}
    tables = bench.tables(results)
    bands = results["tasks"]["edge"]["usual"]["by_force"]
    assert tables["edge-errors"].count("\n") == 1 + len(bands) + 1
    assert tables["edge-coverage"].count("\n") == 1 + len(bands)
    assert f"{100 * bands[0]['coverage_68']['pose_x']:.0f} %" in tables["edge-coverage"]
    assert np.isfinite([row["mae"]["pose_x"] for row in bands]).all()
    assert "effective_shear_x_mm, mm" in tables["quantities"]
