"""Sets of contacts on a mesh: each is the press that the tip makes there, labelled relative to the surface there."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import tactip_twin as tt
from helpers.numbers import rms
from tactip_twin.commands import main as tactip
from tactip_twin.sim.contact.signed_distance import SignedDistanceMesh
from tactip_twin.sim.dataset.format import read_configuration, read_meta, read_pins
from tactip_twin.sim.dataset.object_options import ObjectOptions
from tactip_twin.sim.dataset.pressed_object import PressedObject, PressPlaces
from tactip_twin.sim.ground_truth import SurfaceGroundTruth
from tactip_twin.sim.pose import from_mm_deg, sensor_in_contact
from tactip_twin.sim.robot.recording import read_recording

MAKE = ["dataset", "make", "--fidelity", "draft", "--renderer", "raster", "--design", "nominal-127", "--workers", "1"]
FIXED = ["--pose.depth-mm", "-2", "-2", "--pose.roll-deg", "4", "4", "--pose.pitch-deg", "0", "0", "--shear.x-mm", "1", "1"]
FIXED += ["--shear.y-mm", "0", "0", "--shear.roll-deg", "0", "0", "--shear.pitch-deg", "0", "0", "--shear.yaw-deg", "0", "0"]


@pytest.fixture(scope="module")
def lens(tmp_path_factory):
    """A mesh file: a flattened sphere, 60 by 60 by 20 mm, its middle at the origin."""
    path = tmp_path_factory.mktemp("mesh") / "lens.stl"
    mesh = trimesh.creation.icosphere(3, 30.0)
    mesh.apply_scale([1, 1, 1 / 3])
    mesh.export(path)
    return path


@pytest.fixture(scope="module")
def made(lens):
    out = lens.parent / "set"
    assert (
        tactip.main([*MAKE, "--samples", "1", "--object", str(lens), "--at-mm", "8", "-5", *FIXED, "--out", str(out)]) == 0
    )
    return out


def test_contact_is_the_press_of_the_tip_there(made, lens):
    tip = tt.TacTip("nominal-127", "draft", "raster")
    contact = tip.press(lens, depth_mm=2, roll_deg=4, shear_mm=(1, 0), at_mm=(8, -5))
    tips, _ = read_pins(made, read_meta(made))
    assert rms(1e3 * tips[0] - contact.pins_mm) < 1e-3


def test_object_is_recorded_and_kept_without_the_file(made, tmp_path, capsys):
    meta = read_meta(made)
    assert meta["configuration"]["object"] | {"sha256": ""} == {
        "name": "lens",
        "sha256": "",
        "at_mm": [8.0, -5.0],
        "spread_mm": 0.0,
    }
    assert read_configuration(meta, made).object.name == "lens"
    assert tactip.main(["dataset", "verify", str(made)]) == 0
    assert tactip.main(["dataset", "record", str(made), "--model", "none", "--out", str(tmp_path / "run")]) == 0
    _, arrays = read_recording(tmp_path / "run")
    assert np.array_equal(arrays["pin_tips_m"][-1], read_pins(made, meta)[0][0])


def test_altered_object_is_noticed(made, lens, tmp_path, capsys):
    copy = tmp_path / "set"
    copy.mkdir()
    (copy / "images").symlink_to(made / "images")
    for path in (p for p in made.iterdir() if p.is_file()):
        (copy / path.name).write_bytes(path.read_bytes())
    (copy / "object.npz").write_bytes(b"")
    assert tactip.main(["dataset", "verify", str(copy)]) == 1
    assert "object.npz was altered" in capsys.readouterr().err
    arguments = [*MAKE, "--samples", "1", "--object", str(lens), "--at-mm", "8", "-5", *FIXED, "--scale", "1.5"]
    assert tactip.main([*arguments, "--out", str(copy)]) == 1
    assert "holds a data set with other settings (configuration.object.sha256 is" in capsys.readouterr().err


def test_label_is_relative_to_the_surface_at_each_place(lens):
    solid, rng = ObjectOptions(str(lens)).solid(), np.random.default_rng(0)
    places = PressPlaces(PressedObject("lens", "", (4.0, 0.0), 15.0), solid)
    label = from_mm_deg([0, 0, -1, 5, -3, 0])
    heights = []
    for _ in range(4):
        at = places.sample(rng)
        found = SurfaceGroundTruth(at).label(sensor_in_contact(label))
        assert np.allclose(1e3 * found[2], -1, atol=0.02)
        assert np.allclose(np.degrees(found[3:5]), [5, -3], atol=1.0)  # the facets' normals
        heights.append(at.vertices[:, 2].max())
    assert len(set(heights)) == 4


def test_places_are_on_the_object_alone():
    ring = trimesh.creation.annulus(8e-3, 12e-3, 6e-3)
    places = PressPlaces(PressedObject("ring", "", (0.0, 0.0), 14.0), SignedDistanceMesh(ring.vertices, ring.faces))
    rng = np.random.default_rng(0)
    for _ in range(5):
        distances = np.linalg.norm(places.sample(rng).vertices, axis=1)
        assert distances.max() < 28e-3  # the origin is on the ring
    with pytest.raises(tt.TactipError, match="at_mm must lie on the object ring, which has no surface at 0, 0 mm"):
        PressPlaces(PressedObject("ring", ""), SignedDistanceMesh(ring.vertices, ring.faces)).sample(rng)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--at-mm", "1", "1"], "need an --object"),
        (["--object", "nothing.stl"], "there is no mesh file nothing.stl"),
        (["--object", "plate", "--at-mm", "900", "0"], "has no surface at 900, 0 mm"),
        (["--object", "plate", "--task", "edge"], "an object needs the task 'surface', got 'edge'"),
        (["--object", "plate", "--augment-symmetry"], "cannot be combined with augment_symmetry"),
        (["--object", "plate", "--spread-mm", "-1"], "spread_mm must be a finite number from 0 to 10000, got -1"),
    ],
)
def test_unfit_options_are_refused_before_anything_is_written(tmp_path, capsys, options, words):
    assert tactip.main([*MAKE, *options, "--out", str(tmp_path / "set")]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


def test_sets_without_an_object_do_not_record_one(made):
    configuration = read_configuration(read_meta(made), made)
    assert "object" not in replace(configuration, object=None).as_json()
    assert "object" in json.dumps(configuration.as_json())
