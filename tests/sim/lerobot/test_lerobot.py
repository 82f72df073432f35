"""Sets and runs in LeRobot's format: they are written completely, and come back unchanged."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from helpers.learning_sets import add_pins, write_fake_set, write_fake_shards
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.format import read_dataset
from tactip_twin.sim.lerobot import writer
from tactip_twin.sim.pose import matrix
from tactip_twin.sim.robot.recording import ARRAYS, RecordedScene, Recorder, read_recording
from tactip_twin.tactip_model.input_images import decode_image

STEPS = 12

FRAMES = "data/chunk-000/file-000.parquet"

LEROBOT = os.environ.get("TACTIP_LEROBOT_PYTHON") or (sys.executable if find_spec("lerobot") else "")
"""Python that has the package lerobot, which pins versions of many others and so has an environment of its own."""


@pytest.fixture(scope="module", autouse=True)
def parquet():
    return pytest.importorskip("pyarrow.parquet", reason="the extra lerobot is not installed")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A set with pins."""
    folder = write_fake_set(tmp_path_factory.mktemp("set") / "set", samples=5)
    rng = np.random.default_rng(0)
    add_pins(folder, rng.normal(size=(5, 127, 3)), rng.normal(size=(5, 127, 3)))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A recording whose sensor moves and turns."""
    folder, rng = tmp_path_factory.mktemp("run") / "run", np.random.default_rng(0)
    box = trimesh.creation.box((0.05, 0.05, 0.02))
    scene = RecordedScene(box.vertices, box.faces, np.eye(4), np.array([[0, 1, 2]]), 0.02, False)
    recorder = Recorder(folder, {"task": "surface", "object": "plate"}, scene)
    for k in range(STEPS):
        row = {name: rng.normal(size=[n or 3 for n in shape]) for name, shape in ARRAYS.items()}
        T = matrix([0.3, 1e-3 * k, 0.1], Rotation.from_rotvec([0, 0, 0.1 * k]))
        row |= {"T_base_tcp": T, "T_base_tcp_measured": T, "phase": "follow", "part": 0, "sim_steps": 1}
        recorder.add(row | {"images": 255 * rng.integers(0, 2, (16, 16)).astype(np.uint8)})
    recorder.finish({"stopped_because": "the route is complete"})
    return folder


def export(folder, out, *options):
    return tactip.main(["dataset", "export", str(folder), "--lerobot", str(out), *options])


def bring_back(folder, out):
    return tactip.main(["dataset", "import", str(folder), "--out", str(out)])


def contents(folder):
    """Return the files of a folder by name: JSON as values, others as bytes; locks are left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    values = {
        str(p.relative_to(folder)): json.loads(p.read_text()) if p.suffix == ".json" else p.read_bytes() for p in files
    }
    if "shards" in values.get("meta.json", {}):
        del values["meta.json"]["files"]  # checksums of JSON files, whose spaces differ
    return values


def test_frames_of_a_set_are_its_samples(simulated, tmp_path, parquet, capsys):
    assert export(simulated, tmp_path / "out") == 0
    assert "5 frames in 5 episodes" in capsys.readouterr().out
    table, dataset = (
        parquet.read_table(tmp_path / "out" / FRAMES),
        read_dataset(simulated),
    )
    for i, row in enumerate(table.to_pylist()):
        image = decode_image(row["observation.images.tactile"]["bytes"], "image", color=True)
        assert image.shape == (40, 40, 3) and np.array_equal(image[..., 1], dataset.image(i))
        assert np.allclose(row["label"], dataset.poses[i], atol=1e-5)
        with np.load(simulated / "pins.npz") as pins:
            assert np.array_equal(np.float32(row["observation.pin_tips"]), pins["pin_tips"][i].ravel())
        assert (row["episode_index"], row["index"], row["frame_index"], row["timestamp"]) == (i, i, 0, 0)
    info = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_frames"], info["video_path"]) == ("v3.0", 5, None)
    assert info["features"]["label"]["names"] == [*(f"pose_{c}_mm" for c in "xyz"), *(f"pose_R{c}_deg" for c in "xyz")]
    stats = json.loads((tmp_path / "out" / "meta" / "stats.json").read_text())
    assert np.allclose(stats["label"]["mean"], dataset.poses.mean(0)) and stats["label"]["count"] == [5]
    images = np.stack([dataset.image(i) for i in range(5)]) / 255
    assert np.allclose(np.squeeze(stats["observation.images.tactile"]["mean"]), images.mean())


