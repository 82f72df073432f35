"""Grey images and other sizes, from a set to the commands that use a network: recorded, learned, not mixed up."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.laboratory import COLUMNS
from tactip_twin.commands import main as tactip
from tactip_twin.commands._pose_reader import load_pose_reader
from tactip_twin.control.estimator import NetworkEstimator
from tactip_twin.learning.data import read_samples
from tactip_twin.learning.model import load_network
from tactip_twin.sim.contact.tip_state import TipState
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_pins
from tactip_twin.sim.robot.recording import read_recording
from tactip_twin.sim2real.sensor.live import LiveSensor
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image

SIZE = 48
MAKE = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127", "--workers", "1"]
TINY = ["--training.min-steps", "0", "--network.conv-layers", "2", "--network.filters", "2", "--network.max-filters", "2"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The grey sets of a task."""
    folder = tmp_path_factory.mktemp("grey")
    options = ["--split", "all", "--samples", "3", "--grey", "--size-px", str(SIZE), "--out", str(folder)]
    assert tactip.main([*MAKE, *options]) == 0
    return folder / "surface"


@pytest.fixture(scope="module")
def trained(made):
    """A folder of a network that learned from them."""
    out = made.parent / "run"
    assert tactip.main(["train", "--data", str(made), "--out", str(out), "--training.epochs", "1", *TINY]) == 0
    return out


@pytest.fixture(scope="module")
def binary(made):
    """A set of binary images of the same size."""
    assert tactip.main([*MAKE, "--samples", "2", "--size-px", str(SIZE), "--out", str(made.parent / "binary")]) == 0
    return made.parent / "binary"


