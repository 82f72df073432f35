"""A simulated tip on an arm."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.fast_tip.sliding_tip import read_sliding_tip, shipped_sliding_tip
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.fast_mounted_tip import FastMountedTip
from tactip_twin.sim.robot.mounted_tip import MountedTip
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.tactip_model.presets import design_named, load_design


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


@pytest.mark.parametrize("fidelity", ["draft", "fast"])
def test_arm_stops_where_the_housing_runs_against_the_object(fidelity, tmp_path):
    """The sensor moves sideways in the air towards a wall that is as high as its housing alone: 22 mm from the axis."""
    trimesh.creation.box((60, 60, 60)).export(tmp_path / "box.stl")
    box, design = load_object(str(tmp_path / "box.stl"), "mm", position_mm=(400.0, 0.0, 100.0)), load_design("tactip-127")
    arm = arm_model_named("none")
    if fidelity == "fast":
        sliding, truth = read_sliding_tip(shipped_sliding_tip("surface", "tactip-127")), SurfaceGroundTruth(box.solid)
        tip = FastMountedTip(sliding, design, box.solid, fidelity_named("standard"), arm, box.T_base_object, truth)
    else:
        tip = MountedTip(design, box.solid, fidelity_named(fidelity), arm, box.T_base_object)
    T = np.eye(4)
    # The wall is at x = 430 mm, up to z = 160 mm; the housing begins 20 mm behind the apex.
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1, -1]), [456e-3, 0, 100e-3]
    tip.reset_to(T)
    T[0, 3] = 453e-3
    free = tip.go(T)
    assert free.clearance_m == pytest.approx(1e-3, abs=0.02e-3) and not free.stopped_by
    T[0, 3] = 449e-3
    stopped = tip.go(T, 4.5)
    assert stopped.stopped_by == "housing" and stopped.clearance_m > -0.1e-3
    assert tip.arm_model.pose[0, 3] > 451.8e-3
    # It can move away from there.
    T[0, 3] = 455e-3
    assert not tip.go(T, 4.5).stopped_by and tip.arm_model.pose[0, 3] == pytest.approx(455e-3)


def test_a_turn_does_not_throw_the_flank_at_a_wall(tmp_path):
    """A wall 12 mm high stands beside a flank, which a turn of 4° presses into it: nearly all force is that at the end."""
    plate, wall = trimesh.creation.box((120, 60, 20)), trimesh.creation.box((20, 60, 32))
    plate.apply_translation([0, 0, -10])
    wall.apply_translation([28.2, 0, -4])  # from 18.2 mm beside the tip's axis
    trimesh.boolean.union([plate, wall]).export(tmp_path / "corner.stl")
    corner = load_object(str(tmp_path / "corner.stl"), "mm", position_mm=(400.0, 0.0, 100.0))
    ends = corner.solid.vertices @ corner.T_base_object[:3, :3].T + corner.T_base_object[:3, 3]
    _, top, _ = np.unique(ends[:, 2].round(6))
    axis = np.unique(ends[:, 0].round(6))[1] - 18.2e-3
    standard = fidelity_named("standard")
    tip = MountedTip(design_named("tactip-127"), corner.solid, standard, arm_model_named("none"), corner.T_base_object)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1, -1]), [axis, 0, top + 3e-3]
    tip.reset_to(T)
    T[2, 3] = top - 1e-3
    tip.go(T)
    T[:3, :3] = Rotation.from_euler("y", 4, degrees=True).as_matrix() @ T[:3, :3]
    T[2, 3] = top - 1.9e-3
    turned = tip.go(T, 20.0)
    force_n = float(np.linalg.norm(turned.force))
    assert force_n > 1.0 and not turned.stopped_by
    assert turned.peak_force_n < 1.3 * force_n  # 1.7 in four time steps
