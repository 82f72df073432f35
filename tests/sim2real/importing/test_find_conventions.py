"""Conventions of a table: found from estimates that are noisy and a third too small, refused where they do not tell."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.benchmarks.learning.conventions import TAP_MM, mislabel_table
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim2real.importing import find_on_edge, find_on_surface
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.estimated_contacts import EstimatedContacts
from tactip_twin.sim2real.importing.find_angles import angles_and_lever
from tactip_twin.sim2real.importing.find_conventions import find_conventions, tap_of
from tactip_twin.sim2real.importing.table_columns import complete_rows
from tactip_twin.tactip_model.errors import TactipError

COUNT = 120


def contacts_of(task, rng, gain=0.7, noise=1.0):
    """Return true poses and shears (COUNT, 6), and estimates of them with errors as those of another tip's mechanics."""
    poses, shears = (
        to_mm_deg(np.array([ranges.sample(rng) for _ in range(COUNT)])) for ranges in (POSE_RANGES[task], SHEAR_RANGES)
    )
    spread = noise * np.array([0.5, 0, 0.3, 2.0, 2.0, 3.0 if task == "edge" else 0.0])
    estimated = poses * [1, 1, gain, gain, gain, 1] + rng.normal(0, 1, poses.shape) * spread
    shown = 0.5 * shears + rng.normal(0, noise, shears.shape)
    deviations = np.full((COUNT, 6), 2.0)
    nothing = np.zeros((COUNT, 1, 2))
    return poses, shears, EstimatedContacts(
        np.arange(COUNT), estimated, deviations, shown, np.ones(COUNT), nothing[0], nothing, nothing
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("task", ["surface", "edge"])
def test_labels_are_those_of_the_truth(task, seed):
    rng = np.random.default_rng(seed)
    poses, shears, contacts = contacts_of(task, rng)
    table, before_tap = mislabel_table(poses, shears, task, rng)
    found = find_conventions(table, contacts, ColumnMap(task=task), TAP_MM if before_tap else None)
    labels, _ = convert_labels(found.column_map, table)
    parts = [2, 3, 4] if task == "surface" else [0, 2, 3, 4]
    for part in parts:
        assert np.corrcoef(labels[:, part], poses[:, part])[0, 1] > 0.98
        assert np.polyfit(poses[:, part], labels[:, part], 1)[0] == pytest.approx(1.0, abs=0.1)
    assert np.abs(labels[:, 2] - poses[:, 2]).mean() < 2.0


def test_offset_that_shows_as_tilt_is_no_tilt():
    """A table without tilts: a tip beside an edge looks a little tilted, in proportion to its offset."""
    rng = np.random.default_rng(3)
    poses, _, contacts = contacts_of("edge", rng, noise=0.1)
    contacts.poses[:, 3], contacts.poses[:, 4] = rng.normal(0, 0.3, COUNT), 0.4 * poses[:, 0] + rng.normal(0, 0.3, COUNT)
    table = {"across": poses[:, 0], "depth": poses[:, 2], "turn": poses[:, 5]}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in table.items()}
    assert find_conventions(cells, contacts, ColumnMap(task="edge")).column_map.columns == (
        "pose_z=depth",
        "pose_Rz=turn",
        "pose_x=across",
    )


def test_evidence_names_every_choice():
    rng = np.random.default_rng(1)
    poses, shears, contacts = contacts_of("surface", rng)
    table, before_tap = mislabel_table(poses, shears, "surface", rng)
    found = find_conventions(table, contacts, ColumnMap(), TAP_MM if before_tap else None)
    told = "\n".join(found.evidence)
    for spec in found.column_map.columns:
        assert spec in told or spec.startswith("shear_R")
    assert "camera-rotation-deg" in told and "tcp-behind-apex-mm" in told and "angles" in told


@pytest.mark.parametrize(("margin", "text"), [(3, "20 times"), (13, "442,413 times"), (800, "more than a million times")])
def test_evidence_says_by_how_much_another_reading_is_less_likely(margin, text):
    assert find_on_surface._times(margin) == text


