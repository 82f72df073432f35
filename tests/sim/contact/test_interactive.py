"""A tip that is pressed by hand: as a contact of a data set where it was moved alike, and with a memory of its shear."""

import numpy as np
import pytest

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.interactive import InteractiveContact
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

DEEP = from_mm_deg([0, 0, -3, 0, 0, 0])


@pytest.fixture(scope="module")
def press():
    return InteractiveContact(design_named("nominal-127"), "surface", fidelity_named("draft"), DEEP)


def _settled(press, label=None):
    """The Touch at a label, come to by the shortest way."""
    if label is not None:
        press.aim(label)
    for _ in range(300):
        touch = press.advance(3)
        if press.at_rest:
            return touch
    raise AssertionError("it does not come to rest")


def _apart_mm(a, b):
    return 1e3 * float(np.linalg.norm(a.tips - b.tips, axis=1).max())


def test_a_press_is_that_of_a_data_set(press):
    press.aim(DEEP)
    press.lift()
    touch = _settled(press)
    contact = ContactSimulator(design_named("nominal-127"), "surface", fidelity_named("draft")).play(DEEP, np.zeros(6))
    assert np.allclose(press.label, DEEP)
    assert -touch.force[2] == pytest.approx(contact.normal_force_n, rel=0.02)
    assert _apart_mm(touch, contact) < 0.05


def test_the_skin_remembers_a_slide_until_it_is_lifted(press):
    press.aim(DEEP)
    press.lift()
    straight = _settled(press)
    aside = _settled(press, DEEP + from_mm_deg([3, 0, 0, 0, 0, 0]))
    back = _settled(press, DEEP)
    assert np.hypot(*aside.force[:2]) > 10 * np.hypot(*straight.force[:2])
    assert _apart_mm(aside, straight) > 0.5
    assert _apart_mm(back, straight) > 0.05  # some of it slipped
    press.lift()
    again = _settled(press)
    assert np.array_equal(again.tips, straight.tips)


def test_it_begins_clear(press):
    press.aim(from_mm_deg([0, 0, -4, 10, 5, 0]))
    press.lift()
    touch = press.touch()
    assert np.linalg.norm(touch.force) == 0
    assert press.label[2] > 0


def test_a_move_may_be_changed_on_the_way(press):
    press.aim(DEEP)
    press.lift()
    press.advance(2)
    there = from_mm_deg([1, 1, -2, 0, 0, 5])
    assert np.allclose(_settled(press, there) and press.label, there)


def test_what_is_out_of_reach_is_said_and_not_gone_to(press):
    _settled(press, DEEP)
    with pytest.raises(TactipError, match="depth"):
        press.aim(from_mm_deg([0, 0, -20, 0, 0, 0]))
    with pytest.raises(TactipError, match="tilt"):
        press.aim(from_mm_deg([0, 0, -2, 50, 0, 0]))
    assert np.allclose(_settled(press) and press.label, DEEP)
