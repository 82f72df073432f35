"""Faults of a rig: what its table says, converted to labels by the importer, which is independent code."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactip_twin.sim.labels import LABELS, SHEARS
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.convert_labels import convert_labels
from tactip_twin.sim2real.transfer.rig_faults import RigFaults, typical_rig_faults


@pytest.fixture
def contacts():
    rng = np.random.default_rng(3)
    poses = rng.uniform(-1, 1, (30, 6)) * [4, 0, 1, 12, 12, 40] - [0, 0, 3, 0, 0, 0]
    return poses, rng.uniform(-1, 1, (30, 6)) * [5, 5, 0, 4, 4, 4]


def labels(faults, contacts, **conventions):
    """Labels that an importer who knows some `conventions` of the rig gives the contacts."""
    table = np.concatenate(faults.commanded(*contacts, np.random.default_rng(0)), 1)
    cells = {name: [repr(float(x)) for x in column] for name, column in zip((*LABELS, *SHEARS), table.T, strict=True)}
    return convert_labels(ColumnMap(task="edge", **conventions), cells)[0]


def test_rig_without_faults_tells_the_truth(contacts):
    poses, shears = RigFaults().commanded(*contacts, np.random.default_rng(0))
    assert np.allclose(poses, contacts[0]) and np.allclose(shears, contacts[1])


def test_known_tool_centre_is_no_fault(contacts):
    """A tool centre beside and behind the apex moves the labels by millimetres, and none if the importer knows it."""
    faults = RigFaults(tcp_beside_axis_mm=(0.7, -0.4), tcp_behind_apex_mm=20.0)
    known = labels(faults, contacts, tcp_beside_axis_mm=(0.7, -0.4), tcp_behind_apex_mm=20.0)
    assert np.allclose(known, contacts[0], atol=1e-9)
    assert np.abs(labels(faults, contacts) - contacts[0])[:, 0].mean() > 1.0


def test_tilted_table_adds_its_tilt_to_an_upright_tip():
    poses = np.array([[0.0, 0, -3, 0, 0, 0]])
    commanded, _ = RigFaults(table_tilt_deg=(1.5, -1.0)).commanded(poses, np.zeros((1, 6)), np.random.default_rng(0))
    assert np.allclose(commanded[0, 3:], [1.5, -1.0, 0])
    tilt = Rotation.from_rotvec([1.5, -1.0, 0], degrees=True)
    assert np.allclose(commanded[0, :3], tilt.apply([0, 0, -3.0]))


def test_unfinished_shear_leaves_labels_ahead_of_the_tip(contacts):
    poses, shears = RigFaults(max_unfinished=0.2).commanded(*contacts, np.random.default_rng(0))
    ahead = np.linalg.norm(shears[:, :2], axis=1) - np.linalg.norm(contacts[1][:, :2], axis=1)
    assert (ahead >= 0).all() and ahead.max() > 0.1
    # Table and truth start the shear at the same place.
    assert np.allclose(poses - shears, contacts[0] - contacts[1], atol=1e-9)


def test_image_grows_from_one_to_its_final_size():
    faults = RigFaults(image_growth=0.01)
    sizes = [faults.zoom(part) for part in np.linspace(0, 1, 11)]
    assert sizes[0] == 1 and np.all(np.diff(sizes) > 0) and sizes[-1] == pytest.approx(1.01, abs=1e-5)


def test_typical_faults_are_allowed_and_differ():
    drawn = [typical_rig_faults(np.random.default_rng(seed)) for seed in range(20)]
    assert len(set(drawn)) == 20
    assert all(1 <= np.hypot(*one.table_tilt_deg) <= 2 for one in drawn)
