"""Every kind of file that commands read: a small folder of each, and what reads it."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch
import trimesh

from helpers.learning_sets import add_pins, mend_checksums, write_fake_set, write_fake_splits
from helpers.rims import write_coarse_rim
from tactip_twin.assets.meshes.rims import RIMS
from tactip_twin.control.policy import Policy, read_policy, write_policy
from tactip_twin.learning.checkpoint import METRICS, load_checkpoint, provenance, read_metrics, save_checkpoint
from tactip_twin.learning.configuration import PoseNetConfig, SearchSpace, TrainSettings, TuneSettings
from tactip_twin.learning.data import read_samples, read_splits
from tactip_twin.learning.deviation_scale import DeviationScale
from tactip_twin.learning.labels import labels_of
from tactip_twin.learning.model import load_model, save_model
from tactip_twin.learning.outputs import Layout as OutputLayout
from tactip_twin.learning.posenet import PoseNet
from tactip_twin.learning.recipes import read_recipe
from tactip_twin.learning.search_space import network_of_values
from tactip_twin.learning.training import Training
from tactip_twin.learning.tune import (
    BEST,
    TRIAL,
    prepare_folder,
    read_result,
    read_results,
    record_start,
    suggest,
    trial_folder,
    write_results,
)
from tactip_twin.sim.dataset.contact_sheet import contact_sheet
from tactip_twin.sim.dataset.format import checksum, meta_json, read_configuration, read_meta, read_pins
from tactip_twin.sim.dataset.mesh_states import pack_mesh_states, read_mesh_states
from tactip_twin.sim.dataset.pressed_object import OBJECT, PressedObject, pack_object
from tactip_twin.sim.dataset.sample_maker import object_places
from tactip_twin.sim.dataset.shards import shards_of
from tactip_twin.sim.dataset.verify import verify
from tactip_twin.sim.fast_tip.fast_tip import (
    FastTip,
    PinDecoder,
    read_fast_tip,
    write_fast_tip,
)
from tactip_twin.sim.fast_tip.materials import mechanics_of
from tactip_twin.sim.fast_tip.measures import MEASURES
from tactip_twin.sim.fast_tip.network import Network
from tactip_twin.sim.fast_tip.overlap import MAX_ORDER, RINGS, OverlapModes
from tactip_twin.sim.fast_tip.skin_field import RING_ANGLES, Modes
from tactip_twin.sim.fast_tip.sliding_tip import Inputs, SlidingTip, Steps, read_sliding_tip, write_sliding_tip
from tactip_twin.sim.robot import objects
from tactip_twin.sim.robot.recording import (
    ARRAYS,
    RecordedScene,
    Recorder,
    check_skin,
    read_recorded_scene,
    read_recording,
)
from tactip_twin.sim.view.video import write_video
from tactip_twin.sim2real.calibration.parameters import SensorOnRig, parameters
from tactip_twin.sim2real.calibration.real_set import read_real_set
from tactip_twin.sim2real.calibration.rig import Rig
from tactip_twin.sim2real.calibration.state import read_state, write_state
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.frame_blobs import read_blobs
from tactip_twin.sim2real.importing.import_set import import_set, read_report
from tactip_twin.sim2real.importing.layout import Layout, read_layout
from tactip_twin.sim2real.importing.source import read_source
from tactip_twin.sim2real.sensor.video_frames import VideoFrames
from tactip_twin.tactip_model.design_file import design_as_dict, read_design, read_design_with_drift, write_fitted_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.neutral_image import neutral_px
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


@dataclass(frozen=True)
class FileKind:
    """A kind of folder. `root` holds one folder of each kind, undamaged, and sets to train on in `data`."""

    write: Callable[[Path, Path], object]
    """Write it: folder, root."""
    read: Callable[[Path, Path], str | None]
    """Read it as commands do: folder, root. Returns a checksum of what was read; None if nothing is protected by checksums,
    because people write or change such files."""


def hashed(*arrays):
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write_set(folder, root):
    write_fake_set(folder, samples=4)
    add_pins(folder, np.zeros((4, 127, 3)), np.ones((4, 127, 3)))


def write_set_of_meshes(folder, root):
    """Write a set that keeps its meshes."""
    write_fake_set(folder, samples=2, keep_mesh=True)
    add_pins(folder, np.zeros((2, 127, 3)), np.ones((2, 127, 3)))
    configuration = read_configuration(read_meta(folder), folder)
    vertices = build_mesh(configuration.design.shape, configuration.fidelity.mesh).vertices
    (folder / "mesh.npz").write_bytes(pack_mesh_states(configuration, [0, 1], [np.stack([vertices, vertices])] * 2))
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"files": meta["files"] | {"mesh.npz": ""}}))
    mend_checksums(folder)


def read_set_of_meshes(folder, root):
    read = read_set(folder, root)
    found = read_mesh_states(folder, read_meta(folder))
    return hashed(found.numbers, found.states, read.encode())


def write_set_on_object(folder, root):
    """Write a set whose contacts are on an object."""
    data = pack_object(objects.load_object("plate").solid)
    write_fake_set(folder, samples=2, object=PressedObject("plate", checksum(data)))
    (folder / OBJECT).write_bytes(data)


def read_set_on_object(folder, root):
    found = object_places(read_configuration(read_meta(folder), folder), folder)
    return hashed(found.sample(np.random.default_rng(0)).vertices)


def write_fast_tip_file(folder, root):
    """Write a learned tip of random weights."""
    rng, design = np.random.default_rng(0), design_named("nominal-127")

    def network(outputs):
        sizes = ((9, 8), (8, 8), (8, outputs))
        pairs = [(rng.normal(size=(after, before)), rng.normal(size=after)) for before, after in sizes]
        return Network(tuple(array.astype(np.float32) for pair in pairs for array in pair))

    modes = Modes(np.array([0, 1, 2]), rng.normal(size=(3, 6 * len(RING_ANGLES))))
    ones, ranges = np.ones(len(MEASURES)), np.tile([-1.0, 1.0], (12, 1))
    tip = FastTip(
        "surface", mechanics_of(design), modes, np.zeros(9), np.ones(9), (network(6), network(6)), np.ones(6),
        network(len(MEASURES)), 0 * ones, ones, ranges, 1.0, {},
    )  # fmt: skip
    write_fast_tip(tip, folder / "tip.npz")


def read_fast_tip_file(folder, root):
    tip = read_fast_tip(folder / "tip.npz")
    design = design_named("nominal-127")
    tip.check_design(design)
    found = tip.predict(PinDecoder(design, tip.modes), np.zeros((1, 6)), np.zeros((1, 6)))
    return hashed(found.pin_tips, found.forces_n)


def write_sliding_tip_file(folder, root):
    """Write a sliding tip of random weights."""
    rng, design = np.random.default_rng(0), design_named("nominal-127")
    inputs = Inputs("surface", 2, 2)

    def network(outputs):
        sizes = ((8, inputs.count), (8, 8), (outputs, 8))
        pairs = [(rng.normal(size=size), rng.normal(size=size[0])) for size in sizes]
        skip = rng.normal(size=(outputs, inputs.count)).astype(np.float32)
        return Network(tuple(array.astype(np.float32) for pair in pairs for array in pair), skip)

    modes = Modes(np.array([0, 1, 2]), rng.normal(size=(3, 6 * len(RING_ANGLES))))
    overlap = OverlapModes(np.array([0, 1]), rng.normal(size=(2, RINGS)))
    ones, extents = np.ones(len(MEASURES)), inputs.extents(np.zeros((1, inputs.count))).shape[1]
    tip = SlidingTip(
        "surface", mechanics_of(design), modes, overlap, 2, np.zeros(inputs.count), np.ones(inputs.count),
        (network(6), network(6)), np.ones(6), network(len(MEASURES)), 0 * ones, ones, np.tile([-1.0, 1.0], (extents, 1)),
        1.0, {},
    )  # fmt: skip
    write_sliding_tip(tip, folder / "tip.npz")


def read_sliding_tip_file(folder, root):
    tip = read_sliding_tip(folder / "tip.npz")
    tip.check_design(design_named("nominal-127"))
    still = Steps(np.zeros((1, 6)), np.zeros((1, 6)), np.zeros((1, RINGS, MAX_ORDER + 1), np.complex64), np.array([True]))
    found = tip.step(still, np.ones((1, len(tip.modes.orders)), np.complex64))
    return hashed(found.states, found.measures)


def write_policy_file(folder, root):
    """Write a policy of random weights."""
    rng = np.random.default_rng(0)
    weights = tuple(rng.normal(size=size).astype(np.float32) for size in ((4, 3), (4,), (2, 4), (2,)))
    policy = Policy("tactip_twin/EdgeFollow-v0", {"objects": ["plate"]}, np.ones(3, np.float32), weights, {})
    write_policy(policy, folder / "policy.npz")


def read_policy_file(folder, root):
    return hashed(read_policy(folder / "policy.npz")({"oracle": np.ones(3, np.float32)}))


def read_set(folder, root):
    samples = read_samples(folder)
    problems = verify(folder)
    tips, directions = read_pins(folder, samples.dataset.meta)
    read = hashed(samples.images, samples.targets, samples.shears, tips, directions, contact_sheet(folder))
    if problems:
        raise TactipError(problems[0])
    return read


def write_shards(folder, root):
    """Write a set of two shards of three samples."""
    write_fake_set(folder.parent / "whole", samples=6, shard_samples=3)
    meta = read_meta(folder.parent / "whole")
    configuration, sums = read_configuration(meta, folder), {}
    for name, part in shards_of(configuration):
        write_fake_set(folder / name, samples=3, shard_samples=3)
        own = json.loads((folder / name / "meta.json").read_text())
        (folder / name / "meta.json").write_text(json.dumps(own | {"configuration": part.as_json()}))
        add_pins(folder / name, np.zeros((3, 127, 3)), np.ones((3, 127, 3)))
        mend_checksums(folder / name)
        sums[f"{name}/meta.json"] = checksum((folder / name / "meta.json").read_bytes())
    counts = {"asked": 6, "kept": 6, "failed": 0}
    shards = [name for name, _ in shards_of(configuration)]
    (folder / "meta.json").write_bytes(meta_json(configuration, counts, sums, {"shards": shards}))


def read_shards(folder, root):
    samples = read_samples(folder)
    return hashed(samples.images, samples.targets, samples.shears, *read_pins(folder, samples.dataset.meta))


def write_model(folder, root):
    config = PoseNetConfig(conv_layers=2, filters=2, dense_units=4, deviations=True, quantities=True)
    labels = labels_of({"task": "surface", "pose": {"depth_mm": [-5, -1], "roll_deg": [-15, 15], "pitch_deg": [-15, 15]}})
    torch.manual_seed(0)
    layout = OutputLayout(config, labels)
    scale = DeviationScale((0.1, 1.0), ((1.5,) * layout.components, (1.1,) * layout.components))
    save_model(folder, PoseNet(config, 40, layout.size).state_dict(), config, labels, 40, {}, scale)


def read_model(folder, root):
    found = load_model(folder).estimate(np.full((1, 40, 40), 255, np.uint8))
    return hashed(found.means, found.deviations, found.contact)


NET, EPOCHS = PoseNetConfig(conv_layers=2, filters=2, dense_units=4), TrainSettings(epochs=3)


def write_training(folder, root):
    """Write a training that was interrupted after two epochs."""
    splits = read_splits(root / "data")
    training = Training(*splits, NET, EPOCHS, "cpu")
    for _ in range(2):
        training.train_epoch()
        save_checkpoint(training, folder, provenance(*splits, NET, EPOCHS))


def read_training(folder, root):
    splits = read_splits(root / "data")
    state = load_checkpoint(folder, provenance(*splits, NET, EPOCHS))
    training = Training(*splits, NET, EPOCHS, "cpu")
    read_metrics(folder)
    if not isinstance(state, dict):
        raise TactipError("the checkpoint is gone, so the training would not be resumed")
    training.restore(state)
    return hashed(*(tensor.numpy() for tensor in training.net.state_dict().values()), json.dumps(training.history).encode())


SPACE = SearchSpace(max_conv_layers=2, max_filters=4, max_dense_layers=2, max_dense_units=8)
SEARCH = TuneSettings(trials=4, random_trials=2, space=SPACE, training=EPOCHS)


def write_search(folder, root):
    """Write a search after three trials: one that ended well, one that was pruned and one that failed."""
    prepare_folder(folder, root / "data", SEARCH)
    results = []
    for index, status in enumerate(("ok", "pruned", "failed")):
        values = suggest(SEARCH, index, results)
        record_start(folder, index, {"trial": index, "values": values})
        result = {"trial": index, "values": values, "status": status, "loss": 0.5, "why": "too slow", "epochs": 1}
        results.append(result | {"network": dataclasses.asdict(network_of_values(SPACE, values)), "seconds": 1.0})
        (trial_folder(folder, index) / TRIAL).write_text(json.dumps(results[-1]))
        figures = {"epoch": 1, "loss": 1.0, "val_loss": 0.5, "seconds": 1.0}
        (trial_folder(folder, index) / METRICS).write_text(json.dumps(figures) + "\n")
    write_results(folder, results, SEARCH)


def read_search(folder, root):
    prepare_folder(folder, root / "data", SEARCH)
    results = read_results(folder, SPACE)
    for index in range(3):
        read_result(folder, index, SPACE, "the trial wrote no result")
        read_metrics(trial_folder(folder, index))
    suggest(SEARCH, 3, results)
    write_results(folder.parent, results, SEARCH)
    read_recipe(folder / BEST)


def write_recording(folder, root):
    box = trimesh.creation.box((0.05, 0.05, 0.02))
    scene = RecordedScene(box.vertices, box.faces, np.eye(4), np.array([[0, 1, 2]]), 0.02, False)
    recorder = Recorder(folder, {"task": "surface", "object": "plate"}, scene)
    for k in range(3):
        row = {name: np.full([n or 3 for n in shape], float(k)) for name, shape in ARRAYS.items()}
        recorder.add(row | {"phase": "follow", "images": np.zeros((16, 16), np.uint8)})
    recorder.note({"step": 1, "kind": "force", "what": "too much"})
    recorder.finish({"stopped_because": "the route is complete"})


def read_run(folder, root):
    (record, arrays), scene = read_recording(folder), read_recorded_scene(folder)
    check_skin(scene, arrays)
    text = json.dumps(record, sort_keys=True).encode()
    return hashed(*arrays.values(), scene.object_vertices, scene.object_triangles, text)


def write_meshes(folder, root):
    for ending in ("ply", "stl", "obj", "glb"):
        trimesh.creation.icosphere(1, 20).export(folder / f"mesh.{ending}")


def read_meshes(folder, root):
    for ending in ("ply", "stl", "obj", "glb"):
        objects.load_object(folder / f"mesh.{ending}")


def write_object(folder, root):
    """Write an object of the project's own, with its edge."""
    write_coarse_rim("rim-square", RIMS["rim-square"], folder)


