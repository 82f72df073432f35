"""Poses of a recording: within their ranges, reproducible, and read by the import as they were written."""

import csv
import io

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.limits import exceeds_max_tilt
from tactip_twin.sim.dataset.sampling import POSE_RANGES, Ranges
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.protocol import STARTS, Protocol, protocol_table
from tactip_twin.tactip_model.errors import TactipError


def columns_of(data):
    rows = list(csv.DictReader(io.StringIO(data.decode())))
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.parametrize("angles", ["vector", "xyz", "ZYX"])
@pytest.mark.parametrize("task", ["surface", "edge"])
def test_import_reads_the_poses_that_were_commanded(task, angles):
    protocol = Protocol(pose=POSE_RANGES[task], angles=angles)
    table = columns_of(protocol_table(protocol))
    poses, _ = protocol.contacts()
    assert len(set(table["image_name"])) == protocol.frames
    labels, moves = convert_labels(ColumnMap(task=task, angles=angles), table)
    parts = [2, 3, 4] if task == "surface" else [0, 2, 3, 4, 5]
    assert np.allclose(labels[:, parts], poses[:, parts], atol=2e-3)
    upright = np.abs(poses[:, 3:]).max(1) == 0
    assert upright.sum() == protocol.taps and np.abs(moves[upright]).max() < 1e-9
    starts, ends, shifts = (np.array([[float(x) for x in table[n]] for n in names]) for names in (STARTS, LABELS, SHEARS))
    assert np.allclose(starts, ends - shifts, atol=2e-3)


def test_contacts_fill_their_ranges_and_are_not_too_steep():
    protocol = Protocol(frames=500, taps=10, pose=Ranges(depth_mm=(-4, -1), roll_deg=(-25, 25), pitch_deg=(-20, 20)))
    poses, shears = protocol.contacts()
    low, high = protocol.pose.bounds().T
    assert (poses >= low - 1e-9).all() and (poses <= high + 1e-9).all()
    assert np.allclose(poses[:10, 2], np.linspace(-1, -4, 10))
    assert poses[10:, 2].min() < -3.9 and np.abs(poses[:, 3]).max() > 20
    assert not any(exceeds_max_tilt(from_mm_deg(p), from_mm_deg(s)) for p, s in zip(poses, shears, strict=True))


def test_command_writes_the_same_table_for_a_seed_and_overwrites_none(tmp_path, capsys):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert tactip.main(["protocol", "--out", str(tmp_path / name / "targets.csv"), "--seed", str(seed)]) == 0
    a, b, c = ((tmp_path / name / "targets.csv").read_bytes() for name in "abc")
    assert a == b != c
    assert "300 contacts" in capsys.readouterr().out
    assert tactip.main(["protocol", "--out", str(tmp_path / "a" / "targets.csv")]) == 1
    assert "exists and is not overwritten" in capsys.readouterr().err
    edge = tmp_path / "edge.csv"
    assert tactip.main(["protocol", "--out", str(edge), "--task", "edge", "--frames", "60"]) == 0
    yaws = np.array([float(x) for x in columns_of(edge.read_bytes())["pose_Rz"]])
    assert yaws.min() < -30 and yaws.max() > 30


def test_impossible_protocols_give_one_sentence():
    with pytest.raises(TactipError, match="taps must be at most 30, the number of frames"):
        Protocol(frames=30, taps=40)
    with pytest.raises(TactipError, match=r"pose\.depth_mm must be at most 0"):
        Protocol(pose=Ranges(depth_mm=(-1, 1)))
