"""Limits of the stability map: good records or rejections with a reason, and every check can fail."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactip_twin.benchmarks.physics import stability
from tactip_twin.benchmarks.physics.options import StabilityOptions
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact import stimuli
from tactip_twin.sim.contact.fidelity import MIN_STEP_S, Fidelity, Motion, Solver, fidelity_named, finer
from tactip_twin.sim.contact.limits import check_ranges
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.scene import Scene
from tactip_twin.sim.contact.simulator import TRIES, UNCONFIRMED, ContactSimulator, RetryingSimulator
from tactip_twin.sim.contact.stimuli import STIMULI, stimulus_named
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES, Ranges
from tactip_twin.sim.labels import TASKS
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.tactip_model.design import Design, Materials, Optics, Pins, TactileImage, TipGeometry
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import CONTACT_RADIUS_M, Resolution
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.soft_body import ContactModel

DOME_M = 20e-3


def press(simulator, depth_mm, slide_mm=0.0, **options):
    return simulator.simulate(from_mm_deg([0, 0, -depth_mm, 0, 0, 0]), from_mm_deg([slide_mm, 0, 0, 0, 0, 0]), **options)


@pytest.fixture(scope="module")
def good(on_surface):
    contact = on_surface([0, 0, -3, 0, 0, 0], [1, 0, 0, 0, 0, 0])
    assert contact.violations(QualityLimits()) == []
    return contact


# Stimuli: their shape, and the height at which the tip clears them.


class Probe:
    """Distance of a sphere to a stimulus by MuJoCo's own collision functions."""

    def __init__(self, name, radius):
        spec = mujoco.MjSpec()
        stimuli.add_stimulus(spec, stimulus_named(name), 0.3, ContactModel())
        ball = spec.worldbody.add_body(name="probe", mocap=True)
        ball.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], contype=0, conaffinity=0)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.probe = self.model.geom("probe").id

    def __call__(self, centre):
        self.data.mocap_pos[0] = centre
        mujoco.mj_forward(self.model, self.data)
        others = (g for g in range(self.model.ngeom) if g != self.probe)
        return min(mujoco.mj_geomDistance(self.model, self.data, self.probe, g, 1.0, None) for g in others)


@pytest.mark.parametrize("name", STIMULI)
def test_stimulus_distance_agrees_with_mujoco(name):
    """Outside it agrees to a few µm, the error of the rounding's facets; the highest point is at zero."""
    probe, stimulus, rng = Probe(name, 0.2e-3), stimulus_named(name), np.random.default_rng(0)
    points = rng.uniform([-8e-3, -8e-3, -8e-3], [8e-3, 8e-3, 4e-3], (60, 3))
    distance = stimulus.distance(points)
    outside = distance > 0.3e-3
    assert outside.sum() > 10
    measured = np.array([probe(p) + 0.2e-3 for p in points[outside]])
    assert np.abs(measured - distance[outside]).max() < 15e-6
    grid = np.stack(np.meshgrid(*[np.linspace(-9e-3, 9e-3, 181)] * 2), -1).reshape(-1, 2)
    top = stimulus.distance(np.column_stack([grid, np.zeros(len(grid))]))
    assert abs(top.min()) < 1e-9


@pytest.mark.parametrize("name", STIMULI)
def test_height_to_clear_agrees_with_brute_force(name):
    probe, stimulus, rng = Probe(name, DOME_M), stimulus_named(name), np.random.default_rng(1)
    more_than_needed = stimuli.EDGE_RADIUS_M if name == "edge" else 20e-6
    for centre in rng.uniform([-25e-3, -10e-3, 5e-3], [25e-3, 10e-3, 30e-3], (8, 3)):
        lift = stimulus.height_to_clear(centre, DOME_M)
        if np.isinf(lift):
            heights = np.linspace(-30e-3, 0, 7) - centre[2]
            assert all(probe(centre + [0, 0, h]) > -20e-6 for h in heights)
            continue
        heights = lift + np.array([0.0, 0.5e-3, 2e-3, 10e-3])
        assert all(probe(centre + [0, 0, h]) > -20e-6 for h in heights)  # clear from there on up
        if name != "edge" or centre[0] < DOME_M - 1e-3:
            slack = probe(centre + [0, 0, lift])
            assert slack < more_than_needed + 1e-6


