"""Sequences of contacts: their poses, their labels, and data sets of their snapshots."""

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.set_commands import configuration, contents, table
from tactip_twin.sim.contact.curved_surface import curved_surface
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, Ranges
from tactip_twin.sim.dataset.sliding import SlidingPath
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.pose import from_mm_deg, label_of, sensor_in_contact, to_mm_deg
from tactip_twin.tactip_model.errors import TactipError

RADIUS_M = 30e-3


def strides(task, solid=None, count=300, seed=0):
    """Return poses in the stimulus's frame and labels, (n, 6) each, of a sliding path."""
    draw = np.random.default_rng(seed)
    walk = SlidingPath(task, solid, POSE_RANGES[task], from_mm_deg([0, 0, -3, 5, -5, 0]), draw)
    both = [(walk.stride(), walk.label()) for _ in range(count)]
    return tuple(np.array(each) for each in zip(*both, strict=True))


@pytest.mark.parametrize("task", POSE_RANGES)
def test_sequence_stays_within_ranges(task):
    poses, labels = strides(task)
    low, high = POSE_RANGES[task].bounds().T
    assert (to_mm_deg(labels) >= low - 1e-9).all() and (to_mm_deg(labels) <= high + 1e-9).all()
    gone = np.linalg.norm(np.diff(poses[:, :2] - (0 if task == "surface" else labels[:, :2]), axis=0), axis=1)
    assert gone.min() > 0.19e-3 and gone.max() < 2.5e-3  # a tilted tip's apex moves, too
    assert 12e-3 < np.abs(poses[:, :2]).max() < 20e-3
    # It covers the ranges, and does not stay near its start.
    assert (to_mm_deg(np.ptp(labels, axis=0)) >= 0.6 * (high - low))[high > low].all()


@pytest.mark.parametrize("task", POSE_RANGES)
def test_start_of_a_sequence_is_independent_of_its_steps(task):
    """Components without a label are passed through once, not again at every stride."""
    ranges = replace(POSE_RANGES[task], x_mm=(-5, 5), y_mm=(-5, 5), yaw_deg=(-20, 20))
    walk = SlidingPath(task, None, ranges, from_mm_deg([4, 4, -3, 0, 0, 15]), np.random.default_rng(0))
    poses = np.array([walk.stride() for _ in range(100)])
    gone = np.linalg.norm(np.diff(poses[:, :2] if task == "surface" else poses[:, 1:2], axis=0), axis=1)
    assert gone.max() < 2.5e-3
    if task == "surface":
        assert np.abs(np.diff(poses[:, 5])).max() < np.radians(8)


@pytest.mark.parametrize("task", POSE_RANGES)
def test_on_the_flat_and_the_edge_labels_are_the_poses_but_for_where(task):
    """A plane is the same everywhere and rotated; an edge is the same along itself."""
    poses, labels = strides(task, count=50)
    turned = np.array([sensor_in_contact(p)[:3, :3] for p in poses])
    ours = np.array([sensor_in_contact(label)[:3, :3] for label in labels])
    assert np.allclose(poses[:, 2], labels[:, 2])
    assert np.allclose(turned[:, 2, 2], ours[:, 2, 2])  # the tilt to the normal
    if task == "edge":
        assert np.allclose(np.delete(poses, 1, axis=1), np.delete(labels, 1, axis=1)) and np.ptp(poses[:, 1]) > 5e-3


def test_on_a_ball_labels_are_those_of_its_radius_and_middle():
    """Closed form: depth and tilt relative to the ball's centre; the surface has triangles 1 mm wide, 4 µm off."""
    poses, labels = strides("surface", curved_surface(1 / RADIUS_M, 1 / RADIUS_M, 0.0), count=80)
    apexes = np.array([sensor_in_contact(p)[:3, 3] for p in poses])
    axes = np.array([sensor_in_contact(p)[:3, 2] for p in poses])
    # The surface is a paraboloid, which equals a ball to 0.1 mm within 6 mm of its level point.
    near = np.linalg.norm(apexes[:, :2], axis=1) < 5e-3
    assert near.sum() > 5
    away = apexes[near] + [0, 0, RADIUS_M]
    distance = np.linalg.norm(away, axis=1)
    assert np.allclose(labels[near, 2], distance - RADIUS_M, atol=0.05e-3)
    tilts = np.arccos(np.clip(-(away / distance[:, None] * axes[near]).sum(1), -1, 1))
    predicted = np.arccos(np.clip([-sensor_in_contact(label)[2, 2] for label in labels[near]], -1, 1))
    assert np.allclose(predicted, tilts, atol=np.radians(0.6))


def test_sliding_on_is_what_one_long_shear_is(design, standard):
    """A contact sheared half the distance that then slides the rest ends as after one shear, up to the effect of the
    pause."""
    simulator = ContactSimulator(design, "surface", standard)
    pose, shear = from_mm_deg([0, 0, -3, 5, 0, 0]), from_mm_deg([4, 0, 0, 0, 0, 0])
    whole = simulator.simulate(pose, shear)
    half = pose - shear / 2
    simulator.simulate(half, shear / 2)
    tips = simulator.slide(pose, pose).pin_tips
    still = simulator.simulate(pose, 0 * shear).pin_tips
    apart, moved = (np.sqrt(np.mean(((whole.pin_tips - other) ** 2).sum(1))) for other in (tips, still))
    assert apart < 0.06e-3 and moved > 10 * apart