@pytest.mark.parametrize("task", ["surface", "edge"])
def test_trace_of_the_shear_in_another_column_is_not_taken_for_it(task):
    """On a tilted table a shear has a small height, which may follow an estimate better than the shear itself."""
    rng = np.random.default_rng(1)
    poses, shears, contacts = contacts_of(task, rng)
    table = {f"pose_{name}": poses[:, k] for k, name in enumerate(("x", "y", "z", "Rx", "Ry", "Rz"))}
    table |= {"shear_x": shears[:, 0], "shear_y": shears[:, 1], "shear_z": -0.03 * contacts.shears[:, 0]}
    table["shear_Rz"] = shears[:, 5]
    cells = {name: [repr(float(value)) for value in column] for name, column in table.items()}
    columns = find_conventions(cells, contacts, ColumnMap(task=task), None).column_map.columns
    assert "shear_x=shear_x" in columns and "shear_z" not in " ".join(columns)


@pytest.mark.parametrize(("name", "gain", "noise"), [("c", 0.2, 1.0), ("shear_Rz", 0.6, 2.5)])
def test_trace_of_the_twist_in_the_tilt_is_not_taken_for_a_tilt(name, gain, noise):
    """A skin of other mechanics than expected shows a twist at an edge as a tilt, too. Names help where that is large."""
    rng = np.random.default_rng(4)
    poses, shears, contacts = contacts_of("edge", rng)
    tilted = contacts.poses.copy()
    tilted[:, 3] = rng.normal(0, noise, COUNT)
    tilted[:, 4] = gain * shears[:, 5] + rng.normal(0, noise, COUNT)
    contacts = replace(contacts, poses=tilted)
    table = {"depth": poses[:, 2], "yaw": poses[:, 5], "across": poses[:, 0], name: shears[:, 5]}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in table.items()}
    columns = find_conventions(cells, contacts, ColumnMap(task="edge")).column_map.columns
    assert not any(spec.startswith(("pose_Rx", "pose_Ry")) for spec in columns)


def test_tilts_are_found_in_a_table_all_of_whose_columns_are_named_as_moves():
    rng = np.random.default_rng(4)
    poses, _, contacts = contacts_of("edge", rng, noise=2.5)
    cells = {f"move_{k + 1}": [f"{x:.6g}" for x in poses[:, k]] for k in range(6)}
    columns = find_conventions(cells, contacts, ColumnMap(task="edge")).column_map.columns
    assert {"pose_Rx=move_4", "pose_Ry=move_5", "pose_Rz=move_6"} <= set(columns)


def test_tilts_are_found_where_their_directions_do_not_look_square():
    """Frames that show one tilt as a part of the other, as where the yaw comes between them."""
    rng = np.random.default_rng(4)
    poses, _, contacts = contacts_of("edge", rng)
    skewed = contacts.poses.copy()
    skewed[:, 3] += 0.8 * skewed[:, 4]
    cells = {f"pose_{k + 1}": [f"{x:.6g}" for x in poses[:, k]] for k in range(6)}
    columns = find_conventions(cells, replace(contacts, poses=skewed), ColumnMap(task="edge")).column_map.columns
    rotations = {spec.partition("=")[2] for spec in columns if spec.startswith("pose_R")}
    assert rotations == {"pose_4", "pose_5", "pose_6"}


def test_other_columns_that_follow_the_depth_are_not_taken_for_it():
    """Forces, times and depths in other units follow it as well as the depth does."""
    rng = np.random.default_rng(5)
    poses, shears, contacts = contacts_of("surface", rng)
    depth = contacts.poses[:, 2]
    truth = {"Z_mm": poses[:, 2], "a": poses[:, 3], "b": poses[:, 4], "dx": shears[:, 0], "dy": shears[:, 1]}
    others = {"Fz": -depth, "time_s": np.argsort(np.argsort(depth)) * 1.0, "microns": 1e3 * depth}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in (others | truth).items()}
    found = find_conventions(cells, contacts, ColumnMap())
    assert found.column_map.columns[0].startswith("pose_z=Z_mm")
    del cells["Z_mm"]
    with pytest.raises(TactipError, match="no column explains the depth that the frames show, in mm or m"):
        find_conventions(cells, contacts, ColumnMap())


