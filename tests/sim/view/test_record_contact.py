"""A recorded contact of a data set ends in the state that the set contains."""

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.dataset.generate import Job, make
from tactip_twin.sim.dataset.sampling import POSE_RANGES, SHEAR_RANGES
from tactip_twin.sim.pose import to_mm_deg
from tactip_twin.sim.robot.recording import PHASES, read_recorded_scene, read_recording
from tactip_twin.sim.view.record_contact import record_contact
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

KINDS = {"surface": {}, "edge": {}, "bent": {"curvature_per_m": (-10.0, 40.0)}, "symmetric": {"augment_symmetry": True}}
KINDS |= {
    "walk": {"snapshots_per_contact": 4},
    "walk on bent": {"snapshots_per_contact": 3, "augment_symmetry": True, "curvature_per_m": (-10.0, 40.0)},
}
SAMPLES = {"symmetric": 16, "walk": 8, "walk on bent": 48}
SHOWN = {"symmetric": 8, "walk": 6, "walk on bent": 40}
"""Samples: the second contact as simulated, and the third snapshot of a sequence."""


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    jobs = []
    for kind, changes in KINDS.items():
        task = "edge" if kind == "edge" else "surface"
        given = {"design": design_named("nominal-127"), "fidelity": fidelity_named("draft"), "renderer": "raster"}
        given |= {"pose": POSE_RANGES[task], "shear": SHEAR_RANGES, "task": task, "split": "test", "seed": 5}
        jobs.append(Job(Configuration(**given, samples=SAMPLES.get(kind, 2), **changes), folder / kind))
    make(jobs, 1, lambda line: None)
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_recorded_contact_ends_as_in_the_set(sets, tmp_path, kind):
    sample = SHOWN.get(kind, 1)
    record, arrays = record_contact(sets / kind, sample, tmp_path / "run")
    dataset = read_dataset(sets / kind)
    with np.load(sets / kind / "pins.npz") as pins:
        assert np.array_equal(arrays["pin_tips_m"][-1], pins["pin_tips"][sample])
        assert np.array_equal(arrays["directions"][-1], pins["directions"][sample])
    assert np.array_equal(arrays["images"][-1], dataset.image(sample))
    assert np.allclose(to_mm_deg(arrays["true"][-1]), dataset.poses[sample], atol=1e-6)
    assert np.isnan(arrays["predicted"]).all()
    assert record["stopped_because"] == "the tip is at rest"


def test_recorded_contact_phases_are_in_order(sets, tmp_path):
    _, arrays = record_contact(sets / "surface", 0, tmp_path / "run")
    phases = [PHASES[k] for k in arrays["phase"]]
    assert list(dict.fromkeys(phases)) == ["approach", "shear", "settle"]
    approach = np.array(phases) == "approach"
    assert np.all(np.diff(arrays["true"][approach, 2]) < 0)
    force = np.linalg.norm(arrays["force_n"][approach], axis=1)
    assert force[0] < 0.5 * force[-1] and arrays["touching"][-1]


def test_stimulus_is_below_the_tip(sets, tmp_path):
    """The pressed skin lies on the shown object, not inside it."""
    for kind in ("surface", "edge", "bent"):
        _, arrays = record_contact(sets / kind, 0, tmp_path / kind)
        scenery = read_recorded_scene(tmp_path / kind)
        solid = SignedDistanceMesh(scenery.object_vertices, scenery.object_triangles)
        T = np.linalg.inv(scenery.T_base_object) @ arrays["T_base_tcp"][-1]
        distance = solid.distance(arrays["skin_m"][-1] @ T[:3, :3].T + T[:3, 3])
        assert -0.1e-3 < distance.min() < 0.5e-3
        assert (scenery.object_vertices @ scenery.T_base_object[:3, :3].T + scenery.T_base_object[:3, 3])[:, 2].min() > -1e-6


def test_predictions_are_recorded(sets, tmp_path):
    _, arrays = record_contact(sets / "surface", 0, tmp_path / "run", lambda image: {"z": -2.0, "Rx": 3.0, "Ry": 0.5})
    assert np.allclose(to_mm_deg(arrays["predicted"][-1]), [0, 0, -2, 3, 0.5, 0])


def test_recorded_contact_makes_a_video(sets, tmp_path, capsys):
    arguments = ["dataset", "record", str(sets / "edge"), "--sample", "1", "--out", str(tmp_path / "run"), "--model", "none"]
    assert tactip.main(arguments) == 0
    assert "steps recorded" in capsys.readouterr().out
    assert tactip.main(["replay", str(tmp_path / "run"), "--video", str(tmp_path / "film.mp4"), "--stride", "8"]) == 0
    assert (tmp_path / "film.mp4").stat().st_size > 1000
    assert tactip.main(arguments) == 1
    assert "not empty" in capsys.readouterr().err
    record, _ = read_recording(tmp_path / "run")
    assert record["set"]["sample"] == 1


def test_missing_sample_is_refused(sets, tmp_path):
    with pytest.raises(TactipError, match="has no sample 7: it has 2 samples from 0 to 1"):
        record_contact(sets / "surface", 7, tmp_path / "run")
    with pytest.raises(TactipError, match="there is no data set"):
        record_contact(tmp_path, 0, tmp_path / "run")