def test_snapshot_shear_is_motion_since_first_contact(on_surface):
    simulator = on_surface.simulator
    pose = from_mm_deg([0, 0, -2, 0, 0, 0])
    simulator.simulate(pose, from_mm_deg([1, 0, 0, 0, 0, 0]))
    there = simulator.slide(from_mm_deg([2, 1, -2, 0, 0, 0]), pose)
    assert np.allclose(to_mm_deg(there.shear), [3, 1, 0, 0, 0, 0])
    assert np.allclose(there.pose, pose)


def made(folder, design, workers=1, **changes):
    given = configuration(design, **{"samples": 12, "snapshots_per_contact": 4, **changes})
    return given, make([Job(given, folder)], workers, log=lambda line: None)[0]


@pytest.mark.slow
def test_set_of_snapshots_is_independent_of_workers(design, tmp_path):
    """From one worker, from two, and extended from a smaller set that ends within a contact."""
    made(tmp_path / "a", design)
    made(tmp_path / "b", design, workers=2)
    made(tmp_path / "c", design, samples=6)
    made(tmp_path / "c", design)
    assert contents(tmp_path / "a") == contents(tmp_path / "b") == contents(tmp_path / "c")
    assert verify(tmp_path / "a") == []
    rows = table(tmp_path / "a")
    assert [row["index"] for row in rows] == [str(k) for k in range(12)]
    assert len({row["seed"] for row in rows}) == 3


def test_set_that_ends_within_a_contact_has_its_samples_only(design, tmp_path):
    made(tmp_path / "short", design, samples=2)
    assert [row["index"] for row in table(tmp_path / "short")] == ["0", "1"]
    assert verify(tmp_path / "short") == []


def test_first_snapshot_is_the_contact_without_sliding(design, tmp_path):
    made(tmp_path / "walked", design, samples=6, snapshots_per_contact=3)
    made(tmp_path / "plain", design, samples=2, snapshots_per_contact=1)
    walked, plain = table(tmp_path / "walked")[::3], table(tmp_path / "plain")
    ours = [{k: v for k, v in row.items() if k not in ("index", "sensor_image")} for row in walked]
    assert ours == [{k: v for k, v in row.items() if k not in ("index", "sensor_image")} for row in plain]


def test_looks_turn_and_mirror_as_contacts_do(design, tmp_path):
    given, result = made(
        tmp_path / "set",
        design,
        task="edge",
        augment_symmetry=True,
        samples=12,
        snapshots_per_contact=3,
        pose=POSE_RANGES["edge"],
    )
    assert given.samples_per_contact == 6 and result["kept"] + result["failed"] == 12 and verify(tmp_path / "set") == []
    rows = table(tmp_path / "set")
    assert len(rows) >= 8 and len(rows) % 2 == 0
    for one, other in zip(rows[::2], rows[1::2], strict=True):
        assert int(other["index"]) == int(one["index"]) + 1
        assert one["pose_x"] == other["pose_x"] and float(one["pose_Rz"]) == -float(other["pose_Rz"])


def test_failing_snapshot_is_left_out_and_listed(design, tmp_path):
    """The set is complete, can be read, and can be extended."""
    strict = QualityLimits(volume_ratio=0.65)
    _, result = made(tmp_path / "set", design, samples=8, snapshots_per_contact=4, seed=6, bounds=strict)
    meta = json.loads((tmp_path / "set/meta.json").read_text())
    missed = [failure["index"] for failure in meta["failures"]]
    assert 0 < result["failed"] == len(missed) < 8 and result["kept"] == 8 - len(missed)
    assert all("of its volume" in failure["tries"][0][0] for failure in meta["failures"])
    assert {int(row["index"]) for row in table(tmp_path / "set")} == set(range(8)) - set(missed)
    assert verify(tmp_path / "set") == []
    made(tmp_path / "set", design, samples=12, snapshots_per_contact=4, seed=6, bounds=strict)
    made(tmp_path / "other", design, samples=12, snapshots_per_contact=4, seed=6, bounds=strict)
    assert contents(tmp_path / "set") == contents(tmp_path / "other")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"snapshots_per_contact": 0}, "snapshots_per_contact must be between 1 and 1000, got 0"),
        (
            {"snapshots_per_contact": 200, "shard_samples": 100},
            "shard_samples must be at least 200, the number of samples of one contact, got 100",
        ),
        (
            {"pose": Ranges(depth_mm=(-5, -1), yaw_deg=(5, 9))},
            "pose.yaw_deg must be a range that includes 0 if snapshots_per_contact is above 1",
        ),
    ],
)
def test_unsupported_combinations_are_refused(design, tmp_path, changes, sentence):
    with pytest.raises(TactipError, match=sentence.replace("(", r"\(").replace(")", r"\)")):
        made(tmp_path / "set", design, **changes)
    assert not (tmp_path / "set").exists()


def test_sequence_on_a_solid_uses_only_its_surface():
    """Also if it is level nowhere."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 60e-3 - 15e-3
    solid = SignedDistanceMesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    poses, labels = strides("surface", solid, count=20)
    assert np.isfinite(poses).all() and np.isfinite(labels).all()
    assert np.allclose(label_of(sensor_in_contact(poses[0])), poses[0])