def test_rotation_of_a_shear_is_not_taken_from_a_displacement():
    rng = np.random.default_rng(6)
    poses, shears, contacts = contacts_of("surface", rng)
    truth = {"pose_z": poses[:, 2], "pose_Ry": poses[:, 4], "shear_x": shears[:, 0], "shear_y": rng.normal(0, 1, COUNT)}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in truth.items()}
    found = find_conventions(cells, contacts, ColumnMap())
    assert not any(spec.startswith("shear_R") for spec in found.column_map.columns)
    assert "shear_y: by their names alone, as the frames do not show them" in found.evidence
    cells["shear_Ry"] = [f"{x:.6g}" for x in shears[:, 4]]
    assert "shear_Ry=shear_Ry: by its name alone" in find_conventions(cells, contacts, ColumnMap()).evidence


def test_angles_from_0_to_360_are_found():
    rng = np.random.default_rng(8)
    poses, shears, contacts = contacts_of("surface", rng)
    columns = {"z": poses[:, 2], "rx": poses[:, 3] % 360, "ry": poses[:, 4] % 360, "dx": shears[:, 0], "dy": shears[:, 1]}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in columns.items()}
    found = find_conventions(cells, contacts, ColumnMap())
    labels, _ = convert_labels(found.column_map, cells)
    for part in (3, 4):
        assert np.corrcoef(labels[:, part], poses[:, part])[0, 1] > 0.98


def test_rows_with_an_empty_cell_are_left_out_of_the_search():
    numbers = [str(k) for k in range(10)]
    table = {"z": [*numbers[:8], "", "9"], "note": ["", "1", *8 * [""]], "rx": [*numbers[:9], "nan"], "name": 10 * ["a"]}
    assert complete_rows(table).tolist() == [*8 * [True], False, False]


def test_columns_that_explain_nothing_are_refused():
    rng = np.random.default_rng(2)
    _, _, contacts = contacts_of("surface", rng)
    table = {"lamp": [str(x) for x in rng.normal(0, 1, COUNT)]}
    with pytest.raises(TactipError, match="no column explains the depth"):
        find_conventions(table, contacts, ColumnMap())
    with pytest.raises(TactipError, match="no column of numbers"):
        find_conventions({"name": ["a"] * COUNT}, contacts, ColumnMap())


def test_few_noisy_frames_are_refused_with_both_readings():
    rng = np.random.default_rng(3)
    few = 20
    basis = np.concatenate([np.ones((few, 1)), rng.normal(0, 1, (few, 4))], 1)
    depth, tilt, shear, noise = np.linalg.qr(basis)[0].T[1:]  # without means, uncorrelated
    estimated = np.zeros((few, 6))
    estimated[:, 2], estimated[:, 4] = -3 + 4 * depth, 20 * tilt
    shown = np.zeros((few, 6))
    shown[:, 0] = 4 * (0.41 * shear + 0.91 * noise)
    nothing = np.zeros((few, 1, 2))
    contacts = EstimatedContacts(
        np.arange(few), estimated, np.ones((few, 6)), shown, np.ones(few), nothing[0], nothing, nothing
    )
    cells = {name: [f"{x:.6g}" for x in column] for name, column in {"z": depth, "b": 20 * tilt, "d": shear}.items()}
    with pytest.raises(TactipError, match="equally well for two readings of the table: pose_Ry=b shear_x=d"):
        find_conventions(cells, contacts, ColumnMap())
    shown[:, 0] = 4 * (0.95 * shear + 0.3 * noise)
    assert "shear_x=d" in find_conventions(cells, contacts, ColumnMap()).column_map.columns


def test_given_columns_are_kept_and_checked():
    rng = np.random.default_rng(4)
    poses, _, contacts = contacts_of("surface", rng)
    table = {"depth": -poses[:, 2], "roll": poses[:, 3], "pitch": poses[:, 4]}
    cells = {name: [f"{x:.6g}" for x in column] for name, column in table.items()}
    found = find_conventions(cells, contacts, ColumnMap(columns=("pose_Rx=roll",)))
    assert "pose_Rx=roll" in found.column_map.columns and "pose_z=-depth" in found.column_map.columns
    with pytest.raises(TactipError, match="contradicts the frames, which say pose_z=-depth"):
        find_conventions(cells, contacts, ColumnMap(columns=("pose_z=depth",)))
    with pytest.raises(TactipError, match="pose_Rx=depth contradicts the frames, whose pose follows"):
        find_conventions(cells, contacts, ColumnMap(columns=("pose_Rx=depth",)))


