"""Checks before a simulation: values, poses and ranges out of reach are refused, and the message says what is allowed."""

from dataclasses import replace

import numpy as np
import pytest

from tactip_twin.sim.contact.fidelity import MIN_STEP_S, Fidelity, Motion, Solver, finer
from tactip_twin.sim.contact.limits import check_ranges
from tactip_twin.sim.contact.retries import TRIES
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import TASKS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.design import Design, Materials, Optics, Pins, TactileImage, TipGeometry
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import Resolution
from tactip_twin.tactip_model.soft_body import ContactModel


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Materials(gel_poisson=0.5), ["gel_poisson must be", "got 0.5", "from 0 to 0.499"]),
        (lambda: Materials(skin_poisson=-0.1), ["skin_poisson must be", "got -0.1", "from 0 to 0.499"]),
        (lambda: Materials(gel_young_pa=float("nan")), ["gel_young_pa must be", "got nan", "finite", "1000"]),
        (lambda: Materials(skin_young_pa=float("inf")), ["skin_young_pa must be", "got inf", "1e+08"]),
        (lambda: Materials(friction=2.5), ["friction must be", "got 2.5", "from 0 to 2"]),
        (lambda: Materials(density_kg_m3="heavy"), ["density_kg_m3 must be", "got heavy", "number"]),
        (lambda: TipGeometry(radius_m=-20e-3), ["radius_m must be", "got -0.02"]),
        (lambda: TipGeometry(cylinder_m=0.1), ["cylinder_m must be", "got 0.1", "0.02"]),
        (
            lambda: Materials(skin_young_pa=1e8, gel_young_pa=1e4),
            ["skin_young_pa must be at most 500 times gel_young_pa, 5e+06", "buckles", "got 100000000.0"],
        ),
        (lambda: Pins(rings=2.5), ["rings must be", "got 2.5", "whole number"]),
        (
            lambda: Optics(neutral_radius=(11.0, float("nan"), 0.0)),
            ["neutral_radius must be a finite number", "got (11.0, nan, 0.0)"],
        ),
        (lambda: TactileImage(size_px=0), ["size_px must be", "got 0"]),
        (lambda: Optics(centre=(0.5,)), ["centre must be", "got (0.5,)", "2 numbers, each a finite number from 0 to 1"]),
        (lambda: Optics(centre=0.5), ["centre must be", "got 0.5", "2 numbers"]),
        (lambda: Optics(camera_offset_m=(0.001,)), ["camera_offset_m must be", "got (0.001,)", "2 numbers"]),
        (lambda: Optics(drift=None), ["drift must be", "got None", "2 numbers"]),
        (lambda: Materials(friction=(0.5,)), ["friction must be", "got (0.5,)", "a finite number from 0 to 2"]),
        (lambda: Pins(rings=None), ["rings must be", "got None", "a whole number from 1 to 20"]),
        (lambda: Pins(rings=[6]), ["rings must be", "got [6]", "a whole number from 1 to 20"]),
        (
            lambda: TactileImage(threshold=(61,)),
            [
                "threshold must be 2 numbers, a whole number from 3 to 65535 and a finite number from -255 to 255",
                "got (61,)",
            ],
        ),
        (
            lambda: TactileImage(threshold=(61.5, -5.0)),
            ["threshold must be a whole number from 3 to 65535", "got (61.5, -5.0)"],
        ),
        (lambda: TactileImage(crop=(1.5, 2, 3)), ["crop must be", "got (1.5, 2, 3)", "4 numbers, each a whole number"]),
        (lambda: TactileImage(crop=(1.5, 2, 3, 4)), ["crop must be", "got (1.5, 2, 3, 4)", "a whole number from 0"]),
        (lambda: Resolution(surface_m=0.0), ["surface_m must be", "got 0.0"]),
        (lambda: Motion(step_s=0.03), ["step_s must be", "got 0.03", "0.02"]),
        (lambda: Motion(press_step_m=5e-3), ["press_step_m must be", "got 0.005", "0.5 m/s"]),
        (lambda: Motion(settle_limit=2), ["settle_limit must be", "got 2", "settle_steps"]),
        (lambda: Solver(iterations=0), ["iterations must be", "got 0"]),
        (lambda: ContactModel(resting=(3e7, -1.0)), ["resting must be", "from 100 to", "got (30000000.0, -1.0)"]),
        (
            lambda: Design("x", pins=Pins(length_m=4.9e-3), shape=TipGeometry(radius_m=15e-3)),
            ["length_m must be at most a quarter of the dome's radius", "got 0.0049"],
        ),
        (lambda: Design("x", pins=Pins(rings=7)), ["pitch_m must be", "got 0.003", "7 rings"]),
        (
            lambda: Design("x", materials=Materials(skin_thickness_m=3e-3), shape=TipGeometry(radius_m=15e-3)),
            ["skin_thickness_m must be at most 0.15 of the dome's radius", "got 0.003"],
        ),
    ],
)
def test_invalid_value_error_names_field_and_limits(make, words):
    with pytest.raises(TactipError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numpy_numbers_and_allowed_none_are_accepted():
    image = TactileImage(crop=tuple(np.arange(4)), threshold=None, size_px=np.int32(64))
    assert image.crop is not None and TactileImage(crop=None).crop is None
    assert Materials(friction=np.float32(0.5), gel_young_pa=20000).friction == 0.5
    assert Optics(centre=(np.float64(0.5), 1)).centre == (0.5, 1)


@pytest.mark.parametrize(
    ("pose", "shear", "words"),
    [
        ([0, 0, -8.5, 0, 0, 0], [0] * 6, ["8.5 mm", "at most 8 mm"]),
        ([0, 0, -7, 0, 0, 0], [0, 0, 2, 0, 0, 0], ["before the shear", "9 mm"]),
        ([0, 0, -3, 35, 0, 0], [0] * 6, ["tilt", "35 degrees", "at most 30"]),
        ([0, 0, -3, 0, 0, 0], [21, 0, 0, 0, 0, 0], ["shear", "21 mm", "at most 20 mm"]),
        ([0, 0, np.nan, 0, 0, 0], [0] * 6, ["finite"]),
    ],
)
def test_pose_out_of_reach_raises_error(on_surface, pose, shear, words):
    with pytest.raises(TactipError) as caught:
        on_surface(pose, shear)
    for word in words:
        assert word in str(caught.value)


def test_needle_has_smaller_depth_limit(design, standard):
    with pytest.raises(TactipError, match="must be at most 5 mm, got 6 mm"):
        ContactSimulator(design, "needle", standard).simulate(from_mm_deg([0, 0, -6, 0, 0, 0]), np.zeros(6))


def test_ranges_out_of_reach_raise_error():
    for task in TASKS:
        check_ranges(POSE_RANGES[task], SHEAR_RANGES)
    with pytest.raises(TactipError, match="must be at most 8 mm, got 9 mm"):
        check_ranges(Ranges(depth_mm=(-9, -1)), SHEAR_RANGES)
    with pytest.raises(TactipError, match="at most 20 mm"):
        check_ranges(POSE_RANGES["edge"], Ranges(x_mm=(-15, 15), y_mm=(-15, 15)))
    with pytest.raises(TactipError, match="at most 30 degrees"):
        check_ranges(Ranges(depth_mm=(-3, -1), roll_deg=(-31, 25)), SHEAR_RANGES)


def test_finer_fidelity_stays_within_limits():
    """The finer one of any allowed fidelity is allowed, too."""
    extreme = Fidelity("x", motion=Motion(step_s=MIN_STEP_S, press_step_m=2e-5, shear_step_m=7e-6))
    extreme = replace(extreme, contact=ContactModel(resting=(1e9, 1e7)), solver=Solver(tolerance=1e-14))
    for _ in range(TRIES):
        extreme = finer(extreme)
    assert extreme.motion.step_s == MIN_STEP_S
