"""Images unlike those that a network learned are counted: the reason in words, and no false alarm on the same sensor."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.learning_sets import mend_checksums
from tactip_twin.commands import main as tactip
from tactip_twin.learning.image_check import image_check
from tactip_twin.learning.model import Model, load_network
from tactip_twin.sim2real.sensor.live import LiveSensor
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing
from tactip_twin.tactip_model.design_file import write_design
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import design_named
from tactip_twin.tactip_model.raster_renderer import Raster
from tactip_twin.tactip_model.tactile_image import tactile_image


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A set of the sensor of the shipped networks."""
    folder = tmp_path_factory.mktemp("sets") / "set"
    given = ["--samples", "24", "--augment-symmetry", "--fidelity", "draft", "--renderer", "raster", "--workers", "1"]
    assert tactip.main(["dataset", "make", "--design", "tactip-127", "--split", "test", "--out", str(folder), *given]) == 0
    return folder


@pytest.fixture(scope="module")
def images(pressed):
    files = sorted((pressed / "images").glob("*.png"))
    return np.stack([cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_GRAYSCALE) for file in files])


@pytest.fixture(scope="module")
def check():
    check = image_check(load_network("surface-tactip-127"))
    assert check
    return check


def neutral(name):
    design = design_named(name)
    return tactile_image(Raster(design).render(*neutral_pins(design)), replace(design.image, size_px=128))


def without_pins(images, fraction):
    """Return the images without a random fraction of their pins."""
    rng, out = np.random.default_rng(0), []
    for image in images:
        count, labels = cv2.connectedComponents((image > 127).astype(np.uint8))
        gone = rng.random(count) < fraction
        out.append(np.where(gone[labels], 0, image))
    return np.stack(out).astype(np.uint8)


def covered(images):
    """Return the images with the left half of the lens covered."""
    out = images.copy()
    out[:, :, :64] = 0
    return out


def test_images_of_the_same_sensor_are_like_those_learned(check, images):
    assert check.of(images) == (0.0, "")
    assert check.problem(neutral("tactip-127")) == check.problem(neutral("nominal-127")) == ""


@pytest.mark.parametrize(
    ("change", "reasons"),
    [
        (covered, {"the white area of the emptiest sector"}),
        (lambda images: without_pins(images, 0.5), {"the white area of the emptiest sector", "the number of pins"}),
        (np.zeros_like, {"the number of pins", "the white area", "the spacing of the pins"}),
        (lambda images: 255 - images, {"the number of pins", "the white area", "the spacing of the pins"}),
    ],
)
def test_changed_images_are_all_unlike(check, images, change, reasons):
    fraction, reason = check.of(change(images))
    assert fraction == 1.0 and reason in reasons


def test_other_pin_layout_is_unlike(check):
    assert check.problem(neutral("tactip-331")) == "the white area"


def test_training_without_design_has_no_check():
    model = load_network("surface-tactip-127")
    assert image_check(Model(model.net, model.config, model.labels, model.size, {})) is None


def test_evaluate_tells_unlike_images_in_words_and_json(pressed, images, tmp_path, capsys):
    command = ["evaluate", "--model", "surface-tactip-127", "--data"]
    assert tactip.main([*command, str(pressed), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["unlike_image_fraction"] == 0 and "unlike" not in err
    folder = tmp_path / "covered"
    write_changed(pressed, folder, covered(images))
    assert tactip.main([*command, str(folder), "--json"]) == 0
    out, err = capsys.readouterr()
    figures = json.loads(out)
    assert (figures["unlike_image_fraction"], figures["unlike_in"]) == (1, "the white area of the emptiest sector")
    assert "100% of the images are unlike those that the network learned" in err


def write_changed(source, folder, images):
    """Write a set with other images."""
    shutil.copytree(source, folder)
    for file, image in zip(sorted((folder / "images").glob("*.png")), images, strict=True):
        cv2.imwrite(str(file), image)
    mend_checksums(folder)


def in_color(*images):
    """Return images (n, n) with three channels."""
    return [np.repeat(image[..., None], 3, axis=-1) for image in images]


def test_live_sensor_tells_another_sensor_by_its_pins_at_rest(images):
    """As many pins, but elsewhere: no frame has another fault."""
    frame, at_rest = in_color(images[0], neutral("nominal-127"))
    moved = np.roll(at_rest, 5, 1)
    (own,) = LiveSensor([frame], ImagePreprocessing(), load_network("surface-tactip-127"), at_rest)
    (other,) = LiveSensor([frame], ImagePreprocessing(), load_network("surface-tactip-127"), moved)
    assert own.unlike == "" and re.fullmatch(r"the places of the pins at rest, \d\.\d px of 256 away", other.unlike)


def test_evaluate_of_another_sensor_is_doubted(pressed, tmp_path, capsys):
    given = ["--samples", "8", "--fidelity", "fast", "--renderer", "raster", "--workers", "1"]
    design = tmp_path / "turned.json"
    own = design_named("tactip-127")
    write_design(design, replace(own, pins=replace(own.pins, rotation_deg=own.pins.rotation_deg + 20)), {})
    out = str(tmp_path / "set")
    assert tactip.main(["dataset", "make", "--design", str(design), "--split", "test", "--out", out, *given]) == 0
    capsys.readouterr()
    assert tactip.main(["evaluate", "--model", "surface-tactip-127", "--data", out]) == 0
    said = capsys.readouterr().err
    assert re.search(r"the pins at rest are \d\.\d px of 256 from those that the network learned \(at most 2\)", said)
    assert re.search(r"only \d+% of the labels of pose_\w+ are inside of the network's 95 % intervals", said)
    assert tactip.main(["evaluate", "--model", "surface-tactip-127", "--data", str(pressed)]) == 0
    assert "the pins at rest" not in capsys.readouterr().err


def test_live_sensor_tells_unlike_frames(images):
    """A sector of the lens is covered after the first frame: most pins are there, so the frame has no other fault."""
    masked = images[0].copy()
    masked[:40, 40:88] = 0
    *frames, at_rest = in_color(images[0], masked, neutral("tactip-127"))
    whole, part = LiveSensor(frames, ImagePreprocessing(), load_network("surface-tactip-127"), at_rest)
    assert whole.unlike == "" and "unlike" not in whole.as_json()
    assert part.as_json()["unlike"] == "the white area of the emptiest sector" and part.predicted
