"""Stimuli: their shape, the height at which the tip clears them, and a press on each."""

import mujoco
import numpy as np
import pytest

from tactip_twin.sim.contact import stimuli
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.retries import RetryingSimulator
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.contact.stimuli import STIMULI, stimulus_named
from tactip_twin.sim.labels import TASKS
from tactip_twin.sim.pose import from_mm_deg, inverse, sensor_in_contact
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.soft_body import ContactModel

DOME_M = 20e-3

PRESS = from_mm_deg([0, 0, -3, 0, 0, 0])


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
    return {name: (*simulator.simulate(PRESS, np.zeros(6)), simulator.tries) for name, simulator in players.items()}


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
    contact = ContactSimulator(design, "needle", standard).simulate(PRESS, np.zeros(6))
    assert contact.penetration_m == 0.0
    assert contact.normal_force_n == 0.0
    assert any("overlap" in fault for fault in contact.violations(QualityLimits()))


def test_needle_beside_axis_moves_nearest_pins(design, standard):
    """The pins nearest to the needle move most."""
    simulator = RetryingSimulator(design, "needle", standard, QualityLimits())
    contact, violations = simulator.simulate(from_mm_deg([3, 0, -2, 0, 0, 0]), np.zeros(6))
    assert len(violations) < simulator.tries
    neutral, _ = neutral_pins(design)
    moved = np.linalg.norm(contact.pin_tips - neutral, axis=1)
    needle = inverse(sensor_in_contact(contact.pose))[:3, 3]
    assert np.linalg.norm(neutral[moved.argmax(), :2] - needle[:2]) < 2.5e-3
