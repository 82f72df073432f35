"""A seeded fuzzer: whatever is done to a file, readers refuse it in one sentence, or their result is unchanged."""

import hashlib
import json
import shutil
import time

import numpy as np
import pytest
import torch
import trimesh

from helpers.learning_sets import add_pins, write_fake_set
from tactip_twin.learning.configuration import PoseNetConfig
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.labels import labels_of
from tactip_twin.learning.model import load_model, save_model
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.learning.recipes import read_recipe
from tactip_twin.sim.dataset.contact_sheet import contact_sheet
from tactip_twin.sim.dataset.format import read_pins
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.robot.objects import load_object
from tactip_twin.sim.robot.recording import (
    ARRAYS,
    RecordedScene,
    Recorder,
    check_skin,
    read_recorded_scene,
    read_recording,
)
from tactip_twin.sim2real.importing.layout import Layout, read_layout
from tactip_twin.tactip_model.design_file import read_design, read_design_with_drift, write_fitted_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.presets import design_named

QUICK, SLOW = 400, 10_000

MAX_SECONDS = 10

ODD_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    1.5,
    1e308,
    2**70,
    "",
    "x",
    "\0",
    "../x",
    "/dev/zero",
    [],
    [None],
    [[1]],
    {},
    {"a": 1},
)


def hashed(*arrays):
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write_model(folder):
    config = PoseNetConfig(conv_layers=2, filters=2, dense_units=4)
    labels = labels_of({"task": "surface", "pose": {"depth_mm": [-5, -1], "roll_deg": [-15, 15], "pitch_deg": [-15, 15]}})
    torch.manual_seed(0)
    save_model(folder, PoseNet(config, 40, 3).state_dict(), config, labels, 40, {})


def write_recording(folder):
    box = trimesh.creation.box((0.05, 0.05, 0.02))
    scene = RecordedScene(box.vertices, box.faces, np.eye(4), np.array([[0, 1, 2]]), 0.02, False)
    recorder = Recorder(folder, {"task": "surface", "object": "plate"}, scene)
    for k in range(3):
        row = {name: np.full([n or 3 for n in shape], float(k)) for name, shape in ARRAYS.items()}
        recorder.add(row | {"phase": "follow", "images": np.zeros((16, 16), np.uint8)})
    recorder.note({"step": 1, "kind": "force", "what": "too much"})
    recorder.finish({"stopped_because": "the route is complete"})


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """One folder of each kind of file that commands read."""
    root = tmp_path_factory.mktemp("originals")
    write_fake_set(root / "set", samples=4)
    add_pins(root / "set", np.zeros((4, 127, 3)), np.ones((4, 127, 3)))
    for name in ("model", "recording", "design", "layout", "mesh", "recipe"):
        (root / name).mkdir()
    write_model(root / "model")
    write_recording(root / "recording")
    write_fitted_design(root / "design" / "design.json", design_named("tactip-127"), {"fitted": "to nothing"})
    (root / "layout" / "layout.json").write_text(json.dumps(Layout().as_dict()))
    (root / "recipe" / "recipe.json").write_text(json.dumps({"network": {"filters": 8}, "settings": {"epochs": 3}}))
    for ending in ("ply", "stl", "obj"):
        trimesh.creation.icosphere(1, 20).export(root / "mesh" / f"mesh.{ending}")
    return root


def read_set(folder):
    samples = read_samples(folder)
    problems = verify(folder)
    tips, directions = read_pins(folder, samples.dataset.meta)
    read = hashed(samples.images, samples.targets, samples.shears, tips, directions, contact_sheet(folder))
    if problems:
        raise TactipError(problems[0])
    return read


def read_model(folder):
    model = load_model(folder)
    return hashed(model.predict(np.full((1, 40, 40), 255, np.uint8)))


def read_run(folder):
    (record, arrays), scene = read_recording(folder), read_recorded_scene(folder)
    check_skin(scene, arrays)
    # A damaged record may be what an interrupted run leaves: then nothing is shown as if it were whole.
    return hashed(*arrays.values(), scene.object_vertices, scene.object_triangles) if record["complete"] else None


def read_meshes(folder):
    for path in sorted(folder.glob("*")):
        load_object(path)


def read_designs(folder):
    read_design(folder / "design.json")
    read_design_with_drift(folder / "design.json")


READERS = {
    "set": read_set,
    "model": read_model,
    "recording": read_run,
    "design": read_designs,
    "layout": lambda folder: read_layout(folder / "layout.json"),
    "mesh": read_meshes,
    "recipe": lambda folder: read_recipe(folder / "recipe.json"),
}
"""Readers by kind; those of what other people write by hand return nothing, because a change can be what they want."""

SIGNED = ("set", "model", "recording")


def damage_bytes(data, rng):
    """Return bytes with one random damage."""
    at = int(rng.integers(max(1, len(data))))
    kind = rng.integers(6)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return b""
    if kind == 2:
        return data + rng.bytes(20)
    if kind == 3:
        return data[:at] + rng.bytes(8) + data[at + 8 :]
    if kind == 4:
        return data[:at] + data[at + int(rng.integers(1, 40)) :]
    return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :] if data else b"x"


def damage_json(data, rng):
    """Return JSON in which one random value is replaced or removed, or that is nested deeply."""
    value = json.loads(data)
    if rng.random() < 0.05:
        return b"[" * 100_000
    place, key = value, None
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(place[key], dict | list) or not place[key] or rng.random() < 0.3:
            break
        place = place[key]
    if rng.random() < 0.2:
        del place[key]
    else:
        place[key] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    return json.dumps(value).encode()


def mutated_is_refused_or_unchanged(originals, folder, kind, seed):
    """Damage one file of a kind, and assert what its reader does."""
    rng = np.random.default_rng((seed, sorted(READERS).index(kind)))
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(originals / kind, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".lock"))
    path = files[int(rng.integers(len(files)))]
    data = path.read_bytes()
    path.write_bytes((damage_json if path.suffix == ".json" and rng.random() < 0.6 else damage_bytes)(data, rng))
    start = time.monotonic()
    try:
        result = READERS[kind](folder)
    except TactipError as error:
        assert str(error)
        assert "\n" not in str(error).strip()
        result = None
    assert time.monotonic() - start < MAX_SECONDS
    if kind in SIGNED and result is not None:
        assert result == READERS[kind](originals / kind), f"{path.name}: another result without an error"


@pytest.mark.parametrize("kind", READERS)
def test_mutated_file_is_refused_or_read_unchanged(originals, tmp_path, kind):
    for seed in range(QUICK // len(READERS)):
        mutated_is_refused_or_unchanged(originals, tmp_path / "copy", kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
def test_many_mutated_files_are_refused_or_read_unchanged(originals, tmp_path, kind):
    for seed in range(QUICK, QUICK + SLOW // len(READERS)):
        mutated_is_refused_or_unchanged(originals, tmp_path / "copy", kind, seed)