@pytest.mark.parametrize("small_files", [False, True])
def test_sets_come_back_unchanged(simulated, tmp_path, monkeypatch, small_files):
    if small_files:
        monkeypatch.setattr(writer, "_MAX_FILE_BYTES", 5000)
    shards = write_fake_shards(tmp_path / "shards", shards=3, samples=4)
    for k, folder in enumerate((simulated, shards)):
        assert export(folder, tmp_path / f"out-{k}") == 0
        assert (len(list((tmp_path / f"out-{k}").glob("data/*/*"))) > 1) == small_files
        assert bring_back(tmp_path / f"out-{k}", tmp_path / f"back-{k}") == 0
        assert contents(tmp_path / f"back-{k}") == contents(folder)
        read_dataset(tmp_path / f"back-{k}")


def test_contact_with_a_sliding_path_is_an_episode(tmp_path, parquet):
    folder = write_fake_set(tmp_path / "set", samples=8, snapshots_per_contact=4)
    assert export(folder, tmp_path / "out") == 0
    episodes = parquet.read_table(tmp_path / "out" / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [(e["length"], e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(4, 0, 4), (4, 4, 8)]


def test_run_comes_back_unchanged(run, tmp_path, parquet):
    assert export(run, tmp_path / "out", "--fps", "20") == 0
    table = parquet.read_table(tmp_path / "out" / FRAMES).to_pylist()
    _, arrays = read_recording(run)
    assert len(table) == len(arrays["images"]) and table[1]["timestamp"] == pytest.approx(0.05)
    T = arrays["T_base_tcp_measured"]
    assert np.allclose(table[0]["observation.state"][:3], T[0, :3, 3], atol=1e-6)
    moved = np.array(table[0]["action"][:3])
    assert np.allclose(T[0, :3, :3] @ moved, T[1, :3, 3] - T[0, :3, 3], atol=1e-6) and not any(table[-1]["action"])
    assert bring_back(tmp_path / "out", tmp_path / "back") == 0
    assert contents(tmp_path / "back") == contents(run)


def test_what_does_not_fit_is_refused(simulated, tmp_path, capsys, monkeypatch):
    assert export(tmp_path, tmp_path / "out") == 1
    assert "there is no data set in" in capsys.readouterr().err
    assert export(simulated, tmp_path / "out", "--fps", "0") == 1
    assert "fps must be at least 1, got 0" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert [export(simulated, tmp_path / "out") for _ in range(2)] == [0, 1]
    assert "must not exist" in capsys.readouterr().err
    assert bring_back(simulated, tmp_path / "back") == 1
    assert "must be a LeRobot data set of version v3.0 that" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert export(simulated, tmp_path / "other") == 1
    assert ".venv/bin/pip install -e '.[lerobot]'" in capsys.readouterr().err


def test_frames_that_were_changed_are_refused(simulated, run, tmp_path, parquet, capsys):
    for folder in (simulated, run):
        out = tmp_path / folder.name
        assert export(folder, out) == 0
        path = out / FRAMES
        table = parquet.read_table(path)
        parquet.write_table(table.slice(1), path)
        assert bring_back(out, tmp_path / "back") == 1
        path.write_bytes(b"PAR1")
        assert bring_back(out, tmp_path / "back") == 1
        assert not (tmp_path / "back").exists()
    messages = capsys.readouterr().err
    assert "frame 0 of" in messages and "must be those of the recording" in messages and messages.count("is damaged") == 2


_LOADS = """
import json, sys
from pathlib import Path
from lerobot.datasets import LeRobotDataset, delete_episodes
data = LeRobotDataset("local/tactip", root=sys.argv[1], delta_timestamps={"label": [0, 0.1]})
shapes = {key: list(value.shape) for key, value in data[1].items() if hasattr(value, "shape")}
image = (255 * data[1]["observation.images.tactile"]).round().int().tolist()
fewer = delete_episodes(data, [0], output_dir=Path(sys.argv[2]), repo_id="local/fewer") if data.num_episodes > 1 else data
print(json.dumps([len(data), data.num_episodes, shapes, image, data[1]["task"], len(fewer)]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not LEROBOT, reason="lerobot is not installed, and TACTIP_LEROBOT_PYTHON names no Python that has it")
def test_lerobot_loads_what_is_written(simulated, run, tmp_path):
    images = read_dataset(simulated).image(1), read_recording(run)[1]["images"][1]
    for folder, expected, image in zip((simulated, run), ((5, 5, 4), (STEPS, 1, STEPS)), images, strict=True):
        assert export(folder, tmp_path / folder.name) == 0
        arguments = [LEROBOT, "-c", _LOADS, str(tmp_path / folder.name), str(tmp_path / "fewer")]
        variables = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "cache"), "PYTHONPATH": ""}
        done = subprocess.run(arguments, capture_output=True, text=True, env=variables)
        assert done.returncode == 0, done.stderr
        frames, episodes, shapes, pixels, task, fewer = json.loads(done.stdout.splitlines()[-1])
        assert (frames, episodes, fewer) == expected
        assert shapes["label"] == [2, 6] and shapes["observation.images.tactile"] == [3, *image.shape]
        assert np.array_equal(pixels[0], image) and task.startswith(("press", "follow"))