def test_unknown_stimulus_error_lists_names(design, standard):
    with pytest.raises(TactipError, match=r"unknown stimulus 'banana': choose one of surface, edge, sphere"):
        ContactSimulator(design, "banana", standard)
    assert set(TASKS) < set(STIMULI)


@pytest.fixture(scope="module")
def pressed(design, standard):
    """Return for each stimulus the 3 mm press: Contact, its failed checks and the allowed number of tries."""
    players = {name: RetryingSimulator(design, name, standard, QualityLimits()) for name in STIMULI}
    return {name: (*press(simulator, 3), simulator.tries) for name, simulator in players.items()}


def test_press_on_every_stimulus_passes_checks(pressed):
    for name, (contact, violations, tries) in pressed.items():
        assert len(violations) < tries, name
        assert contact.violations(QualityLimits()) == [], name
        assert contact.penetration_m < QualityLimits().penetration_m, name


def test_force_grows_with_bluntness(pressed):
    forces = [pressed[name][0].normal_force_n for name in ("needle", "point", "sphere", "knife", "edge", "surface")]
    assert (np.diff(forces[1:]) > 0).all()
    # Between vertices 2 mm apart, a needle is as blunt as a point.
    assert forces[0] == pytest.approx(forces[1], rel=0.02)
    assert 0.5 < forces[0] < 1.0


@pytest.mark.parametrize("name", ["surface", "sphere", "point", "needle", "hole"])
def test_press_on_symmetric_stimulus_has_no_side_force(pressed, design, name, on_surface):
    """The pin field does not drift to a side either."""
    contact = pressed[name][0]
    assert contact.tangential_force_n < 0.05 * contact.normal_force_n
    moved = contact.pin_tips - on_surface.simulator.reader.pin_tips
    assert np.linalg.norm(moved.mean(0)[:2]) < 0.03 * np.linalg.norm(moved, axis=1).max()


def test_overlap_detects_stimulus_between_vertices(design, standard, monkeypatch):
    """Simulated as if it were not thin, the needle pierces a facet; no contact shows it, but the shape does."""
    monkeypatch.setattr(stimuli.Rod, "width_m", np.inf)
    contact = press(ContactSimulator(design, "needle", standard), 3)
    assert contact.penetration_m == 0.0
    assert contact.normal_force_n == 0.0
    assert any("overlap" in fault for fault in contact.violations(QualityLimits()))


# Records: each check can fail, and measures the named quantity.


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"normal_force_n": float("nan")}, "not finite"),
        ({"overlap_m": float("inf")}, "not finite"),
        ({"volume_ratio": -0.2}, "shrank"),
        ({"penetration_m": 0.06e-3}, "inside the skin"),
        ({"overlap_m": 0.2e-3}, "overlap"),
        ({"speed_m_s": 0.03}, "still moves"),
        ({"imbalance": 0.6}, "not balanced"),
        ({"energy_drift_m_s": 0.01}, "drifts"),
        ({"area_ratio": 0.05}, "facet"),
        ({"fold_rad": 3.0}, "folded"),
        ({"unconverged_fraction": 0.5}, "iterations"),
    ],
)
def test_faults_of_bad_record_name_the_check(good, change, word):
    (fault,) = replace(good, **change).violations(QualityLimits())
    assert word in fault


