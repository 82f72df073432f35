"""Poses in the frame of a robot's base: found in a table, and read as labels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import LABELS
from tactip_twin.sim2real.importing.base_pose import find_base_pose, with_tool_columns
from tactip_twin.sim2real.importing.column_map import TOOL_COLUMNS, ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels, unused_columns
from tactip_twin.sim2real.importing.find_conventions import find_conventions
from tactip_twin.sim2real.importing.find_tool_offset import find_tool_offset
from tactip_twin.sim2real.importing.table_columns import with_lists_split
from tactip_twin.tactip_model.errors import TactipError

from .test_find_conventions import contacts_of

DOWN = Rotation.from_euler("x", 180, degrees=True)
WALL = Rotation.from_euler("y", 90, degrees=True)


def cells_of(columns):
    return {name: [f"{x:.9g}" for x in column] for name, column in columns.items()}


def in_base(poses, work, mount, form):
    """Return a table of poses (n, 6), mm and degrees, in the frame of a base.

    Args:
        poses: Poses relative to the work frame.
        work: Rotation of the work frame in the base's.
        mount: Rotation of the tool's frame in the sensor's.
        form: vector, quaternion, abb or rtde.
    """
    turns = work * Rotation.from_rotvec(poses[:, 3:], degrees=True) * mount
    places = work.apply(poses[:, :3]) + [412.3, -327.1, 123.4]
    quaternions, vectors = turns.as_quat(), turns.as_rotvec()
    if form == "quaternion":
        columns = {**dict(zip("xyz", places.T, strict=True)), **{f"q{c}": quaternions[:, k] for k, c in enumerate("xyzw")}}
    elif form == "abb":
        columns = {f"pos_{c}": places[:, k] for k, c in enumerate("xyz")}
        columns |= {f"q{1 + k}": quaternions[:, (k - 1) % 4] for k in range(4)}
    elif form == "rtde":
        joints = np.random.default_rng(0).normal(1.5, 0.2, (6, len(poses)))
        both = np.concatenate([1e-3 * places, vectors], 1)
        columns = {f"actual_q_{k}": joints[k] for k in range(6)} | {f"actual_TCP_pose_{k}": both[:, k] for k in range(6)}
    else:
        columns = {f"TCP {c} [mm]": places[:, k] for k, c in enumerate("xyz")}
        columns |= {f"TCP r{c} [deg]": np.degrees(vectors[:, k]) for k, c in enumerate("xyz")}
    return cells_of(columns)


@pytest.mark.parametrize("form", ["vector", "quaternion", "abb", "rtde"])
@pytest.mark.parametrize("mounted", ["down", "wall", "turned"])
@pytest.mark.parametrize("task", ["surface", "edge"])
def test_labels_of_poses_in_the_base_frame_are_those_of_the_truth(task, mounted, form):
    rng = np.random.default_rng(5)
    poses, _, contacts = contacts_of(task, rng)
    work, mount = {
        "down": (Rotation.from_euler("z", 30, degrees=True), DOWN),
        "wall": (Rotation.from_euler("z", 90, degrees=True) * WALL * Rotation.from_euler("z", 20, degrees=True), DOWN),
        "turned": (Rotation.from_euler("z", -65, degrees=True), DOWN * Rotation.from_euler("z", 130, degrees=True)),
    }[mounted]
    table = in_base(poses, work, mount, form)
    base_pose = find_base_pose(table)
    assert len(base_pose) == (7 if form in ("quaternion", "abb") else 6)
    given = ColumnMap(task=task, base_pose=base_pose, angles="vector")
    table = with_tool_columns(table, given)
    labels, _ = convert_labels(find_conventions(table, contacts, given).column_map, table)
    for part in (2, 3, 4) if task == "surface" else (0, 2, 3, 4):
        assert np.corrcoef(labels[:, part], poses[:, part])[0, 1] > 0.98
        assert np.polyfit(poses[:, part], labels[:, part], 1)[0] == pytest.approx(1.0, abs=0.1)
        assert abs(np.mean(labels[:, part] - poses[:, part])) < (1.5 if part == 2 else 0.6)


def test_offset_across_an_edge_along_no_axis_has_its_length():
    """Euler angles, so the table's columns are read as they are."""
    rng = np.random.default_rng(6)
    poses, _, contacts = contacts_of("edge", rng)
    table = cells_of({
        "x": 300 + poses[:, 0] * np.cos(0.5), "y": 300 + poses[:, 0] * np.sin(0.5), "z": poses[:, 2], "yaw": poses[:, 5]
    })  # fmt: skip
    labels, _ = convert_labels(find_conventions(table, contacts, ColumnMap(task="edge")).column_map, table)
    assert np.polyfit(poses[:, 0], labels[:, 0], 1)[0] == pytest.approx(1.0, abs=1e-3)
    assert abs(np.mean(labels[:, 0] - poses[:, 0])) < 0.2


