"""A simulated tip on an arm."""

import numpy as np
import trimesh

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.presets import design_named


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