@pytest.mark.parametrize("name", ["surface", "edge", "needle"])
def test_overlap_of_undeformed_tip_is_exact(design, standard, name):
    """At 2 mm depth it is 2 mm, less the depth of the mesh's facets inside the sphere."""
    scene = Scene(design, name, standard)
    overlap = scene.overlap(sensor_in_contact(from_mm_deg([0, 0, -2, 0, 0, 0])))
    depth = {"surface": 2e-3, "edge": 2e-3, "needle": stimuli.NEEDLE_RADIUS_M + CONTACT_RADIUS_M}[name]
    assert depth - 0.2e-3 < overlap < depth + 1e-6
    assert scene.overlap(sensor_in_contact(from_mm_deg([0, 0, 1, 0, 0, 0]))) == 0.0


def test_skin_shape_measures_folds_and_shrunk_facets(on_surface):
    scene = on_surface.simulator.scene
    rest = scene.mesh.vertices
    area, fold = scene.skin_shape(rest)
    assert area == pytest.approx(1.0)
    assert fold < np.radians(30)
    apex = int(rest[: scene.mesh.surface_count, 2].argmax())
    around = np.unique(scene.mesh.triangles[(scene.mesh.triangles == apex).any(1)])
    facet = scene.mesh.triangles[(scene.mesh.triangles == apex).any(1)][0]
    opposite = rest[facet[facet != apex]].mean(0)
    folded = rest.copy()
    folded[apex] = 2 * opposite - rest[apex]  # over the edge, onto the next facet
    assert scene.skin_shape(folded)[1] > QualityLimits().fold_rad
    squashed = rest.copy()
    squashed[around] = squashed[apex] + 0.1 * (squashed[around] - squashed[apex])
    assert scene.skin_shape(squashed)[0] < 0.05


def test_record_of_moving_tip_has_energy_drift(design, standard, monkeypatch):
    """In a press recorded in motion, elastic energy is still being stored."""
    jerky = replace(standard, motion=replace(standard.motion, ease_in=0.0, ease_out=0.0))
    simulator = ContactSimulator(design, "surface", jerky)
    assert not press(simulator, 3).violations(QualityLimits())
    monkeypatch.setattr(ContactSimulator, "_settle", lambda self, pose: None)
    assert any("drifts" in fault for fault in press(simulator, 3).violations(QualityLimits()))


def test_record_shows_solver_at_iteration_limit(design, standard):
    simulator = ContactSimulator(design, "surface", standard)
    simulator.scene.model.opt.iterations = 10
    contact = press(simulator, 3, 2)
    assert contact.unconverged_fraction > 0.5
    assert any("iterations" in fault for fault in contact.violations(QualityLimits()))


# Materials and steps.


@pytest.mark.parametrize("scale", [0.05, 50.0])
def test_force_scales_with_all_moduli(design, standard, good, scale):
    """With all moduli scaled, the shape is the same and the force scales, because contact stiffness does, too."""
    m = design.materials
    other = replace(m, skin_young_pa=scale * m.skin_young_pa, gel_young_pa=scale * m.gel_young_pa)
    contact = press(ContactSimulator(replace(design, materials=other), "surface", standard), 3, 1)
    assert contact.violations(QualityLimits()) == []
    assert contact.normal_force_n == pytest.approx(scale * good.normal_force_n, rel=0.01)
    assert np.linalg.norm(contact.pin_tips - good.pin_tips, axis=1).max() < 0.05e-3


@pytest.mark.parametrize(
    "materials",
    [
        {"skin_young_pa": 1e3, "gel_young_pa": 1e3},
        {"skin_young_pa": 1e8, "gel_young_pa": 1e6},
        {"skin_young_pa": 1e3, "gel_young_pa": 1e6},
        {"gel_poisson": 0.499, "skin_poisson": 0.0},
        {"density_kg_m3": 10500.0, "damping_s": 2e-3},
    ],
)
def test_extreme_materials_converge(materials):
    result = stability.judge(stability.Cell("", "", "", slide_mm=2, materials=materials), fidelity_named("standard"))
    assert result["verdict"] in ("converged", "after refinement"), result["reasons"]


@pytest.mark.parametrize("name", ["needle", "edge", "hole", "sphere"])
def test_start_inside_non_flat_stimulus_raises_error(design, standard, name):
    with pytest.raises(TactipError, match=r"approach must be True .*, got False"):
        press(ContactSimulator(design, name, standard), 1, approach=False)