def test_euler_angles_of_a_tool_that_points_down_are_found():
    rng = np.random.default_rng(7)
    poses, _, contacts = contacts_of("surface", rng)
    about_x = (poses[:, 3] + 360) % 360 - 180
    table = cells_of({"x": 0 * about_x + 412, "z": poses[:, 2], "A": about_x, "B": poses[:, 4], "C": 0 * about_x + 30})
    column_map = find_conventions(table, contacts, ColumnMap()).column_map
    assert any(spec.endswith("A-180") for spec in column_map.columns)
    labels, _ = convert_labels(column_map, table)
    for part in (3, 4):
        assert np.corrcoef(labels[:, part], poses[:, part])[0, 1] > 0.98


def test_angles_against_a_base_are_read_in_their_convention():
    rng = np.random.default_rng(8)
    poses, *_ = contacts_of("surface", rng)
    turns = Rotation.from_rotvec(poses[:, 3:], degrees=True)
    euler = (turns * DOWN).as_euler("ZYX", degrees=True)
    table = cells_of(dict(zip(("x", "y", "z", "A", "B", "C"), np.concatenate([poses[:, :3], euler], 1).T, strict=True)))
    assert find_base_pose(table) == ()
    found = with_tool_columns(table, ColumnMap(base_pose=tuple(table), angles="ZYX"))
    expected = (DOWN.inv() * turns * DOWN).as_rotvec(degrees=True)
    assert np.allclose(np.array([found[name] for name in TOOL_COLUMNS[3:]], float).T, expected, atol=1e-4)


@pytest.mark.parametrize("angles", ["vector", "xyz"])
def test_labels_relative_to_a_surface_are_no_base_pose(angles):
    rng = np.random.default_rng(9)
    poses, *_ = contacts_of("edge", rng)
    turns = Rotation.from_euler("z", 90, degrees=True) * Rotation.from_rotvec(poses[:, 3:], degrees=True)
    parts = turns.as_rotvec(degrees=True) if angles == "vector" else turns.as_euler(angles, degrees=True)
    numbers = np.concatenate([poses[:, :3], parts], 1).T
    for names in (("x", "y", "z", "rx", "ry", "rz"), [f"pose_{k}" for k in range(1, 7)]):
        assert find_base_pose(cells_of(dict(zip(names, numbers, strict=True)))) == ()


def test_rows_without_a_pose_stay():
    rng = np.random.default_rng(10)
    poses, *_ = contacts_of("surface", rng)
    table = in_base(poses, Rotation.identity(), DOWN, "quaternion")
    table["qx"][3] = ""
    found = with_tool_columns(table, ColumnMap(base_pose=find_base_pose(table)))
    assert [found[name][3] for name in TOOL_COLUMNS] == ["nan"] * 6
    assert np.isfinite(np.delete(np.array(found["tool_Rx"], float), 3)).all()