def _edge_table(angles, rng):
    """Return true poses, their estimates, and a table whose rotations are Euler angles or a vector, in usual columns."""
    poses, shears, contacts = contacts_of("edge", rng)
    rotations = Rotation.from_rotvec(poses[:, 3:], degrees=True)
    commands = poses.copy()
    commands[:, 3:] = rotations.as_rotvec(degrees=True) if angles == "vector" else rotations.as_euler(angles, degrees=True)
    columns = {f"pose_{k + 1}": commands[:, k] for k in range(6)} | {f"move_{k + 1}": shears[:, k] for k in range(6)}
    return poses, contacts, {name: [f"{x:.8g}" for x in values] for name, values in columns.items()}


def test_ambiguous_angles_of_an_edge_are_found_where_they_are_given(monkeypatch):
    """Every reading fits as well if no evidence suffices: the message names the option that resolves it."""
    monkeypatch.setattr(find_on_edge, "MIN_EVIDENCE", 1e9)
    monkeypatch.setattr(find_on_edge, "plainness", lambda *reading: (0, 0, 0.0))
    _, contacts, cells = _edge_table("vector", np.random.default_rng(5))
    with pytest.raises(TactipError, match=r"equally well for two readings .* with --angles .*: give --angles, and the rest"):
        find_conventions(cells, contacts, ColumnMap(task="edge"))


@pytest.mark.parametrize("angles", ["vector", "zyx", "ZYX"])
def test_given_angles_are_kept_and_checked(angles):
    poses, contacts, cells = _edge_table(angles, np.random.default_rng(6))
    for column_map in (ColumnMap(task="edge"), ColumnMap(task="edge", angles=angles)):
        found = find_conventions(cells, contacts, column_map)
        assert column_map.angles in ("auto", found.column_map.angles)
        labels, _ = convert_labels(found.column_map, cells)
        wrong = Rotation.from_rotvec(labels[:, 3:], degrees=True).inv() * Rotation.from_rotvec(poses[:, 3:], degrees=True)
        assert np.degrees(wrong.magnitude()).mean() < 2
    other = {"vector": "XYZ", "zyx": "xyz", "ZYX": "zyx"}[angles]
    with pytest.raises(TactipError, match=f"angles {other} contradict the frames, which say angles"):
        find_conventions(cells, contacts, ColumnMap(task="edge", angles=other))


def test_given_columns_of_euler_angles_are_listed_in_their_order():
    """With angles zyx, pose_Rx is the first of the three: the rotation about z."""
    _, contacts, cells = _edge_table("zyx", np.random.default_rng(6))
    given = ColumnMap(task="edge", angles="zyx", columns=("pose_Rz=pose_6",))
    assert {"pose_Rx=pose_4", "pose_Rz=pose_6"} <= set(find_conventions(cells, contacts, given).column_map.columns)
    with pytest.raises(TactipError, match="contradict the frames"):
        find_conventions(cells, contacts, ColumnMap(task="edge", angles="zyx", columns=("pose_Rz=-pose_6",)))


@pytest.mark.parametrize(("touching", "expected"), [(False, "pose_z=-depth+2"), (True, "pose_z=-depth")])
def test_zero_of_depth_is_not_changed_where_frames_at_rest_touch(touching, expected):
    """Without a neutral image, frames are compared with a frame that is pressed itself: here, by 2 mm."""
    rng = np.random.default_rng(3)
    poses, shears, contacts = contacts_of("surface", rng, gain=1.0)
    contacts = replace(contacts, poses=contacts.poses + [0, 0, 2.0, 0, 0, 0], touching_at_rest=touching)
    table = {"depth": -poses[:, 2], "roll": poses[:, 3], "pitch": poses[:, 4], "x_mm": shears[:, 0], "y_mm": shears[:, 1]}
    cells = {name: [repr(float(value)) for value in column] for name, column in table.items()}
    (spec, *_), evidence = (found := find_conventions(cells, contacts, ColumnMap())).column_map.columns, found.evidence
    assert spec.startswith(expected) and (spec == expected) == touching
    assert ("no neutral image shows it" in evidence[0]) == touching