def test_start_inside_plane_equals_approach(design, standard):
    simulator = RetryingSimulator(design, "surface", standard, QualityLimits())
    contact, violations = press(simulator, 1, approach=False)
    assert len(violations) < simulator.tries
    approached, _ = press(simulator, 1)
    assert contact.normal_force_n == pytest.approx(approached.normal_force_n, rel=0.05)


def test_snagging_stimulus_needs_agreement_of_two_steps(design, standard):
    """Neither a single good record nor two that differ suffice."""
    simulator = RetryingSimulator(design, "knife", standard, QualityLimits())
    contact, violations = press(simulator, 1, 3)
    assert violations[-1] == [UNCONFIRMED]
    assert len(violations) < simulator.tries
    again = ContactSimulator(design, "knife", finer(simulator._simulator(len(violations)).scene.fidelity))
    apart = np.linalg.norm(press(again, 1, 3).pin_tips - contact.pin_tips, axis=1)
    assert np.sqrt(np.mean(apart**2)) < QualityLimits().disagreement_m
    _, violations = press(RetryingSimulator(design, "knife", standard, QualityLimits(disagreement_m=1e-9)), 1, 3)
    assert len(violations) == simulator.tries
    assert "halving the step moves the pins by" in violations[-1][0]


def test_good_records_around_bad_one_do_not_confirm(design, monkeypatch, good):
    """Their steps differ by a factor of four, and the bad record between them cannot serve as the coarser one."""
    bad = replace(good, penetration_m=1e-3)
    simulator = RetryingSimulator(design, "knife", fidelity_named("draft"), QualityLimits())
    script = iter([good, bad, good, good])
    monkeypatch.setattr(ContactSimulator, "simulate", lambda *_: next(script))
    contact, violations = simulator.simulate(good.pose, good.shear)
    assert contact is good
    assert [f == [UNCONFIRMED] for f in violations] == [True, False, True]
    assert simulator._slider is simulator._simulators[2] and simulator.last is simulator._simulators[3]


def test_skin_that_slides_on_does_not_confirm(design, monkeypatch, good):
    """A point at a friction of 1: two records agree, and the tip is 0.7 mm away with half the step."""
    simulator = RetryingSimulator(design, "corner", fidelity_named("draft"), QualityLimits())
    settling = iter([21, 21, 3, 6])

    def simulate(self, *_):
        self.settled_steps = next(settling) * 2 ** simulator._simulators.index(self)
        return good

    monkeypatch.setattr(ContactSimulator, "simulate", simulate)
    _, violations = simulator.simulate(good.pose, good.shear)
    assert violations[0] == ["the skin slid on for 147 ms after the object had stopped (allowed: 84 ms)"]
    assert violations[2:] == [[UNCONFIRMED]]


@pytest.mark.parametrize(
    ("name", "friction", "tries"),
    [("surface", 1.0, 3), ("surface", 1.1, 4), ("sphere", 0.9, 3), ("sphere", 1.0, 4), ("corner", 0.3, 4)],
)
def test_high_friction_and_sharp_stimuli_need_one_more_try(design, name, friction, tries):
    rough = replace(design, materials=replace(design.materials, friction=friction))
    assert RetryingSimulator(rough, name, fidelity_named("draft"), QualityLimits()).tries == tries


