"""A rig's commands as contacts, and the folders that rigs write."""

import csv
import json

import cv2
import numpy as np
import pytest

from tactip_twin.sim.pose import before_shear, from_mm_deg, sensor_in_contact, shear_between
from tactip_twin.sim2real.calibration.real_set import read_real_set
from tactip_twin.sim2real.calibration.rig import Rig, RigMotion
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.protocol import Protocol, protocol_table
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import parse_table

TAP = from_mm_deg([0, 5, 0, 0, 0, 0])


def test_rig_perfect_contact_equals_command():
    """For a press along y, the work frame's x, z and -y are the contact frame's x, y and z."""
    motion = RigMotion(Rig(press_axis=(0.0, 1.0, 0.0)))
    pose, shear = motion.contact(from_mm_deg([0, -2, 0, 0, 0, 12]), from_mm_deg([3, 0, 0, 0, 0, 4]), TAP)
    assert np.allclose(pose, from_mm_deg([0, 0, -3, 0, 12, 0]))
    assert np.allclose(shear, from_mm_deg([3, 0, 0, 0, 4, 0]))


def test_rig_fraction_zero_is_start_of_move():
    motion = RigMotion(Rig(press_axis=(0.0, 1.0, 0.0), tcp_behind_apex_m=20e-3))
    command, move = from_mm_deg([0, -1, 0, 0, 0, 10]), from_mm_deg([2, 0, 0, 0, 0, 3])
    last, shear = motion.contact(command, move, TAP, 1.0)
    first, none = motion.contact(command, move, TAP, 0.0)
    assert np.allclose(none, 0)
    assert np.allclose(first[3:], before_shear(last, shear)[3:])
    assert np.allclose(first[2], last[2] - shear[2])


def test_rig_lever_lifts_and_moves_rotated_tip():
    lever, turn = 20e-3, np.radians(15)
    motion = RigMotion(Rig(press_axis=(0.0, 0.0, -1.0), tcp_behind_apex_m=lever, depth_zero_m=0.1e-3))
    tap = from_mm_deg([0, 0, -5, 0, 0, 0])
    pose, shear = motion.contact([0, 0, 0, 0, turn, 0], [0, 0, 0, 0, turn, 0], tap)
    assert pose[2] == pytest.approx(-5e-3 - 0.1e-3 + lever * (1 - np.cos(turn)))
    assert np.allclose(shear, [-lever * np.sin(turn), 0, lever * (1 - np.cos(turn)), 0, turn, 0])


def test_rig_azimuth_rotates_pose_and_shear():
    """With a rotated camera, the same commands give the same contact, seen rotated."""
    command, move = from_mm_deg([0, 0, 1, 3, 8, 0]), from_mm_deg([2, 1, 0, 1, -2, 0])
    tap = from_mm_deg([0, 0, -4, 0, 0, 0])
    plain = RigMotion(Rig(tcp_behind_apex_m=5e-3, tilt_zero_deg=(1.0, -2.0))).contact(command, move, tap)
    turned = RigMotion(Rig(tcp_behind_apex_m=5e-3, tilt_zero_deg=(1.0, -2.0), azimuth_deg=90.0)).contact(command, move, tap)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for a, b in zip(plain, turned, strict=True):
        assert np.allclose(b[3:], quarter @ a[3:])
    assert np.allclose(turned[1][:3], quarter @ plain[1][:3])
    assert np.allclose(turned[0][2], plain[0][2])


def test_shear_between_is_the_inverse_of_before_shear():
    pose, shear = from_mm_deg([1, 2, -3, 5, -8, 20]), from_mm_deg([2, -1, 0.5, 3, 2, -4])
    start = before_shear(pose, shear)
    assert np.allclose(shear_between(start, pose), shear)
    assert sensor_in_contact(start).shape == (4, 4)


