"""Other laboratories' conventions, compared with a rig that is computed independently."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import from_mm_deg, to_mm_deg
from tactip_twin.sim2real.calibration.rig import Rig, RigMotion
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels, image_column, unused_columns
from tactip_twin.sim2real.importing.layout import Layout, read_layout
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError


def table_of(**columns):
    return {name: [f"{x:.9f}" for x in np.atleast_1d(values)] for name, values in columns.items()}


def test_convert_labels_press_along_y_equals_rig():
    """The published planar sets: depth before a tap of 5 mm along y, one tilt about z, shears of both."""
    rng = np.random.default_rng(0)
    depth, tilt, shear, turn = (rng.uniform(low, high, 20) for low, high in ((-4, 0), (-20, 20), (-5, 5), (-5, 5)))
    column_map = ColumnMap(
        columns=("pose_z=-pose_2-5", "pose_Ry=pose_6", "shear_x=move_1", "shear_Ry=move_6"),
        camera_rotation_deg=-75.0,
        tcp_behind_apex_mm=12.0,
    )
    poses, shears = convert_labels(column_map, table_of(pose_2=depth, pose_6=tilt, move_1=shear, move_6=turn))
    motion = RigMotion(Rig(press_axis=(0.0, 1.0, 0.0), azimuth_deg=-75.0, tcp_behind_apex_m=12e-3))
    zero = np.zeros(20)
    commands = from_mm_deg(np.stack([zero, depth, zero, zero, zero, tilt], -1))
    moves = from_mm_deg(np.stack([shear, zero, zero, zero, zero, turn], -1))
    for k in range(20):
        pose, slid = motion.contact(commands[k], moves[k], from_mm_deg([0, 5, 0, 0, 0, 0]))
        assert np.allclose(poses[k], to_mm_deg(pose), atol=1e-6)
        assert np.allclose(shears[k], to_mm_deg(slid), atol=1e-6)


def test_tool_centre_beside_the_axis_changes_depth_with_tilt():
    """A turn by a about x lowers an apex that lies at -y from the tool centre by -y sin a, and about y by x sin b."""
    tilts = np.linspace(-20, 20, 9)
    sines = np.sin(np.radians(tilts))
    column_map = ColumnMap(tcp_beside_axis_mm=(0.6, -0.8))
    roll, _ = convert_labels(column_map, table_of(pose_z=np.full(9, -3.0), pose_Rx=tilts))
    pitch, _ = convert_labels(column_map, table_of(pose_z=np.full(9, -3.0), pose_Ry=tilts))
    assert np.allclose(roll[:, 2], -3 + 0.8 * sines, atol=1e-6)
    assert np.allclose(pitch[:, 2], -3 + 0.6 * sines, atol=1e-6)
    assert np.allclose(roll[:, 3], tilts, atol=1e-6) and np.allclose(pitch[:, 4], tilts, atol=1e-6)


def test_convert_labels_own_names_need_no_map():
    poses, shears = convert_labels(ColumnMap(), table_of(pose_z=-3, pose_Rx=7, pose_Ry=-2, shear_x=1.5, shear_Rz=4))
    assert np.allclose(poses, [[0, 0, -3, 7, -2, 0]])
    # A rotation about the normal rotates the tilt, too: the columns give the motion and the pose at its end.
    assert np.allclose(shears[0, :3], [1.5, 0, 0])
    assert np.isclose(np.linalg.norm(shears[0, 3:]), 4, atol=0.1)


def test_convert_labels_edge_keeps_its_axes():
    """With a rotated camera the edge is unchanged, and the tip's yaw differs by the rotation."""
    column_map = ColumnMap(task="edge", columns=("pose_x=x", "pose_z=-d", "pose_Rz=yaw"), camera_rotation_deg=20.0)
    poses, _ = convert_labels(column_map, table_of(x=3.0, d=2.0, yaw=-10.0))
    assert np.allclose(poses, [[3, 0, -2, 0, 0, -30]])
    poses, _ = convert_labels(ColumnMap(task="edge"), table_of(pose_x=3.0, pose_y=4.0, pose_z=-1.0))
    assert np.allclose(poses[0, :3], [3, 0, -1])  # along the edge nothing changes


@pytest.mark.parametrize("order", ["xyz", "ZYX"])
def test_euler_angles(order):
    angles = [10.0, -20.0, 30.0]
    turn = Rotation.from_euler(order, angles, degrees=True)
    table = table_of(**dict(zip(("pose_Rx", "pose_Ry", "pose_Rz"), angles, strict=True)), pose_z=-1.0)
    poses, _ = convert_labels(ColumnMap(task="edge", angles=order), table)
    assert np.allclose(poses[0, 3:], turn.as_rotvec(degrees=True))


def test_factors_offsets_and_numbers():
    column_map = ColumnMap(columns=("pose_z = -0.5*d + 1", "pose_Rx=angle", "pose_Ry=2.5", "shear_y=+1e-1*s"))
    poses, shears = convert_labels(column_map, table_of(d=4.0, angle=3.0, s=20.0))
    assert np.allclose(poses[0, 2:5], [-1, 3, 2.5])
    assert np.isclose(shears[0, 1], 2.0)