def test_tap_is_read_from_meta_and_nonsense_is_not(tmp_path):
    assert tap_of(tmp_path, print) is None
    (tmp_path / "meta.json").write_text('{"tap_move": [0, 3, 4, 0, 0, 0]}')
    assert tap_of(tmp_path, print) == pytest.approx(5.0)
    for tap in ('"deep"', "[0, 0]", "[0, 0, 1e9]", "[0, 5, 1e308]"):
        (tmp_path / "meta.json").write_text(f'{{"tap_move": {tap}}}')
        assert tap_of(tmp_path, print) is None
    (tmp_path / "meta.json").write_text("[1, 2]")
    assert tap_of(tmp_path, print) is None
    (tmp_path / "meta.json").write_text('{"tap_move": [0, 3, 4], "limit": Infinity}')
    told = []
    assert tap_of(tmp_path, told.append) is None
    assert "the tap is not known" in told[0] and "the number inf" in told[0]


COLUMNS = ("pose_z=pose_z", "pose_Rx=pose_Rx", "pose_Ry=pose_Ry")


def tilted(rng, true):
    """Return a table of a rig with a tool centre, and contacts estimated from its frames, a third too shallow."""
    columns = [rng.uniform(low, high, COUNT) for low, high in ((-5, -1), (-20, 20), (-20, 20))]
    table = {
        name: [f"{x:.6f}" for x in values] for name, values in zip(("pose_z", "pose_Rx", "pose_Ry"), columns, strict=True)
    }
    _, _, contacts = contacts_of("surface", rng)
    poses = convert_labels(true, table)[0]
    poses[:, 2] = 0.7 * poses[:, 2] + rng.normal(0, 0.05, COUNT)
    return table, replace(contacts, poses=poses)


@pytest.mark.parametrize("lever", [(20.0, 0.0, 0.0), (0.0, 1.0, -0.6), (20.0, -1.0, 0.0), (0.0, 0.0, 0.0)])
def test_tool_centre_is_found(lever):
    true = ColumnMap(tcp_behind_apex_mm=lever[0], tcp_beside_axis_mm=lever[1:])
    table, contacts = tilted(np.random.default_rng(0), true)
    found, (_, evidence) = angles_and_lever(table, contacts, ColumnMap(columns=COLUMNS))
    assert found.tcp_behind_apex_mm == pytest.approx(lever[0], abs=2.0)
    assert found.tcp_beside_axis_mm == pytest.approx(lever[1:], abs=0.2)
    assert [value == 0 for value in (found.tcp_behind_apex_mm, *found.tcp_beside_axis_mm)] == [value == 0 for value in lever]
    assert evidence.startswith("tcp-behind-apex-mm") and ("not show another" in evidence) == (not any(lever))


@pytest.mark.parametrize(("beside_mm", "expected_mm"), [(3.0, 3.0), (1.2, 0.0)])
def test_tool_centre_near_the_axis_is_not_sought_on_an_edge(beside_mm, expected_mm):
    """There, another stiffness looks like one about a millimetre beside the axis."""
    table, contacts = tilted(np.random.default_rng(0), ColumnMap(task="edge", tcp_beside_axis_mm=(beside_mm, 0.0)))
    found, _ = angles_and_lever(table, contacts, ColumnMap(task="edge", columns=COLUMNS))
    assert found.tcp_beside_axis_mm == pytest.approx((expected_mm, 0.0), abs=0.2)


def test_tool_centre_that_is_given_is_kept():
    """A distance behind the apex that the user gives is kept, and the position beside the axis is found with it."""
    true = ColumnMap(tcp_behind_apex_mm=20.0, tcp_beside_axis_mm=(0.0, 1.0))
    table, contacts = tilted(np.random.default_rng(0), true)
    found, _ = angles_and_lever(table, contacts, ColumnMap(columns=COLUMNS, tcp_behind_apex_mm=19.0))
    assert found.tcp_behind_apex_mm == 19.0
    assert found.tcp_beside_axis_mm == pytest.approx((0.0, 1.0), abs=0.2)


def test_no_tool_centre_is_sought_at_one_depth():
    table, contacts = tilted(np.random.default_rng(0), ColumnMap(tcp_beside_axis_mm=(0.0, 1.0)))
    table["pose_z"] = ["-3"] * COUNT
    found, evidence = angles_and_lever(table, contacts, ColumnMap(columns=COLUMNS))
    assert found.tcp_beside_axis_mm == (0.0, 0.0) and "the depth hardly varies" in evidence[-1]