def read_object(folder, root):
    with mock.patch.object(objects, "MESHES", folder):
        objects.load_object("rim-square")


def write_design(folder, root):
    write_fitted_design(folder / "design.json", design_named("tactip-127"), {"fitted": "to nothing"})


def read_designs(folder, root):
    read_design(folder / "design.json")
    read_design_with_drift(folder / "design.json")


def write_layout(folder, root):
    (folder / "layout.json").write_text(json.dumps(Layout().as_dict()))


def write_recipe(folder, root):
    (folder / "recipe.json").write_text(json.dumps({"network": {"filters": 8}, "settings": {"epochs": 3}}))


def frame(design, zoom=1.0):
    """Return a binary frame of a tip whose pins are spread by a zoom, (256, 256) uint8."""
    tips, directions = neutral_pins(design)
    settings = dataclasses.replace(design.image, size_px=256)
    return tactile_image(Raster(design).render(tips * [zoom, zoom, 1.0], directions), settings)


def write_frames(folder, count):
    """Write a neutral image and pressed frames of a nominal tip."""
    (folder / "images").mkdir(parents=True)
    design = design_named("nominal-127")
    cv2.imwrite(str(folder / "init_0.png"), frame(design))
    for k in range(count):
        cv2.imwrite(str(folder / "images" / f"frame_{k}.png"), frame(design, 1.02 + 0.01 * k))


