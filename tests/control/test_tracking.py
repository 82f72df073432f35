"""Tracking of moving objects: the motion, tips that take part in it, and the errors of the servo."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.commands import main as tactip
from tactip_twin.control.track_options import TrackOptions
from tactip_twin.control.tracking import track
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.pose import matrix
from tactip_twin.sim.robot.arm_models import arm_model_named
from tactip_twin.sim.robot.moving_object import MovingMountedTip, moved_object
from tactip_twin.sim.robot.object_motion import ObjectMotion
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.robot.recording import PHASES, read_recorded_scene, read_recording
from tactip_twin.sim.view.curves import curves_of
from tactip_twin.sim.view.geometry import object_moves
from tactip_twin.tactip_model.errors import Interrupted, TactipError


def test_object_moves_smoothly_up_to_its_amplitudes():
    motion, T = ObjectMotion(), matrix([0.4, 0.1, 0.2], Rotation.from_rotvec([0, 0, 0.3]))
    pivot = np.array([0.4, 0.1, 0.22])
    assert np.array_equal(moved_object(T, pivot, motion, 0.0), T)
    poses = [moved_object(T, pivot, motion, t) @ np.linalg.inv(T) for t in np.arange(0, 40, 0.02)]
    places = np.array([P[:3, :3] @ pivot + P[:3, 3] - pivot for P in poses])
    turns = np.degrees([Rotation.from_matrix(P[:3, :3]).as_rotvec() for P in poses])
    assert np.allclose(np.abs(places).max(0), 0.075, rtol=0.01)
    assert np.allclose(np.abs(turns).max(0), 25, rtol=0.01)
    assert np.abs(np.diff(places, 2, axis=0)).max() < 2e-3 * 0.02**2 * 40


def test_tip_and_object_that_move_together_stay_as_they_are(design):
    """A rigid motion of both changes nothing for the tip; a motion of the object alone is that of the sensor backwards."""
    plate = load_object("plate")
    tip = MovingMountedTip(design, plate.solid, fidelity_named("draft"), arm_model_named("none"), plate.T_base_object)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([-1.0, 1, -1]), [0.38, 0, 0.022]
    tip.reset_to(T)
    T[2, 3] = 0.018
    tip.go(T)
    still = tip.go(T)
    both = matrix([1e-3, 2e-3, 3e-3], Rotation.from_rotvec([0.02, 0.03, 0.1]))
    tip.move_object(both @ plate.T_base_object)
    together = tip.go(both @ T)
    assert np.allclose(tip.T_base_object, both @ plate.T_base_object, atol=1e-12)
    assert np.abs(together.pin_tips - still.pin_tips).max() < 20e-6
    shift = matrix([0.3e-3, 0, 0], Rotation.identity())
    ends = []
    for moved_sensor, moved_plate in ((shift, np.eye(4)), (np.eye(4), np.linalg.inv(shift))):
        tip.T_base_object, tip._motion_of_object = plate.T_base_object, None
        start = T.copy()
        start[2, 3] = 0.022
        tip.reset_to(start)
        tip.go(T)
        tip.move_object(moved_plate @ plate.T_base_object)
        ends.append(tip.go(moved_sensor @ T).pin_tips)
    assert np.abs(ends[0] - ends[1]).max() < 1e-6


def check_recording(folder, score):
    """Check that a replay has the object's motion, and the errors of the score."""
    (record, arrays), scene = read_recording(folder), read_recorded_scene(folder)
    following = arrays["phase"] == PHASES.index("follow")
    assert record["steps"] == 31 and following.sum() == 15
    assert np.array_equal(arrays["T_base_object"][0], scene.T_base_object)
    pivot = scene.T_base_object[:3, 3] + [0, 0, scene.object_vertices[:, 2].max()]
    moved = moved_object(scene.T_base_object, pivot, ObjectMotion(ramp_s=3.0), 14 / 30)
    assert np.allclose(arrays["T_base_object"][-1], moved, atol=1e-6)
    # The pose relative to the place that was touched is the label, whose reference is 4 mm deep and upright.
    errors_mm = 1e3 * (arrays["true"][following, :3] + [0, 0, 4e-3])
    assert np.sqrt((errors_mm**2).sum(1).mean()) == pytest.approx(score["rms_mm"], rel=0.02)
    assert [c.name for c in curves_of(arrays, "surface")] == ["force", "position error", "x", "y", "depth", "Rx", "Ry", "Rz"]
    assert object_moves(arrays)


def test_servo_with_true_poses_tracks_all_axes(tmp_path, capsys):
    words = ["track", "--model", "oracle", "--fidelity", "fast", "--arm", "none", "--seconds", "0.5", "--ramp-s", "3"]
    assert tactip.main([*words, "--out", str(tmp_path / "run")]) == 0
    assert "error relative to the object, root mean square: 0." in capsys.readouterr().out
    score = json.loads((tmp_path / "run" / "score.json").read_text())
    assert score["stopped_because"] == "completed" and score["seconds"] == pytest.approx(0.5)
    assert score["rms_mm_by_period"] == [score["rms_mm"]] and score["rms_deg_by_period"] == [score["rms_deg"]]
    assert score["rms_mm"] < 0.3 and score["rms_deg"] < 0.2
    assert score["estimate_rms_by_axis"] == [0] * 6
    assert (tmp_path / "run" / "tracking.png").stat().st_size > 5000
    check_recording(tmp_path / "run", score)
    assert tactip.main([*words, "--out", str(tmp_path / "run")]) == 1
    assert "is not empty" in capsys.readouterr().err


def test_track_invalid_network_is_refused(tmp_path):
    with pytest.raises(TactipError, match="the network must be of the task surface, got one of edge"):
        track(TrackOptions(tmp_path / "run", model="edge-tactip-127", fidelity="fast", arm="none"))


def test_object_that_is_not_flat_is_refused(tmp_path):
    with pytest.raises(TactipError, match=r"the top of bust must be flat within 15 mm of its middle: its height"):
        track(TrackOptions(tmp_path / "run", object="bust"))


def test_interrupted_run_is_scored(tmp_path):
    def interrupt(done, count):
        if done == 3:
            raise KeyboardInterrupt

    options = TrackOptions(tmp_path / "run", model="oracle", fidelity="fast", arm="none", seconds=1.0)
    with pytest.raises(Interrupted, match="recording and score of the steps so far are in"):
        track(options, interrupt)
    score = json.loads((tmp_path / "run" / "score.json").read_text())
    assert score["stopped_because"] == "interrupted" and score["seconds"] == pytest.approx(0.1)
