"""A simulated tip on an arm: time steps that diverge are made in parts."""

import numpy as np
import pytest
import trimesh

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.simulator import Diverged
from tactip_twin.sim.robot import mounted_tip
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.presets import design_named


def pressed(arm: str, before=lambda: None) -> np.ndarray:
    """Press a tip 1 mm deep into a plate and slide by 0.5 mm, and return its pin tips (p, 3), m.

    before: Called before the slide.
    """
    plate = load_object("plate")
    tip = MountedTip(
        design_named("tactip-127"), plate.solid, fidelity_named("draft"), arm_model_named(arm), plate.T_base_object
    )
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = plate.T_base_object[:3, 3] + [0, 0, plate.solid.vertices[:, 2].max() + 1e-3]
    tip.reset_to(T)
    T[2, 3] -= 2e-3
    tip.go(T)
    before()
    T[0, 3] += 0.5e-3
    return tip.go(T).pin_tips


@pytest.mark.parametrize("arm", ["none", "dynamic"])
@pytest.mark.parametrize(("parts", "error_mm"), [((1, 1), 1e-4), ((1, 4), 0.08)])
def test_step_that_diverges_is_repeated_from_its_start(arm, parts, error_mm, monkeypatch):
    expected, check, calls = pressed(arm), mounted_tip.check_force, []

    def fail_first(force_n):
        calls.append(1)
        if len(calls) == 1:
            raise Diverged("the simulation diverged")
        check(force_n)

    monkeypatch.setattr(mounted_tip, "_PARTS", parts)
    found = pressed(arm, lambda: monkeypatch.setattr(mounted_tip, "check_force", fail_first))
    assert len(calls) > 4
    assert 1e3 * np.abs(found - expected).max() < error_mm


def test_step_that_diverges_in_the_smallest_parts_is_an_error(monkeypatch):
    def fail(force_n):
        raise Diverged("the simulation diverged")

    with pytest.raises(Diverged):
        pressed("none", lambda: monkeypatch.setattr(mounted_tip, "check_force", fail))


def test_edge_beside_the_clamped_rim_presses_the_skin_and_not_the_housing(tmp_path):
    """Half a millimetre from the clamp, a facet between two clamped corners would take any force: 11 N here, and up to
    300,000 N in a servo run."""
    trimesh.creation.box((60, 60, 60)).export(tmp_path / "box.stl")
    box = load_object(str(tmp_path / "box.stl"), "mm", position_mm=(400.0, 0.0, 100.0))
    draft = fidelity_named("draft")
    tip = MountedTip(design_named("tactip-127"), box.solid, draft, arm_model_named("none"), box.T_base_object)
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1, -1])
    for height_mm in (19.0, 19.5):
        # The box's upper edge is at x = 430 mm and z = 160 mm, and the tip comes from beside it.
        T[:3, 3] = [451e-3, 0, (160 - height_mm) / 1e3]
        tip.reset_to(T)
        for overlap_mm in (0.25, 0.75, 1.25):
            T[0, 3] = (450 - overlap_mm) / 1e3
            state = tip.go(T)
        assert 0.3 < np.linalg.norm(state.force) < 3.0
        assert state.peak_force_n < 3.0
