"""InteractiveContact: equal to a contact of a data set after the same motion, and it keeps its shear."""

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
    """Return the TipState at rest, after a direct motion to a label if there is one."""
    if label is not None:
        press.set_target(label)
    for _ in range(300):
        state = press.advance(3)
        if press.at_rest:
            return state
    raise AssertionError("the tip did not come to rest")


def _apart_mm(a, b):
    return 1e3 * float(np.linalg.norm(a.pin_tips - b.pin_tips, axis=1).max())


def test_press_equals_contact_of_data_set(press):
    press.set_target(DEEP)
    press.lift()
    state = _settled(press)
    contact = ContactSimulator(design_named("nominal-127"), "surface", fidelity_named("draft")).simulate(DEEP, np.zeros(6))
    assert np.allclose(press.label, DEEP)
    assert -state.force[2] == pytest.approx(contact.normal_force_n, rel=0.02)
    assert _apart_mm(state, contact) < 0.05


def test_skin_keeps_shear_until_lifted(press):
    press.set_target(DEEP)
    press.lift()
    straight = _settled(press)
    aside = _settled(press, DEEP + from_mm_deg([3, 0, 0, 0, 0, 0]))
    back = _settled(press, DEEP)
    assert np.hypot(*aside.force[:2]) > 10 * np.hypot(*straight.force[:2])
    assert _apart_mm(aside, straight) > 0.5
    assert _apart_mm(back, straight) > 0.05  # some of it slipped
    press.lift()
    again = _settled(press)
    assert np.array_equal(again.pin_tips, straight.pin_tips)


def test_lift_leaves_tip_clear(press):
    press.set_target(from_mm_deg([0, 0, -4, 10, 5, 0]))
    press.lift()
    state = press.tip_state()
    assert np.linalg.norm(state.force) == 0
    assert press.label[2] > 0


def test_target_can_change_during_motion(press):
    press.set_target(DEEP)
    press.lift()
    press.advance(2)
    target = from_mm_deg([1, 1, -2, 0, 0, 5])
    assert np.allclose(_settled(press, target) and press.label, target)


def test_set_target_out_of_reach_raises_error_and_keeps_target(press):
    _settled(press, DEEP)
    with pytest.raises(TactipError, match="depth"):
        press.set_target(from_mm_deg([0, 0, -20, 0, 0, 0]))
    with pytest.raises(TactipError, match="tilt"):
        press.set_target(from_mm_deg([0, 0, -2, 50, 0, 0]))
    assert np.allclose(_settled(press) and press.label, DEEP)