def write_laboratory(folder, root):
    """Write frames, table and layout as a laboratory has them."""
    write_frames(folder, 3)
    rows = [f"frame_{k}.png,0,{-1 - k},{5 * k},1" for k in range(3)]
    (folder / "targets.csv").write_text("\n".join(["image_name,pose_1,pose_2,pose_6,move_1", *rows]) + "\n")
    columns = ("pose_z=-pose_2-5", "pose_Ry=pose_6", "shear_x=move_1")
    (folder / "layout.json").write_text(json.dumps(Layout(ColumnMap(columns=columns)).as_dict()))


def import_laboratory(folder, out):
    layout = read_layout(folder / "layout.json")
    import_set(read_source(folder, layout.column_map), layout, out, log=lambda line: None, quiet=True)


def read_laboratory(folder, root):
    out = folder.parent / "imported"
    shutil.rmtree(out, ignore_errors=True)
    import_laboratory(folder, out)
    assert not verify(out)


def write_imported(folder, root):
    import_laboratory(root / "laboratory", folder)


def read_imported(folder, root):
    samples = read_samples(folder)
    report = json.dumps(read_report(folder), sort_keys=True).encode()
    problems = verify(folder)
    if problems:
        raise TactipError(problems[0])
    blobs = read_blobs(folder, samples.dataset.meta)
    return hashed(samples.images, samples.targets, samples.shears, report, np.array(list(blobs)), *blobs.values())