@settings(max_examples=4, suppress_health_check=[HealthCheck.too_slow])
@given(
    skin=st.floats(1, 8),
    gel=st.floats(3, 6),
    poisson=st.tuples(st.floats(0, 0.499), st.floats(0, 0.499)),
    friction=st.floats(0, 2.1),
    density=st.floats(105, 10500),
    name=st.sampled_from(list(STIMULI)),
    depth=st.floats(0.2, 8),
    slide=st.floats(0, 3),
)
def test_any_configuration_is_rejected_or_good(skin, gel, poisson, friction, density, name, depth, slide):
    try:
        materials = Materials(
            skin_young_pa=10**skin,
            gel_young_pa=10**gel,
            skin_poisson=poisson[0],
            gel_poisson=poisson[1],
            friction=friction,
            density_kg_m3=density,
        )
        simulator = RetryingSimulator(Design("any", materials=materials), name, fidelity_named("draft"), QualityLimits())
        contact, violations = press(simulator, depth, slide)
    except TactipError as error:  # a needle must not be pressed deeper than 5 mm
        assert "must be" in str(error)
        return
    if len(violations) == simulator.tries:
        assert all(violations)
        return
    assert np.isfinite(contact.pin_tips).all() and np.isfinite(contact.directions).all()
    assert contact.volume_ratio > 0
    assert contact.penetration_m <= QualityLimits().penetration_m
    assert contact.normal_force_n > -1e-6


# Checks before the simulation.


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
        press(ContactSimulator(design, "needle", standard), 6)


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


# The map.


def test_cell_that_half_the_step_contradicts_is_wrong(monkeypatch):
    """The map must show that half the step gives another result."""
    monkeypatch.setattr(stability, "PINS_MM", 1e-6)
    result = stability.judge(stability.Cell("", "", "", depth_mm=1.0), fidelity_named("draft"))
    assert result["verdict"] == "wrong"
    assert "half the step" in result["reasons"][0]


def test_stability_map_is_resumed_and_written(tmp_path, monkeypatch):
    """All cells are known from an earlier run."""
    stiff = [cell for cell in stability.cells() if cell.row == "501"]
    monkeypatch.setattr(stability, "_chosen", lambda quick: stability.cells()[:1] + stiff[:3])
    chosen = stability._chosen(True)
    folder = tmp_path / ".stability-quick"
    folder.mkdir()
    for i, cell in enumerate(chosen):
        record = stability.asdict(cell) | stability.judge(cell, fidelity_named("draft"))
        (folder / f"{i:04d}.json").write_text(json.dumps(record))
    result = stability.run(StabilityOptions(tmp_path, quick=True, workers="1"), log=lambda line: None)
    assert result["counts"]["refused beforehand"] == 3
    assert result["map"][-1]["reasons"][0].startswith("skin_young_pa must be at most 500 times gel_young_pa")
    assert "| 4 |" in (tmp_path / "stability.md").read_text()
    assert (tmp_path / "stability.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "stability.json").read_text())["map"][0]["panel"].startswith("skin modulus")
    assert not folder.exists()


def test_stability_cells_have_distinct_positions():
    places = [(c.panel, c.row, c.column) for c in stability.cells()]
    assert len(set(places)) == len(places)
    assert len(places) > 300


@pytest.mark.slow
def test_quick_stability_map_has_no_wrong_cell(tmp_path):
    assert tactip.main(["bench", "stability", "--quick", "--out", str(tmp_path)]) == 0


def test_needle_beside_axis_moves_nearest_pins(design, standard):
    """The pins nearest to the needle move most."""
    simulator = RetryingSimulator(design, "needle", standard, QualityLimits())
    contact, violations = simulator.simulate(from_mm_deg([3, 0, -2, 0, 0, 0]), np.zeros(6))
    assert len(violations) < simulator.tries
    neutral, _ = neutral_pins(design)
    moved = np.linalg.norm(contact.pin_tips - neutral, axis=1)
    needle = inverse(sensor_in_contact(contact.pose))[:3, 3]
    assert np.linalg.norm(neutral[moved.argmax(), :2] - needle[:2]) < 2.5e-3


@pytest.mark.parametrize("away", [1e200, float("nan"), 10.0])
def test_overlap_of_diverged_state_is_infinite(design, standard, away):
    """It is not sampled, because its facets are too large for any number of samples."""
    scene = Scene(design, "edge", standard)
    scene.reset()
    scene.data.qpos[7 + 30] = away
    assert scene.overlap(sensor_in_contact(np.zeros(6))) == np.inf
