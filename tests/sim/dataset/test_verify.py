"""`tactip dataset verify` finds what is missing, altered or mixed, and reports it in a sentence."""

import csv
import json
import shutil

import cv2
import numpy as np
import pytest

from helpers.set_commands import table
from tactip_twin.commands import main as tactip
from tactip_twin.sim.dataset.format import read_configuration
from tactip_twin.tactip_model.errors import TactipError


def damage_missing_image(folder):
    (folder / "images" / "image_00002.png").unlink()


def damage_truncated_image(folder):
    path = folder / "images" / "image_00002.png"
    path.write_bytes(path.read_bytes()[:60])


def damage_altered_image(folder):
    path = folder / "images" / "image_00002.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    image[0, 0] = 255
    cv2.imwrite(str(path), image)


def damage_extra_image(folder):
    shutil.copy(folder / "images" / "image_00002.png", folder / "images" / "image_00009.png")


def damage_bad_number(folder):
    edit(folder, 3, "pose_z", "deep")


def damage_infinite_number(folder):
    edit(folder, 3, "pose_z", "inf")


def damage_out_of_range(folder):
    edit(folder, 3, "pose_Rz", "80.0")


def damage_short_row(folder):
    path = folder / "targets.csv"
    lines = path.read_text().splitlines()
    lines[2] = ",".join(lines[2].split(",")[:5])
    path.write_text("\n".join(lines) + "\n")


def damage_foreign_row(folder):
    edit(folder, 3, "seed", "7:edge:train:3")


def damage_missing_pins(folder):
    (folder / "pins.npz").unlink()


def damage_pins_of_another_set(folder):
    with np.load(folder / "pins.npz", allow_pickle=False) as pins:
        arrays = {k: pins[k] for k in pins.files}
    np.savez(folder / "pins.npz", **{**arrays, "digest": np.array("0" * 64)})


def damage_truncated_pins(folder):
    path = folder / "pins.npz"
    path.write_bytes(path.read_bytes()[:500])


def damage_emptied_pins(folder):
    (folder / "pins.npz").write_bytes(b"")


def damage_configuration(folder):
    path = folder / "meta.json"
    meta = json.loads(path.read_text())
    meta["configuration"]["design"]["materials"]["friction"] = 0.9
    path.write_text(json.dumps(meta))


def edit(folder, number, column, value):
    path = folder / "targets.csv"
    rows = table(folder)
    rows[number][column] = value
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


DAMAGES = {
    damage_missing_image: "image_00002.png: missing",
    damage_truncated_image: "image_00002.png: truncated",
    damage_altered_image: "image_00002.png: altered",
    damage_extra_image: "image_00009.png: has no row",
    damage_bad_number: "line 5: pose_z is 'deep', not a number",
    damage_infinite_number: "not a finite number",
    damage_out_of_range: "the row belongs to another configuration",
    damage_short_row: "line 3: has more or fewer cells",
    damage_foreign_row: "or the image does not belong to this set",
    damage_missing_pins: "pins.npz: missing",
    damage_pins_of_another_set: "pins.npz: belongs to a set of another configuration",
    damage_truncated_pins: "pins.npz cannot be read",
    damage_emptied_pins: "pins.npz cannot be read",
    damage_configuration: "digest must be the checksum of configuration, which was altered",
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda d: d.__name__)
def test_verify_finds(copy, capsys, damage):
    damage(copy)
    assert tactip.main(["dataset", "verify", str(copy)]) == 1
    assert DAMAGES[damage] in capsys.readouterr().err


def test_verify_accepts_an_intact_set(copy, capsys):
    assert tactip.main(["dataset", "verify", str(copy)]) == 0
    assert "complete; 4 samples" in capsys.readouterr().out


def test_verify_and_show_refuse_an_empty_folder(tmp_path, capsys):
    for action in ("verify", "show"):
        assert tactip.main(["dataset", action, str(tmp_path)]) == 1
        assert "no data set" in capsys.readouterr().err


def test_verify_of_a_folder_of_sets_names_these(tmp_path, capsys):
    for split in ("train", "val"):
        (tmp_path / split).mkdir()
        (tmp_path / split / "meta.json").write_text("{}")
    assert tactip.main(["dataset", "verify", str(tmp_path)]) == 1
    assert "it has the sets train, val: name one of these" in capsys.readouterr().err


def test_foreign_meta_is_refused(tmp_path, capsys):
    (tmp_path / "meta.json").write_text('{"num_poses": 5000}')
    assert tactip.main(["dataset", "verify", str(tmp_path)]) == 1
    assert "not describe a data set of this project" in capsys.readouterr().err


@pytest.mark.parametrize("key", ["task", "seed", "renderer", "pose", "shear"])
def test_configuration_without_a_key_is_refused_not_filled_in(copy, key):
    meta = json.loads((copy / "meta.json").read_text())
    del meta["configuration"][key]
    with pytest.raises(TactipError, match=f"configuration lacks the field '{key}'"):
        read_configuration(meta, copy)