def write_rig(folder, root):
    """Write frames with the commands of the rig that took them."""
    write_frames(folder, 3)
    names = [f"{kind}_{k}" for kind in ("pose", "move") for k in range(1, 7)]
    rows = [f"frame_{k}.png,0,{-1 - k},0,0,0,7,1,0,0,0,0,2" for k in range(3)]
    (folder / "targets.csv").write_text("\n".join([",".join(["image_name", *names]), *rows]) + "\n")
    (folder / "meta.json").write_text(json.dumps({"tap_move": [0, 5, 0, 0, 0, 0]}))


def read_rig(folder, root):
    real = read_real_set(folder)
    for index in range(len(real.files)):
        real.frame(index)


DESIGN = design_named("nominal-127")
CHOSEN, IDENTITY = parameters(DESIGN), {"real": "rig", "design": design_as_dict(DESIGN)}


def write_calibration(folder, root):
    twin = SensorOnRig(DESIGN, Rig())
    identity = json.loads(json.dumps(IDENTITY))
    write_state(folder / "state.json", identity, twin, np.ones(len(CHOSEN)), [{"cost": 1.0}], CHOSEN)


def read_calibration(folder, root):
    identity = json.loads(json.dumps(IDENTITY))
    found = read_state(folder / "state.json", identity, SensorOnRig(DESIGN, Rig()), CHOSEN, neutral_px(DESIGN))
    return hashed(np.array([p.read(found[0]) for p in CHOSEN]), found[1], json.dumps(found[2]).encode())


