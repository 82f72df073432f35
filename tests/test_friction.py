"""What friction must do along a path, and what must not happen without it."""

import numpy as np
import pytest

from benchmarks import friction

MU = 0.3


@pytest.fixture(scope="module")
def orders():
    return {mu: friction.orders(mu) for mu in (0.0, MU)}


@pytest.mark.parametrize("order", ["press, then shear", "both at once"])
def test_order_of_motions(orders, order):
    """Without friction only where the tip is counts; with it, how it came there."""
    ice, rubber = orders[0.0][order], orders[MU][order]
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert rubber["pins_mm"][0] > 0.2


def test_unloading():
    ice, rubber = friction.unloading(0.0), friction.unloading(MU)
    assert ice["pins_mm"][1] < 0.01
    assert ice["force_ratio"] == pytest.approx(1, abs=0.005)
    assert abs(ice["lost"]) < 0.002
    assert ice["lost"] < rubber["lost"] < 0.05
    assert rubber["force_ratio"] < ice["force_ratio"]


def test_shear_cycle():
    """Friction keeps a part of the shear and takes work from each cycle; without it nothing is kept or taken."""
    ice, rubber = friction.shear_cycle(0.0), friction.shear_cycle(MU)
    assert ice["residual_mm"][1] < 0.01
    assert rubber["residual_mm"][0] > 0.2
    assert np.abs(ice["work_mj"]).max() < 1e-3 * min(rubber["work_mj"])
    assert ice["greatest"] == 0
    assert 0.85 * MU < rubber["greatest"] <= MU * (1 + 1e-6)
    x, force = (np.array(rubber["loop"][k]) for k in ("x_mm", "force_n"))
    # The loop cannot enclose more than friction at its limit would, all the way there and back.
    assert 0 < rubber["work_mj"][1] < np.abs(force).max() * np.abs(np.diff(x)).sum()


@pytest.mark.parametrize("mu", [MU, pytest.param(0.6, marks=pytest.mark.slow)])
def test_force_along_a_slide(mu):
    """Contacts at rest: their force does not depend on where along the slide they are, and obeys Coulomb."""
    travel, normal, tangential = friction.slide_at_rest(mu, 3.0)
    steady = travel > friction.SLIDE_MM / 2
    assert normal[steady].std() < 0.005 * normal[steady].mean()
    assert (tangential <= mu * normal * (1 + 1e-6)).all()
    assert (tangential[steady] > 0.85 * mu * normal[steady]).all()


@pytest.mark.parametrize("mu", [0.3, 0.6])
def test_slides_do_not_chatter(mu):
    """The force's standard deviation is below 5 % of its mean, at `standard`'s own steps.

    At 2 mm, where a vertex carries least and chatters most.
    """
    assert friction.chatter(*friction.slide(mu, 2.0))["deviation"] < 0.05


def test_slides_on_ice_are_smooth():
    ice = friction.chatter(*friction.slide(0.0, 2.0))
    assert ice["deviation"] < 0.02
    assert ice["greatest"] == 0


def test_force_while_sliding_obeys_coulomb():
    travel, normal, tangential = friction.slide(MU, 3.0)
    assert (tangential <= MU * normal * (1 + 1e-6)).all()
    steady = travel > friction.SLIDE_MM / 2
    assert tangential[steady].mean() == pytest.approx(MU * normal[steady].mean(), rel=0.02)
