"""The poses to record: they stay in their ranges, and the table is imported as it was meant."""

import csv
import io

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim.pose import before_shear, from_mm_deg, to_mm_deg
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.importing.protocol import STARTS, ProtocolOptions, protocol_table


def columns(options: ProtocolOptions) -> dict[str, list[str]]:
    """Return the cells of each column of a protocol."""
    rows = list(csv.DictReader(io.StringIO(protocol_table(options).decode())))
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.parametrize("task", ["surface", "edge"])
@pytest.mark.parametrize("angles", ["vector", "xyz", "ZYX"])
def test_table_is_imported_as_it_was_meant(task, angles):
    """The importer, told the convention of the angles, finds the poses of the rotation vectors and the shears to them."""
    wanted = columns(ProtocolOptions(task=task, frames=40))
    table = columns(ProtocolOptions(task=task, frames=40, angles=angles))
    poses, shears = convert_labels(ColumnMap(task=task, angles=angles), table)
    meant = np.array([[float(c) for c in wanted[name]] for name in LABELS]).T
    assert np.allclose(poses, meant, atol=2e-3)
    starts = np.array([[float(c) for c in wanted[name]] for name in STARTS]).T
    back = to_mm_deg([before_shear(*pair) for pair in zip(from_mm_deg(poses), from_mm_deg(shears), strict=True)])
    assert np.allclose(back, starts, atol=2e-3)
    # The frame of a sample does not depend on how many there are.
    few = columns(ProtocolOptions(task=task, frames=7, angles=angles))
    assert all(table[name][:7] == cells for name, cells in few.items())


def test_poses_fill_their_ranges_and_nothing_else():
    options = ProtocolOptions(task="edge", frames=400, depth_mm=(2.0, 4.0), tilt_deg=8.0, yaw_deg=30.0, shear_mm=3.0)
    table = columns(options)
    numbers = {name: np.array(cells, float) for name, cells in table.items() if name != "image_name"}
    widths = {"pose_x": 5.0, "pose_y": 0.0, "pose_Rx": 8.0, "pose_Ry": 8.0, "pose_Rz": 30.0, "shear_x": 3.0, "shear_y": 3.0}
    for name, width in widths.items():
        assert np.abs(numbers[name]).max() <= width + 1e-4 and np.abs(numbers[name]).max() >= 0.95 * width
    assert numbers["pose_z"].min() > -4.0001 and numbers["pose_z"].max() < -1.9999 and not numbers["shear_z"].any()
    assert len(set(table["image_name"])) == 400 and set(SHEARS) < set(table)


def test_command_writes_the_table_once_and_refuses_what_it_cannot_mean(tmp_path, capsys):
    out = tmp_path / "new" / "targets.csv"
    assert tactip.main(["protocol", "--out", str(out), "--frames", "5"]) == 0
    before = out.read_bytes()
    assert before == protocol_table(ProtocolOptions(frames=5)) and "press at start_x" in capsys.readouterr().out
    assert tactip.main(["protocol", "--out", str(out), "--frames", "6"]) == 1
    assert "exists already" in capsys.readouterr().err and out.read_bytes() == before
    for wrong in (["--depth-mm", "5", "1"], ["--frames", "0"], ["--tilt-deg", "80"]):
        assert tactip.main(["protocol", "--out", str(tmp_path / "other.csv"), *wrong]) != 0