def write_videos(folder, root):
    image = np.repeat(frame(DESIGN)[..., None], 3, axis=-1)
    write_video(folder / "video.mp4", [image] * 4)


def read_videos(folder, root):
    video = VideoFrames(folder / "video.mp4")
    try:
        for _ in video:
            pass
    finally:
        video.close()


KINDS = {
    "set": FileKind(write_set, read_set),
    "shards": FileKind(write_shards, read_shards),
    "model": FileKind(write_model, read_model),
    "training": FileKind(write_training, read_training),
    "search": FileKind(write_search, read_search),
    "set of meshes": FileKind(write_set_of_meshes, read_set_of_meshes),
    "set on an object": FileKind(write_set_on_object, read_set_on_object),
    "learned tip": FileKind(write_fast_tip_file, read_fast_tip_file),
    "sliding tip": FileKind(write_sliding_tip_file, read_sliding_tip_file),
    "policy": FileKind(write_policy_file, read_policy_file),
    "recording": FileKind(write_recording, read_run),
    "design": FileKind(write_design, read_designs),
    "layout": FileKind(write_layout, lambda folder, root: read_layout(folder / "layout.json") and None),
    "recipe": FileKind(write_recipe, lambda folder, root: read_recipe(folder / "recipe.json") and None),
    "mesh": FileKind(write_meshes, read_meshes),
    "object": FileKind(write_object, read_object),
    "laboratory": FileKind(write_laboratory, read_laboratory),
    "imported": FileKind(write_imported, read_imported),
    "rig": FileKind(write_rig, read_rig),
    "calibration": FileKind(write_calibration, read_calibration),
    "video": FileKind(write_videos, read_videos),
}


def write_kinds(root):
    """Write a folder of each kind into `root`, and the sets that trainings use."""
    write_fake_splits(root / "data", samples=16)
    for name, kind in KINDS.items():
        (root / name).mkdir()
        kind.write(root / name, root)
    return root