def test_what_is_no_pose_is_refused():
    rng = np.random.default_rng(11)
    poses, *_ = contacts_of("surface", rng)
    table = in_base(poses, Rotation.identity(), DOWN, "quaternion")
    pose = find_base_pose(table)
    with pytest.raises(TactipError, match=r"no column qq \(--base-pose\)"):
        with_tool_columns(table, ColumnMap(base_pose=(*pose[:-1], "qq")))
    with pytest.raises(TactipError, match="length of a quaternion must be 1, got 5"):
        with_tool_columns(table, ColumnMap(base_pose=("qx", "qy", "qz", *pose[:3], "qw")))
    with pytest.raises(TactipError, match=r"quaternion qx, qy, qz, qw must stand beside a position"):
        find_base_pose({name: cells for name, cells in table.items() if name != "y"})
    unclear = {name.replace("q", "rot_").translate(str.maketrans("wxyz", "1234")): table[name] for name in pose[3:]}
    with pytest.raises(TactipError, match="order of the quaternion rot_1, rot_2, rot_3, rot_4 must be known"):
        find_base_pose(unclear | {name: table[name] for name in "xyz"})
    with pytest.raises(TactipError, match="number of columns of base_pose must be 6 or 7, got 3"):
        ColumnMap(base_pose=("x", "y", "z"))
    with pytest.raises(TactipError, match="tool_offset_mm must be 0 0 0 without base_pose"):
        ColumnMap(tool_offset_mm=(0, 0, 150))
    empty = {name: [""] * 3 for name in pose}
    with pytest.raises(TactipError, match="no row of the table has numbers"):
        with_tool_columns(empty, ColumnMap(base_pose=pose))


def test_lists_of_numbers_become_columns():
    table = {
        "frame": ["a.png", "b.png", "c.png"],
        "pose": ["[1.5, 2, -3e-1]", "[4. 5. 6.]", ""],
        "at": ["(1)", "(2)", "(3)"],
    }
    expected = {"pose_1": ["1.5", "4.", ""], "pose_2": ["2", "5.", ""], "pose_3": ["-3e-1", "6.", ""]}
    assert with_lists_split(table) == {"frame": table["frame"], **expected, "at": table["at"]}
    longer = with_lists_split({"pose": [*table["pose"][:2], "[7, 8, 9, 10]"]})
    assert longer["pose_2"] == ["2", "5.", ""] and len(longer) == 3
    assert with_lists_split(table | {"pose_1": ["0", "0", "0"]})["pose"] == table["pose"]


def test_columns_of_a_base_pose_are_no_labels_by_their_names():
    rng = np.random.default_rng(14)
    poses, *_ = contacts_of("surface", rng)
    work = Rotation.from_euler("z", 50, degrees=True)
    turns = (work * Rotation.from_rotvec(poses[:, 3:], degrees=True) * DOWN).as_rotvec()
    numbers = np.concatenate([work.apply(poses[:, :3]) + [412, -57, 123], turns], 1).T
    table = cells_of(dict(zip(LABELS, numbers, strict=True)))
    columns = ("pose_z=-tool_z-123", "pose_Rx=tool_Rx", "pose_Ry=-tool_Ry")
    given = ColumnMap(base_pose=find_base_pose(table), columns=columns)
    assert given.base_pose == LABELS
    labels, _ = convert_labels(given, with_tool_columns(table, given))
    assert np.abs(labels[:, 5]).max() == 0
    assert unused_columns(given, with_tool_columns(table, given)) == ["tool_Rz"]


@pytest.mark.parametrize("across_mm", [(0, 0), (12, -7)])
def test_offset_of_the_apex_from_a_flange_is_found(across_mm):
    rng = np.random.default_rng(12)
    poses, _, contacts = contacts_of("surface", rng, gain=1.0, noise=0.3)
    offset = np.array([*across_mm, 140.0])
    work = Rotation.from_euler("z", 30, degrees=True)
    flanges = poses.copy()
    flanges[:, :3] -= Rotation.from_rotvec(poses[:, 3:], degrees=True).apply(DOWN.apply(offset))
    table = in_base(flanges, work, DOWN, "quaternion")
    found, told = find_tool_offset(table, contacts, ColumnMap(base_pose=find_base_pose(table)))
    assert np.allclose(found.tool_offset_mm, offset, atol=[1, 1, 5])
    assert told[0].startswith("tool-offset-mm")
    table = with_tool_columns(table, found)
    labels, _ = convert_labels(find_conventions(table, contacts, replace(found, angles="vector")).column_map, table)
    errors = labels[:, 2] - poses[:, 2]
    assert np.abs(errors - np.median(errors)).mean() < 0.1 and abs(np.median(errors)) < 0.5


def test_poses_of_the_apex_have_no_offset():
    rng = np.random.default_rng(13)
    for task in ("surface", "edge"):
        poses, _, contacts = contacts_of(task, rng)
        table = in_base(poses, WALL, DOWN, "vector")
        given = ColumnMap(task=task, base_pose=find_base_pose(table))
        assert find_tool_offset(table, contacts, given) == (given, [])
