"""Sets as arrays: a damaged set is refused before training starts."""

import json

import numpy as np
import pytest

from helpers.learning_sets import mend_checksums, write_fake_set, write_fake_splits
from tactip_twin.commands import main as tactip
from tactip_twin.learning.data import read_splits
from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.tactip_model.errors import TactipError


def damaged(tmp_path, damage):
    folder = write_fake_splits(tmp_path / "data", samples=6)
    damage(folder / "train")
    if (folder / "train" / "meta.json").exists():
        mend_checksums(folder / "train")  # so that the content is judged
    return folder


def edit_row(column, value):
    def damage(folder):
        lines = (folder / "targets.csv").read_text().splitlines()
        at = lines[0].split(",").index(column)
        cells = lines[3].split(",")
        cells[at] = value
        lines[3] = ",".join(cells)
        (folder / "targets.csv").write_text("\n".join(lines) + "\n")

    return damage


def keep_header(folder):
    (folder / "targets.csv").write_text((folder / "targets.csv").read_text().splitlines()[0] + "\n")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"images": {}}))


def resize_one(folder):
    (folder / "images" / "image_00002.png").write_bytes(encode_image(np.zeros((20, 20), np.uint8)))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (keep_header, "has no samples: at least one is needed"),
        (edit_row("pose_z", "nan"), "pose_z of image_00002.png .* must be from -5 to -1 mm .*, got nan"),
        (edit_row("pose_Rx", "15.2"), "pose_Rx of image_00002.png .* must be from -15 to 15 ° .*, got 15.2"),
        (edit_row("pose_z", "deep"), "a cell that is not a number"),
        (edit_row("shear_x", "inf"), r"shear of image_00002.png .* must be finite, got \[inf, "),
        (lambda f: (f / "images" / "image_00001.png").write_bytes(b"no image"), "image_00001.png cannot be read"),
        (resize_one, "image_00002.png .* is 20 by 20 px, but the first image is 40 by 40 px"),
        (lambda f: (f / "meta.json").unlink(), "there is no data set in"),
    ],
)
def test_read_splits_damaged_set_raises(tmp_path, capsys, damage, message):
    folder = damaged(tmp_path, damage)
    with pytest.raises(TactipError, match=message):
        read_splits(folder)
    assert tactip.main(["train", "--data", str(folder), "--out", str(tmp_path / "run")]) == 1
    assert not (tmp_path / "run").exists()
    # The status appears where loading takes long: in a process that has not loaded torch.
    lines = [line for line in capsys.readouterr().err.splitlines() if line != "reading the sets …"]
    assert len(lines) == 1 and lines[0].startswith("tactip: ")


def test_read_splits_mixed_tasks_raises(tmp_path):
    folder = tmp_path / "data"
    write_fake_set(folder / "train", "surface", samples=4)
    write_fake_set(folder / "val", "edge", "val", samples=4)
    with pytest.raises(TactipError, match=r"has the task 'edge', but the training set in .* has 'surface'"):
        read_splits(folder)
    with pytest.raises(TactipError, match=r"folder .* does not exist: training needs the sets"):
        read_splits(tmp_path / "nothing")