def test_grey_set_has_the_frames_of_its_pins(made):
    samples, meta = read_samples(made / "train"), read_meta(made / "train")
    design = read_configuration(meta, made / "train").design
    assert samples.grey and samples.size == design.image.size_px == SIZE
    tips, directions = read_pins(made / "train", meta)
    frame = Raster(design).render(tips[1].astype(float), directions[1].astype(float))
    small = cv2.resize(frame, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    assert np.abs(samples.images[1].astype(int) - small).max() <= 1 and len(np.unique(small)) > 20
    assert tactip.main(["dataset", "verify", str(made / "train")]) == 0


def test_binary_set_does_not_record_what_it_does_not_have(binary):
    meta = read_meta(binary)
    assert meta["configuration"]["design"]["image"]["size_px"] == SIZE
    assert "grey" not in json.dumps(meta) and not read_samples(binary).grey


def test_wrong_size_is_one_sentence(tmp_path, capsys):
    assert tactip.main([*MAKE, "--size-px", "4", "--out", str(tmp_path / "set")]) == 1
    assert "size_px must be a whole number from 8 to 4096, got 4" in capsys.readouterr().err


def test_network_of_grey_images_is_trained_evaluated_and_keeps_to_them(made, trained, binary, tmp_path, capsys):
    model = load_network(trained)
    assert model.grey and model.size == SIZE
    assert tactip.main(["evaluate", "--model", str(trained), "--data", str(made / "test")]) == 0
    assert tactip.main(["evaluate", "--model", str(trained), "--data", str(binary)]) == 1
    assert f"the images in {binary} are binary, but the model uses grey ones" in capsys.readouterr().err
    rendered = ["--training.augmented-fraction", "0.5", "--out", str(tmp_path / "run")]
    assert tactip.main(["train", "--data", str(made), *rendered, *TINY]) == 1
    assert "are grey, but images that are rendered again are binary: set augmented_fraction" in capsys.readouterr().err
    (tmp_path / "mixed").mkdir()
    for split, folder in (("train", made / "train"), ("val", binary)):
        (tmp_path / "mixed" / split).symlink_to(folder)
    assert tactip.main(["train", "--data", str(tmp_path / "mixed"), "--out", str(tmp_path / "other")]) == 1
    assert "are binary, but the training set in" in capsys.readouterr().err


def test_servo_gives_a_network_the_images_that_it_learned(trained, design):
    model = load_network(trained)
    with pytest.raises(TactipError, match=f"must be {SIZE} px wide, as the network's, got 128 px"):
        NetworkEstimator(model, design, "raster")
    small = replace(design, image=replace(design.image, size_px=SIZE))
    tips, directions = neutral_pins(design)
    state = TipState(tips, directions, tips, np.zeros(3), 0, 0, 1)
    found = NetworkEstimator(model, small, "raster").estimate(state, np.eye(4))
    grey = tactile_image(Raster(design).render(tips, directions), replace(small.image, grey=True))
    label = 1e3 * found.label[2], *np.degrees(found.label[3:5])
    assert np.allclose(label, model.predict(grey))
    assert found.image is not None and set(np.unique(found.image)) == {0, 255} and found.touching == 0


def test_pose_beside_an_image_needs_the_same_images(trained, design):
    made_by = replace(design, name="tactip-127", image=replace(design.image, size_px=SIZE, grey=True))
    assert load_pose_reader(str(trained), "surface", made_by) is not None
    assert load_pose_reader("", "surface", made_by) is None  # the shipped network does not fit
    with pytest.raises(TactipError, match="expects grey images of 48 px, but the design produces binary ones of 128 px"):
        load_pose_reader(str(trained), "surface", design)


def test_recording_of_a_grey_sample_has_binary_images(made, trained, tmp_path):
    options = ["--model", str(trained), "--out", str(tmp_path / "run")]
    assert tactip.main(["dataset", "record", str(made / "train"), *options]) == 0
    _, arrays = read_recording(tmp_path / "run")
    assert arrays["images"].shape[1:] == (SIZE, SIZE)
    assert arrays["images"].max() == 255  # the pins' grey is below half of white
    assert np.isfinite(arrays["predicted"][-1, 2])


def test_camera_gives_grey_images_to_networks_that_learned_them(trained, design):
    grey = Raster(design).render(*neutral_pins(design))
    frames = [cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)] * 2
    options = ImagePreprocessing(threshold=(61, -5.0), size_px=SIZE, grey=True, mask="none")
    model = load_network(trained)
    readings = list(LiveSensor(frames, options, model))
    expected = tactile_image(grey, replace(design.image, size_px=SIZE, grey=True))
    assert readings[1].pins == 127 and np.array_equal(readings[1].image, expected)
    with pytest.raises(TactipError, match="grey must be True for this network, got False"):
        LiveSensor(frames, replace(options, grey=False), model)
    masked = next(iter(LiveSensor(frames, replace(options, mask="pins"), model))).image
    assert masked[0, 0] == 0 < expected[0, 0] and masked.max() == expected.max()


def test_import_keeps_grey_levels(tmp_path, design):
    lab = tmp_path / "lab"
    (lab / "images").mkdir(parents=True)
    (tips, directions), rows = neutral_pins(design), ["image_name,pose_1,pose_2,pose_6,move_1"]
    for k in range(6):
        frame = Raster(design).render(tips * [1 + 0.01 * k, 1 + 0.01 * k, 1], directions)
        cv2.imwrite(str(lab / ("init_0.png" if k == 0 else f"images/frame_{k}.png")), frame)
        rows += [f"frame_{k}.png,0,{k - 5},{2 * k},1"] if k else []
    (lab / "targets.csv").write_text("\n".join(rows) + "\n")
    options = ["--columns", *COLUMNS, "--threshold", "61", "-5", "--mask", "none", "--size-px", str(SIZE)]
    assert tactip.main(["import", str(lab), "--out", str(tmp_path / "grey"), "--grey", *options]) == 0
    assert tactip.main(["import", str(lab), "--out", str(tmp_path / "binary"), *options]) == 0
    grey, binary = read_samples(tmp_path / "grey"), read_samples(tmp_path / "binary")
    assert grey.grey and not binary.grey
    assert "grey" not in read_meta(tmp_path / "binary")["configuration"]["layout"]
    last = tactile_image(frame, replace(design.image, size_px=SIZE, grey=True))
    assert np.array_equal(grey.images[-1], last) and set(np.unique(binary.images)) == {0, 255}
    assert tactip.main(["transfer", "zero-shot", "--real", str(tmp_path / "grey"), "--out", str(tmp_path / "out")]) == 1
