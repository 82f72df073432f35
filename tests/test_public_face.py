"""The public interface: its exports, and that it never returns an untrusted contact."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh

import tactip_twin as tt
from tactip_twin.sim.contact.record import QualityLimits
from tactip_twin.sim.contact.simulator import ContactSimulator
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.renderer import renderer_named
from tactip_twin.tactip_model.tactile_image import tactile_image


@pytest.fixture(scope="module")
def tip():
    return tt.TacTip("tactip-127", fidelity="draft", renderer="raster")


def ring():
    """Return a flat ring, m: 16 to 24 mm across, 6 mm high."""
    return trimesh.creation.annulus(8e-3, 12e-3, 6e-3)


def test_every_public_name_is_there():
    assert len(tt.__all__) == len(set(tt.__all__)) < 25
    for name in tt.__all__:
        assert getattr(tt, name) is not None
        assert name in dir(tt)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = tt.nothing


def test_import_loads_nothing_heavy():
    code = "import sys, tactip_twin; print({'torch', 'mujoco', 'numpy', 'scipy', 'cv2'} & set(sys.modules) or 'none')"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "none"


def test_press_gives_the_record_of_the_simulator(tip):
    contact = tip.press("surface", depth_mm=3, roll_deg=8, shear_mm=(2, 0), shear_deg=(0, 0, 5))
    plain = ContactSimulator(tip.design, "surface", tip.fidelity)
    record = plain.simulate(from_mm_deg([0, 0, -3, 8, 0, 0]), from_mm_deg([2, 0, 0, 0, 0, 5]))
    assert np.array_equal(contact.pins_mm, 1e3 * record.pin_tips)
    frame = renderer_named("raster", tip.design)(record.pin_tips, record.directions)
    assert np.array_equal(contact.image, tactile_image(frame, tip.design.image))
    assert np.isclose(contact.force_N[2], record.normal_force_n)
    assert np.isclose(np.hypot(*contact.force_N[:2]), record.tangential_force_n)
    assert contact.force_N[0] < 0  # friction holds back a tip that is moved along x


def test_untouched_tip_is_where_the_design_has_it(tip):
    assert tip.neutral_image.shape == (128, 128) and set(np.unique(tip.neutral_image)) == {0, 255}
    moved = tip.press(depth_mm=2).pins_mm - tip.neutral_pins_mm
    assert moved.shape == (127, 3) and np.linalg.norm(moved, axis=1).max() > 0.5


def test_depth_is_positive_into_the_object(tip):
    with pytest.raises(TactipError, match="depth_mm must be at least 0: it is positive into the object, got -3"):
        tip.press("surface", depth_mm=-3)


def test_images_of_zeros_and_ones_are_refused():
    with pytest.raises(TactipError, match="binary ones 0 and 255, got 0 and 1"):
        tt.load_network("surface-tactip-127").predict(np.eye(128, dtype=np.uint8))


def test_press_on_a_mesh_is_that_on_its_shape(tip):
    """A press on the top of a block's mesh gives the flat surface's contact, wherever the block stands."""
    block = trimesh.creation.box((80e-3, 80e-3, 20e-3))
    block.apply_translation([0.3, -0.1, 0.2])
    on_mesh, flat = tip.press(block, depth_mm=2), tip.press("surface", depth_mm=2)
    assert np.abs(on_mesh.pins_mm - flat.pins_mm).max() < 0.05
    assert np.isclose(on_mesh.force_N[2], flat.force_N[2], rtol=0.05)
    aside = tip.press(block, depth_mm=2, at_mm=(320, -90))
    assert np.abs(aside.pins_mm - on_mesh.pins_mm).max() < 0.01


def test_press_on_a_tilted_face_follows_its_normal(tip):
    block = trimesh.creation.box((80e-3, 80e-3, 20e-3))
    level = tip.press(block, depth_mm=2)
    block.apply_transform(trimesh.transformations.rotation_matrix(np.radians(25), [1, 0, 0]))
    tilted = tip.press(block, depth_mm=2, at_mm=(0, 0))
    assert np.abs(tilted.pins_mm - level.pins_mm).max() < 0.05


def test_press_on_a_file_and_an_object(tip, tmp_path):
    ball = trimesh.creation.icosphere(3, 12e-3)
    ball.copy().apply_scale(1e3).export(tmp_path / "solid.stl")
    from_file = tip.press(tmp_path / "solid.stl", depth_mm=2, at_mm=(0, 1))
    assert np.abs(from_file.pins_mm - tip.press(ball, depth_mm=2, at_mm=(0, 1)).pins_mm).max() < 0.02
    # A changed file is read again.
    trimesh.creation.box((80, 80, 20)).export(tmp_path / "solid.stl")
    assert tip.press(tmp_path / "solid.stl", depth_mm=2, at_mm=(0, 1)).force_N[2] > 1.1 * from_file.force_N[2]
    assert tip.press(tt.load_object("edge"), depth_mm=2).force_N[2] > 0.2


def test_record_that_fails_its_checks_is_repeated_and_passes(tip):
    """On a ring, where the plain simulator's record exceeds the allowed penetration."""
    limits = QualityLimits()
    contacts = [tip.press(ring(), depth_mm=depth, at_mm=(0, 10)) for depth in (2.0, 4.0)]
    assert all(contact.record.violations(limits) == [] for contact in contacts)
    assert max(contact.tries for contact in contacts) > 1


def test_record_that_never_passes_is_refused_with_its_reason():
    tip = tt.TacTip("tactip-127", fidelity="draft", renderer="raster", limits=QualityLimits(penetration_m=1e-9))
    with pytest.raises(tt.UntrustedContact, match=r"the object is .* mm inside the skin") as caught:
        tip.press(depth_mm=3)
    assert caught.value.record.penetration_m > 1e-9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stimulus": "nothing"}, "unknown stimulus 'nothing': choose one of surface, edge"),
        ({"depth_mm": 20}, "must be at most 8 mm, got 20 mm"),
        ({"shear_mm": (1,)}, "shear_mm must be 2 or 3 numbers"),
        ({"at_mm": (1, 1)}, "at_mm must be None with a stimulus that is not a mesh"),
        ({"stimulus": trimesh.Trimesh()}, "mesh has no triangles"),
    ],
)
def test_wrong_press_is_one_sentence(tip, arguments, message):
    with pytest.raises(tt.TactipError, match=message):
        tip.press(**arguments)


def test_place_beside_a_mesh_is_refused(tip):
    with pytest.raises(tt.TactipError, match="no surface below x, y = 90, 0 mm"):
        tip.press(ring(), at_mm=(90, 0))


def test_network_predicts_from_one_image(tip):
    network = tt.load_network("surface-tactip-127")
    contact = tt.TacTip("tactip-127", renderer="raster").press("surface", depth_mm=3, roll_deg=5)
    depth, roll, pitch = network.predict(contact.image)
    assert abs(depth + 3) < 0.3 and abs(roll - 5) < 1.5 and abs(pitch) < 1.5