@pytest.fixture
def folder(tmp_path):
    """A real set of two frames in the format that rigs write."""
    (tmp_path / "images").mkdir()
    for name in ("init_0.png", "images/frame_0.png", "images/frame_1.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((64, 64), np.uint8))
    columns = ["image_name", *(f"{k}_{i}" for k in ("pose", "move") for i in range(1, 7))]
    with (tmp_path / "targets.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for i in range(2):
            writer.writerow([f"frame_{i}.png", 0, -1 - i, 0, 0, 0, 7, 1, 0, 0, 0, 0, 2])
    (tmp_path / "meta.json").write_text(json.dumps({"tap_move": [0, 5, 0, 0, 0, 0]}))
    return tmp_path


@pytest.mark.parametrize("angles", ["vector", "xyz", "ZYX"])
def test_table_of_a_protocol_has_the_contacts_of_the_protocol(folder, angles):
    protocol = Protocol(frames=20, taps=2, angles=angles)
    (folder / "meta.json").unlink()
    (folder / "targets.csv").write_bytes(protocol_table(protocol))
    for k in range(20):
        cv2.imwrite(str(folder / "images" / f"frame_{k:04d}.png"), np.zeros((64, 64), np.uint8))
    real, motion = read_real_set(folder, angles), RigMotion(Rig())
    wanted = convert_labels(ColumnMap(angles=angles), read_table(folder / "targets.csv"))
    for k in range(20):
        for found, label in zip(motion.contact(real.poses[k], real.moves[k], real.tap), wanted, strict=True):
            assert np.allclose(found, from_mm_deg(label[k]), atol=1e-9)


def read_table(path):
    """Return the cells of a table's columns."""
    _, rows = parse_table(path.read_bytes(), str(path))
    return {name: [row[name] for row in rows] for name in rows[0]}


def test_read_real_set_returns_frames_and_commands(folder):
    real = read_real_set(folder)
    assert len(real.files) == 2
    assert np.allclose(real.poses[1], from_mm_deg([0, -2, 0, 0, 0, 7]))
    assert np.allclose(real.moves[0], from_mm_deg([1, 0, 0, 0, 0, 2]))
    assert np.allclose(real.tap, TAP)
    assert real.frame(1).shape == real.neutral.shape == (64, 64)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / "init_0.png").unlink(), "no neutral image"),
        (lambda f: (f / "targets.csv").unlink(), "does not exist"),
        (lambda f: (f / "meta.json").unlink(), "tap_move"),
        (lambda f: (f / "meta.json").write_text("{}"), "tap_move"),
        (lambda f: (f / "meta.json").write_text('{"tap_move": [0, 0, 0, 1, 0, 0]}'), "a translation"),
        (lambda f: (f / "meta.json").write_text('{"tap_move": [1e308, 5, 0, 0, 0, 0]}'), "at most 100 mm"),
        (lambda f: (f / "images/frame_1.png").unlink(), "the frame frame_1.png does not exist"),
        (lambda f: _replace(f / "targets.csv", "pose_3", "pose_x"), "no pose_3"),
        (lambda f: _replace(f / "targets.csv", "-2", "nan"), "not within"),
        (lambda f: _replace(f / "targets.csv", "-2", "1e300"), "not within"),
        (lambda f: _replace(f / "targets.csv", "-2", "deep"), "deep"),
        (lambda f: _replace(f / "targets.csv", "-2,0,0,0,7,1,0,0,0,0,2", "-2,0"), "row 2 ends before pose_4"),
        (lambda f: _replace(f / "targets.csv", "frame_1.png,0,-2,0,0,0,7,1,0,0,0,0,2", "frame_1.png"), "row 2 ends before"),
        (
            lambda f: (f / "targets.csv").write_bytes(b"image_name\nfr\xe4me.png\n"),
            r"targets.csv must be text in UTF-8 \(CSV\)",
        ),
        (lambda f: (f / "images/frame_1.png").write_bytes(b"no"), "cannot be read"),
        (
            lambda f: cv2.imwrite(str(f / "images/frame_1.png"), np.zeros((32, 64), np.uint8)),
            "64×64 px like the neutral image, got 64×32 px",
        ),
    ],
)
def test_read_real_set_damaged_is_refused(folder, spoil, words):
    spoil(folder)
    with pytest.raises(TactipError, match=words):
        read_real_set(folder).frame(1)


def test_read_real_set_missing_folder_is_refused(tmp_path):
    with pytest.raises(TactipError, match="is not a folder"):
        read_real_set(tmp_path / "none")


def _replace(path, old, new):
    path.write_text(path.read_text().replace(old, new))