def test_names_of_any_letters_are_written_in_brackets():
    column_map = ColumnMap(columns=("pose_z=-[z [mm]]-5", "pose_Ry=0.5*[Ry (deg)] + 1", "pose_Rx=[0]", "shear_x=[move-x]"))
    poses, shears = convert_labels(column_map, table_of(**{"z [mm]": -3.0, "Ry (deg)": 8.0, "0": 2.0, "move-x": 4.0}))
    assert np.allclose(poses[0, 2:5], [-2, 2, 5])
    assert np.isclose(shears[0, 0], 4.0)
    with pytest.raises(TactipError, match=r"pose_z=-0 is a number, but the table has a column 0: write \[0\] to mean it"):
        convert_labels(ColumnMap(columns=("pose_z=-0",)), table_of(**{"0": 2.0}))


def test_own_names_count_whatever_their_case():
    poses, _ = convert_labels(ColumnMap(), table_of(Pose_Z=-3.0, pose_rx=7.0, pose_ry=-4.0))
    assert np.allclose(poses[0, 2:5], [-3, 7, -4])
    poses, _ = convert_labels(ColumnMap(), table_of(pose_z=-3.0, POSE_Z=-1.0, pose_RX=1.0, pose_rx=2.0))
    assert np.allclose(poses[0, 2:5], [-3, 0, 0])  # two names that differ in case alone say nothing


@pytest.mark.parametrize("angles", ["vector", "xyz"])
def test_angles_from_0_to_360_are_those_around_0(angles):
    column_map = ColumnMap(angles=angles)
    wrapped, plain = (convert_labels(column_map, table_of(pose_z=-3.0, pose_Rx=rx, pose_Ry=5.0))[0] for rx in (350.0, -10.0))
    assert np.allclose(wrapped, plain)
    assert np.allclose(convert_labels(ColumnMap(task="edge"), table_of(pose_z=-3.0, pose_Rz=-180.0))[0][0, 5], -180)


def test_columns_that_are_not_used_are_listed():
    table = {"pose_z": ["-1", "-2"], "Fz": ["0.5", "1.5"], "name": ["a", "b"], "still": ["1", "1"], "d": ["1", "2"]}
    assert unused_columns(ColumnMap(), table) == ["Fz", "d"]
    assert unused_columns(ColumnMap(columns=("pose_z=-d",)), table) == ["pose_z", "Fz"]


def test_convert_labels_non_numeric_cell_is_nan():
    poses, _ = convert_labels(ColumnMap(), {"pose_z": ["-1", "", "deep"], "pose_Rx": ["0", "0", "0"]})
    assert np.isfinite(poses[0]).all()
    assert np.isnan(poses[1:]).all()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("depth=-pose_2", "a column must be mapped to one of pose_x, pose_y"),
        ("pose_z=__import__('os')", "a column must be written like pose_z=-pose_2-5"),
        ("pose_z=a*b", "a column must be written like pose_z=-pose_2-5"),
        ("pose_z", "a column must be written like pose_z=-pose_2-5"),
    ],
)
def test_column_map_malformed_column_is_refused(spec, words):
    with pytest.raises(TactipError, match=words.replace("(", r"\(")):
        ColumnMap(columns=(spec,))


def test_convert_labels_missing_column_is_refused():
    with pytest.raises(TactipError, match="no column 'depth': its columns are pose_1, pose_2"):
        convert_labels(ColumnMap(columns=("pose_z=depth",)), table_of(pose_1=0.0, pose_2=0.0))
    with pytest.raises(TactipError, match="no column named pose_x … shear_Rz"):
        convert_labels(ColumnMap(), table_of(pose_1=0.0))
    with pytest.raises(TactipError, match=r"its columns are name, pose_1, pose_2 \(-4 to 1.5\)$"):
        convert_labels(ColumnMap(), {"name": ["a", "b"], "pose_1": ["0", "0"], "pose_2": ["1.5", "-4"]})
    with pytest.raises(TactipError, match="no column photo"):
        image_column(ColumnMap(image_column="photo"), ["image_name"])


def test_layout_file(tmp_path):
    path = tmp_path / "layout.json"
    path.write_text(json.dumps({"task": "edge", "columns": ["pose_z=-d"], "crop": [1, 2, 3, 4], "angles": "xyz"}))
    table = ColumnMap(task="edge", columns=("pose_z=-d",), angles="xyz")
    layout = Layout(table, ImagePreprocessing(crop=(1, 2, 3, 4)))
    assert read_layout(path) == layout
    assert Layout.from_dict(layout.as_dict()) == layout
    path.write_text(json.dumps({"colour": 1}))
    with pytest.raises(TactipError, match=r"unknown field colour in .*: its fields are angles, base_pose, camera"):
        read_layout(path)
    path.write_text("{")
    with pytest.raises(TactipError, match="is not JSON"):
        read_layout(path)
    with pytest.raises(TactipError, match="angles must be auto, vector, or three letters as xyz or ZYX, got 'xxy'"):
        ColumnMap(angles="xxy")
    with pytest.raises(TactipError, match="unknown task 'corner': choose one of surface, edge"):
        ColumnMap(task="corner")
    with pytest.raises(TactipError, match="unknown mask 'rim': choose one of pins, none"):
        ImagePreprocessing(mask="rim")


def test_columns_are_named_after_the_components():
    assert LABELS == ("pose_x", "pose_y", "pose_z", "pose_Rx", "pose_Ry", "pose_Rz")
    assert SHEARS == ("shear_x", "shear_y", "shear_z", "shear_Rx", "shear_Ry", "shear_Rz")
