"""Blobs of the frames of an imported set, at the frames' full size."""

import io

import cv2
import numpy as np
import pytest

from helpers.laboratory import SIZE, bring, frame, write_set
from tactip_twin.sim.dataset.format import checksum, read_meta
from tactip_twin.sim2real.importing.frame_blobs import BLOBS, blobs_of, pack_blobs, read_blobs
from tactip_twin.tactip_model.errors import TactipError

META = {"images": {f"image_{k}.png": "" for k in range(9)}}


def written(folder, data):
    """Write a blobs.npz, and return the meta.json of its set."""
    (folder / BLOBS).write_bytes(data)
    return META | {"files": {BLOBS: checksum(data)}}


def test_blobs_are_read_as_they_were_packed(tmp_path):
    blobs = {4: np.array([[1.5, 2.0], [3.25, 255.0]]), 7: np.zeros((0, 2)), 2: np.array([[0.5, 0.5]])}
    found = read_blobs(tmp_path, written(tmp_path, pack_blobs(blobs)))
    assert list(found) == list(blobs)
    assert all(np.array_equal(found[row], blobs[row]) for row in blobs)
    assert read_blobs(tmp_path, written(tmp_path, pack_blobs({}))) == {}
    assert read_blobs(tmp_path, META | {"files": {}}) is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rows": np.array([0, 9])}, "rows and counts must be"),
        ({"rows": np.array([0, 0])}, "rows and counts must be"),
        ({"rows": np.array([0.0, 1.0])}, "rows and counts must be"),
        ({"counts": np.array([3])}, "rows and counts must be"),
        ({"counts": np.array([2, 2])}, r"centres must be float32 of shape \(4, 2\)"),
        ({"counts": np.array([4, -1])}, "centres must be float32"),
        ({"centres": np.full((3, 2), np.nan, np.float32)}, "centres must be float32"),
        ({"centres": np.zeros((3, 2))}, "centres must be float32"),
    ],
)
def test_file_that_is_no_record_of_blobs_is_refused(tmp_path, changed, words):
    arrays = {"rows": np.array([0, 1]), "counts": np.array([1, 2]), "centres": np.zeros((3, 2), np.float32)}
    data = io.BytesIO()
    np.savez(data, **(arrays | changed))
    with pytest.raises(TactipError, match=words):
        read_blobs(tmp_path, written(tmp_path, data.getvalue()))


def test_altered_file_is_refused(tmp_path):
    meta = written(tmp_path, pack_blobs({0: np.zeros((1, 2))}))
    (tmp_path / BLOBS).write_bytes(pack_blobs({0: np.ones((1, 2))}))
    with pytest.raises(TactipError, match="does not match its checksum"):
        read_blobs(tmp_path, meta)


def test_import_keeps_blobs_of_the_frames_it_keeps(tmp_path):
    """They are found at the frames' size, and belong to the rows of the set's own table."""
    rows = write_set(tmp_path / "lab", 4)
    cv2.imwrite(str(tmp_path / "lab" / "images" / "frame_1.png"), np.zeros((SIZE, SIZE), np.uint8))  # is left out
    out = tmp_path / "set"
    assert bring(tmp_path / "lab", out, "--size-px", "64") == 0
    blobs = read_blobs(out, read_meta(out))
    assert list(blobs) == [0, 1, 2]
    for row, k in enumerate((0, 2, 3)):
        assert np.allclose(ordered(blobs[row]), ordered(blobs_of(frame(1 + 0.02 * (5 + rows[k]["pose_2"])))), atol=1e-4)


def ordered(points):
    return points[np.lexsort(points.round(2).T)]
