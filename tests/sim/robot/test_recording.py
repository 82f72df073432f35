"""A recording is read back as it was made, complete or cut short; anything else is refused in a sentence."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from helpers.full_disk import full_disk
from helpers.kills import Killed
from tactip_twin.sim.robot.recording import (
    ARRAYS,
    LOG,
    PHASES,
    RECORDING,
    SCENERY,
    STEPS,
    RecordedScene,
    Recorder,
    RecordingFullError,
    check_skin,
    read_recorded_scene,
    read_recording,
)
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import with_checksum

SCENE = RecordedScene(np.eye(3), np.array([[0, 1, 2]]), np.eye(4), np.array([[0, 1, 2]]), 20e-3, True)


def _row(k):
    """A step whose values contain its number."""
    sizes = {"pin_tips_m": (5, 3), "directions": (5, 3), "skin_m": (7, 3)}
    row = {name: np.full(sizes.get(name, shape), float(k)) for name, shape in ARRAYS.items() if name != "images"}
    image = np.zeros((20, 20), np.uint8)
    image[k % 20, :k] = 255
    return row | {"phase": PHASES[k % 3], "images": image}


def _record(folder, steps, finish=True):
    recorder = Recorder(folder, {"task": "surface", "object": "plate"}, SCENE)
    for k in range(steps):
        recorder.add(_row(k))
        if k == 1:
            recorder.note({"step": 1, "kind": "force", "what": "too much"})
    if finish:
        recorder.finish({"stopped_because": "it was enough"})
    return recorder


def mend_checksums(folder):
    """Make the record of a changed recording match its files and itself."""
    record = json.loads((folder / RECORDING).read_text())
    record["files"] = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in (SCENERY, STEPS)}
    (folder / RECORDING).write_text(json.dumps(with_checksum(record)))


def _check(arrays, steps):
    assert len(arrays["phase"]) == steps
    for k in range(steps):
        wanted = _row(k)
        assert np.array_equal(arrays["images"][k], wanted.pop("images"))
        assert PHASES[arrays["phase"][k]] == wanted.pop("phase")
        assert all(np.array_equal(arrays[name][k], value) for name, value in wanted.items())


def test_recording_round_trip(tmp_path):
    _record(tmp_path / "run", 5)
    record, arrays = read_recording(tmp_path / "run")
    _check(arrays, 5)
    assert record["complete"] and record["steps"] == 5 and record["task"] == "surface"
    assert record["stopped_because"] == "it was enough"
    assert record["events"] == [{"step": 1, "kind": "force", "what": "too much"}]
    assert {p.name for p in (tmp_path / "run").iterdir()} == {RECORDING, SCENERY, STEPS, ".lock"}
    scenery = read_recorded_scene(tmp_path / "run")
    assert np.array_equal(scenery.object_vertices, SCENE.object_vertices) and scenery.with_arm is True
    assert scenery.tip_radius_m == 20e-3


def test_recording_without_steps_is_read(tmp_path):
    _record(tmp_path / "run", 0)
    record, arrays = read_recording(tmp_path / "run")
    assert record["steps"] == 0 and arrays["T_base_tcp"].shape == (0, 4, 4)


def test_kill_leaves_all_complete_steps(tmp_path):
    """The recording process is killed (kill -9) between two steps."""
    code = (
        "import sys, os, signal; sys.path[:0] = sys.argv[2:];"
        "from test_recording import _record; _record(sys.argv[1], 4, finish=False); os.kill(os.getpid(), signal.SIGKILL)"
    )
    here = os.path.dirname(os.path.abspath(__file__))
    folder = tmp_path / "run"
    ended = subprocess.run([sys.executable, "-c", code, str(folder), here, str(Path(here).parents[1])], timeout=120)
    assert ended.returncode == -signal.SIGKILL
    record, arrays = read_recording(folder)
    assert not record["complete"] and record["steps"] == 4
    assert [e["kind"] for e in record["events"]] == ["force"]
    _check(arrays, 4)
    with pytest.raises(TactipError, match="holds the steps of another run, which was interrupted"):
        Recorder(folder, {"task": "surface", "object": "bowl"}, SCENE)
    # The same command starts over in the same folder.
    _record(folder, 2)
    _check(read_recording(folder)[1], 2)


def test_log_for_which_the_disk_has_no_room_is_named(tmp_path):
    """The steps before are kept."""
    recorder = _record(tmp_path / "run", 3, finish=False)
    size = (tmp_path / "run" / LOG).stat().st_size
    with full_disk(size + 1000), pytest.raises(OSError, match="File too large") as raised:
        for k in range(3, 10):
            recorder.add(_row(k))
    assert raised.value.filename == str(tmp_path / "run" / LOG)
    _check(read_recording(tmp_path / "run")[1], 3)
    recorder.finish({})


@pytest.mark.parametrize("cut", [1, 50, 4000])
def test_truncated_recording_is_read_to_its_last_complete_step(tmp_path, cut):
    _record(tmp_path / "run", 6, finish=False)._open_files.close()
    path = tmp_path / "run" / LOG
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    record, arrays = read_recording(tmp_path / "run")
    assert record["steps"] == 5 if cut < 4000 else record["steps"] < 6
    _check(arrays, record["steps"])
    path.write_bytes(whole[:-cut] + b"\xff" * cut)  # as by a disk that wrote the length but not the data
    again, arrays = read_recording(tmp_path / "run")
    assert again["steps"] == record["steps"]


def test_two_commands_do_not_record_into_one_folder(tmp_path):
    first = Recorder(tmp_path / "run", {"task": "surface", "object": "plate"}, SCENE)
    with pytest.raises(TactipError, match="another command is recording"):
        Recorder(tmp_path / "run", {}, SCENE)
    first.finish({"task": "surface"})
    with pytest.raises(TactipError, match="is not empty"):
        Recorder(tmp_path / "run", {}, SCENE)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").write_text("work")
    with pytest.raises(TactipError, match="is not empty"):
        Recorder(tmp_path / "other", {}, SCENE)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        (RECORDING, b"{", "is not JSON"),
        (RECORDING, b"[1]", "is not a recording of this project"),
        (RECORDING, b'{"format": "else"}', "is not a recording of this project"),
        (
            RECORDING,
            json.dumps({"format": "tactip-twin recording", "version": 9}).encode(),
            "version 9, but this program reads version 6",
        ),
        (RECORDING, json.dumps({"format": "tactip-twin recording", "version": 6}).encode(), "was altered"),
        (RECORDING, json.dumps(with_checksum({"format": "tactip-twin recording", "version": 6})).encode(), "is damaged"),
        (STEPS, b"PK nothing", "was altered"),
        (STEPS, b"", "was altered"),
    ],
)
def test_folder_without_recording_is_refused(tmp_path, name, data, words):
    _record(tmp_path / "run", 3)
    (tmp_path / "run" / name).write_bytes(data)
    with pytest.raises(TactipError, match=words):
        read_recording(tmp_path / "run")


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(TactipError, match="there is no recording in"):
        read_recording(tmp_path)
    _record(tmp_path / "run", 1)
    for name, read in ((SCENERY, read_recorded_scene), (STEPS, read_recording)):
        (tmp_path / "run" / name).unlink()
        with pytest.raises(TactipError, match=f"{name} does not exist"):
            read(tmp_path / "run")


def test_triangles_of_missing_vertices_are_refused(tmp_path):
    """Libraries that draw triangles do not check their indices, and would crash."""
    _record(tmp_path / "run", 2)
    path = tmp_path / "run" / "scenery.npz"
    with np.load(path) as file:
        values = dict(file)
    for name, words in (("object_triangles", "must be indices of object_vertices"), ("skin_triangles", "must be indices")):
        np.savez(path, **values | {name: values[name] + 100_000})
        mend_checksums(tmp_path / "run")
        with pytest.raises(TactipError, match=words):
            check_skin(read_recorded_scene(tmp_path / "run"), read_recording(tmp_path / "run")[1])


@pytest.mark.parametrize("moment", range(4))
def test_recorder_killed_at_a_rename_begins_anew(tmp_path, monkeypatch, moment):
    """The renames are those of the scene, of the record at the start, of the steps, and of the record at the end."""
    names = []

    def killed(old, new):
        names.append(os.path.basename(new))
        if len(names) == moment + 1:
            raise Killed
        os.rename(old, new)

    recorders = []
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", killed)
        recorders.append(_record(tmp_path / "run", 3, finish=False))
        recorders[0].finish({"stopped_because": "it was enough"})
    for recorder in recorders:
        recorder._open_files.close()  # as the end of the process does
    assert names == [SCENERY, RECORDING, STEPS, RECORDING][: moment + 1]
    if moment > 1:
        _check(read_recording(tmp_path / "run")[1], 3)
    _record(tmp_path / "run", 5)
    _check(read_recording(tmp_path / "run")[1], 5)
    assert {p.name for p in (tmp_path / "run").iterdir()} == {RECORDING, SCENERY, STEPS, ".lock"}


def test_recorder_killed_before_it_removes_the_log_begins_anew(tmp_path):
    _record(tmp_path / "run", 3)
    (tmp_path / "run" / LOG).touch()
    _record(tmp_path / "run", 5)
    _check(read_recording(tmp_path / "run")[1], 5)


def test_altered_record_is_refused(tmp_path):
    """A number that is valid, but not what was recorded."""
    _record(tmp_path / "run", 2)
    path = tmp_path / "run" / RECORDING
    path.write_text(path.read_text().replace("it was enough", "it was too much"))
    with pytest.raises(TactipError, match=r"recording\.json was altered"):
        read_recording(tmp_path / "run")


def test_file_of_another_recording_is_refused(tmp_path):
    """It is whole, and has as many steps."""
    _record(tmp_path / "run", 2)
    other = Recorder(tmp_path / "other", {"task": "surface", "object": "plate"}, SCENE)
    for _ in range(2):
        other.add(_row(1))
    other.finish({})
    (tmp_path / "run" / STEPS).write_bytes((tmp_path / "other" / STEPS).read_bytes())
    with pytest.raises(TactipError, match=r"steps\.npz was altered"):
        read_recording(tmp_path / "run")


def test_recording_ends_where_its_reader_does(tmp_path, monkeypatch):
    """A recording that is full keeps the steps so far, and can be completed and read."""
    size = sum(np.asarray(value).nbytes for value in _stored(_row(0)).values())
    monkeypatch.setattr("tactip_twin.sim.robot.recording._MAX_STEPS_BYTES", 3 * size)
    recorder = Recorder(tmp_path / "run", {"task": "surface", "object": "plate"}, SCENE)
    for k in range(3):
        recorder.add(_row(k))
    with pytest.raises(RecordingFullError, match="which it has after 3 steps: record fewer steps"):
        recorder.add(_row(3))
    recorder.finish({})
    _check(read_recording(tmp_path / "run")[1], 3)


def _stored(row):
    """Return the arrays of a step as they are recorded."""
    types = {"pin_tips_m": "f4", "directions": "f4", "skin_m": "f4", "phase": "u1", "part": "i4", "sim_steps": "i4"}
    packed = np.packbits(row["images"] > 127, axis=-1)
    return {k: np.zeros(np.shape(v), types.get(k, "f8")) for k, v in row.items() if k not in ("images", "phase")} | {
        "images": packed, "phase": np.uint8(0)
    }  # fmt: skip
