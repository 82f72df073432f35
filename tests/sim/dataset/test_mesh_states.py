"""Sets that keep the deformed meshes of their contacts."""

import json
import shutil

import numpy as np
import pytest

from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.format import checksum, read_configuration, read_meta, read_rows
from tactip_twin.sim.dataset.mesh_states import read_mesh_states
from tactip_twin.sim.pose import from_mm_deg
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.pins import PinReader

OPTIONS = ["--fidelity", "draft", "--renderer", "raster", "--keep-mesh", "--snapshots-per-contact", "2"]


def make(folder, *options):
    return tactip.main(["dataset", "make", "--out", str(folder), *options])


def run(arguments):
    return tactip.main(arguments)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh") / "set"
    assert make(folder, *OPTIONS, "--samples", "6", "--workers", "2") == 0
    return folder


def test_pins_of_kept_meshes_are_those_of_the_set(kept):
    meta = read_meta(kept)
    configuration, states = read_configuration(meta, kept), read_mesh_states(kept, meta)
    mesh = build_mesh(configuration.design.shape, configuration.fidelity.mesh)
    assert states.numbers.tolist() == [0, 1, 2]
    assert states.states.shape == (3, 3, len(mesh.vertices), 3)
    tips, _ = PinReader(configuration.design, mesh).read(states.states[:, 1:, : mesh.surface_count])
    with np.load(kept / "pins.npz") as pins:
        indices = [int(row["index"]) for row in read_rows(kept, meta)]
        assert np.abs(tips.reshape(-1, *tips.shape[2:])[indices] - pins["pin_tips"]).max() < 1e-7


def test_mesh_after_the_approach_is_pressed_but_not_sheared(kept):
    """There the skin has the depth of the contact before its shear."""
    meta = read_meta(kept)
    states = read_mesh_states(kept, meta).states
    mesh = build_mesh(read_configuration(meta, kept).design.shape, read_configuration(meta, kept).fidelity.mesh)
    flattened = (states[:, 0, :, 2] - mesh.vertices[:, 2]).min(1)
    first = [row for row in read_rows(kept, meta) if int(row["index"]) % 2 == 0]
    depth = from_mm_deg([[0, 0, float(row["pose_z"]), 0, 0, 0] for row in first])[:, 2]
    assert (flattened < 0.6 * depth).all()
    assert np.abs(states[:, 0] - states[:, 1]).max() > 0.5e-3


def test_set_with_meshes_grows_to_the_same_bytes(kept, tmp_path):
    assert make(tmp_path / "grown", *OPTIONS, "--samples", "2", "--workers", "1") == 0
    assert make(tmp_path / "grown", *OPTIONS, "--samples", "6", "--workers", "1") == 0
    assert (tmp_path / "grown" / "mesh.npz").read_bytes() == (kept / "mesh.npz").read_bytes()
    assert run(["dataset", "verify", str(tmp_path / "grown")]) == 0


def altered(kept, tmp_path, change):
    """Return a copy of a set whose mesh.npz has changed arrays and a checksum that matches."""
    folder = shutil.copytree(kept, tmp_path / "copy")
    with np.load(folder / "mesh.npz") as data:
        arrays = dict(data)
    change(arrays)
    np.savez(folder / "mesh.npz", **arrays)
    meta = json.loads((folder / "meta.json").read_text())
    meta["files"]["mesh.npz"] = checksum((folder / "mesh.npz").read_bytes())
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("numbers"), "lacks an array"),
        (lambda a: a.update(states=a["states"][:, :1]), "states must be float32 of shape"),
        (lambda a: a.update(numbers=a["numbers"][::-1].copy()), "numbers must be ascending"),
        (lambda a: a["states"].__setitem__((0, 0, 0, 0), np.nan), "states must be finite"),
        (lambda a: a.update(digest=np.array("0")), "belongs to a set of another configuration"),
    ],
)
def test_damaged_meshes_give_one_sentence(kept, tmp_path, capsys, change, words):
    folder = altered(kept, tmp_path, change)
    with pytest.raises(TactipError, match=words):
        read_mesh_states(folder, read_meta(folder))
    assert run(["dataset", "verify", str(folder)]) == 1
    assert words in capsys.readouterr().err


def test_edges_at_a_coarse_mesh_keep_no_mesh(tmp_path, capsys):
    assert make(tmp_path / "set", "--task", "edge", "--fidelity", "draft", "--keep-mesh", "--samples", "2") == 1
    assert "fidelity must be no 'draft'" in capsys.readouterr().err
