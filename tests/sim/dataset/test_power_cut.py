"""Files damaged by a power cut or a flipped byte: an unfinished set makes them again, and a finished one refuses to grow."""

import json
import shutil

import pytest

from helpers.set_commands import contents
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset import builder
from tactip_twin.sim.dataset.format import PARTIAL
from tactip_twin.sim.dataset.partial_record import pack_record, record_path, unpack_finished_set
from tactip_twin.tactip_model import files
from tactip_twin.tactip_model.input_files import read_arrays

SAMPLES = 3


def make(folder, samples=SAMPLES):
    given = ["--fidelity", "draft", "--renderer", "raster", "--samples", str(samples), "--workers", "1"]
    return tactip.main(["dataset", "make", *given, "--out", str(folder)])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "set"
    assert make(folder) == 0
    return folder


@pytest.fixture
def finished(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture
def unfinished(finished):
    """The state after a kill that follows the last contact."""
    identity = {key: json.loads((finished / "meta.json").read_text())[key] for key in ("configuration", "versions")}
    (finished / PARTIAL).mkdir()
    unpack_finished_set(finished)
    (finished / PARTIAL / "configuration.json").write_text(json.dumps(identity))
    return finished


def emptied(data):
    return b""


def cut_short(data):
    return data[: len(data) // 2]


def flipped(data):
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 255]) + data[middle + 1 :]


@pytest.mark.parametrize("damage", [emptied, cut_short, flipped])
@pytest.mark.parametrize("name", ["record", "image", "configuration", "table"])
def test_damaged_file_of_an_unfinished_set_is_made_anew(whole, unfinished, name, damage):
    paths = {
        "record": record_path(unfinished, 1),
        "image": unfinished / "images" / "image_00001.png",
        "configuration": unfinished / PARTIAL / "configuration.json",
        "table": unfinished / "targets.csv",
    }
    path = paths[name]
    original = (whole / "targets.csv").read_bytes() if name == "table" else path.read_bytes()
    path.write_bytes(damage(original))
    if name == "configuration" and damage is flipped:
        path.write_bytes(b"{" + original)
    assert make(unfinished) == 0
    assert contents(unfinished) == contents(whole)


def test_record_of_an_earlier_version_is_made_anew(whole, unfinished):
    """Its rows lack columns."""
    path = record_path(unfinished, 1)
    arrays = read_arrays(path)
    record = json.loads(str(arrays["record"]))
    for row in record["rows"]:
        del row["slip_fraction"]
    path.write_bytes(pack_record(record, arrays["pin_tips"], arrays["directions"]))
    assert make(unfinished) == 0
    assert contents(unfinished) == contents(whole)


def test_damaged_meta_beside_the_records_is_made_anew(whole, unfinished):
    (unfinished / "meta.json").write_bytes(b"")
    assert make(unfinished) == 0
    assert contents(unfinished) == contents(whole)


@pytest.mark.parametrize("damage", [cut_short, flipped])
@pytest.mark.parametrize("name", ["targets.csv", "pins.npz", "images/image_00001.png"])
def test_altered_set_does_not_grow(finished, capsys, name, damage):
    path = finished / name
    path.write_bytes(damage(path.read_bytes()))
    before = contents(finished)
    assert make(finished, SAMPLES + 1) == 1
    assert f"cannot grow because {name} does not match its checksum" in " ".join(capsys.readouterr().err.split())
    assert contents(finished) == before


def test_missing_table_stops_growth(finished, capsys):
    (finished / "pins.npz").unlink()
    assert make(finished, SAMPLES + 1) == 1
    assert "cannot grow because pins.npz is missing" in " ".join(capsys.readouterr().err.split())


def test_file_is_synced_before_it_is_renamed(tmp_path, monkeypatch):
    calls, sync, replace = [], files.os.fsync, files.os.replace
    monkeypatch.setattr(files.os, "fsync", lambda descriptor: calls.append("sync") or sync(descriptor))
    monkeypatch.setattr(files.os, "replace", lambda a, b: calls.append("rename") or replace(a, b))
    files.write_file(tmp_path / "a.json", b"{}")
    assert calls == ["sync", "rename", "sync"]
    files.write_file(tmp_path / "b.json", b"{}", sync=False)
    assert calls == ["sync", "rename", "sync", "rename"]
    assert (tmp_path / "a.json").read_bytes() == b"{}"


def test_everything_is_synced_before_a_set_counts_as_finished(tmp_path, monkeypatch):
    finished = []
    monkeypatch.setattr(builder, "sync_all", lambda: finished.append((tmp_path / "set" / "meta.json").exists()))
    assert make(tmp_path / "set") == 0
    assert finished == [False]
