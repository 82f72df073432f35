"""Atomic writing of files, and encoding of images."""

import errno
import os

import cv2
import numpy as np
import pytest

from helpers.full_disk import full_disk
from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.tactip_model.design_file import read_design, write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import is_leftover, remove_leftovers, write_file
from tactip_twin.tactip_model.presets import design_named


def test_write_design_failing_keeps_old_file(tmp_path, monkeypatch):
    """No temporary file stays behind either."""
    path = tmp_path / "design.json"
    write_design(path, design_named("nominal-127"), {})

    def full(descriptor):
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        write_design(path, design_named("nominal-331"), {})
    assert read_design(path) == design_named("nominal-127")
    assert list(tmp_path.iterdir()) == [path]


def test_write_file_replaces_old_file(tmp_path):
    for data in (b"old", b"new"):
        write_file(tmp_path / "file", data)
        assert (tmp_path / "file").read_bytes() == data


def test_file_for_which_the_disk_has_no_room_is_named(tmp_path):
    """The system reports it without a name."""
    write_file(tmp_path / "file", b"old")
    with full_disk(1000), pytest.raises(OSError, match="File too large") as raised:
        write_file(tmp_path / "file", bytes(2000))
    assert raised.value.filename == str(tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_encode_image_failing_raises_error(monkeypatch):
    monkeypatch.setattr(cv2, "imencode", lambda kind, image: (False, None))
    with pytest.raises(TactipError, match=r"an image of uint8 \(2, 3\) cannot be written as PNG"):
        encode_image(np.zeros((2, 3), np.uint8))


@pytest.mark.parametrize(
    ("name", "process", "stays"),
    [("tmp", "dead", False), ("tmp", "own", False), ("tmp", "alive", True), ("part", "", False)],
)
def test_remove_leftovers_keeps_files_that_are_being_written(tmp_path, name, process, stays):
    numbers = {"dead": "4194305.", "own": f"{os.getpid()}.", "alive": f"{os.getppid()}.", "": ""}
    left = tmp_path / f".model.pt.{numbers[process]}{name}"
    for path in (left, tmp_path / "model.pt", tmp_path / ".lock", tmp_path / ".notes.tmp"):
        path.touch()
    assert [path.name for path in tmp_path.iterdir() if is_leftover(path)] == [left.name]
    remove_leftovers(tmp_path, "other")
    assert left.exists()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"model.pt", ".lock", ".notes.tmp"} | (
        {left.name} if stays else set()
    )
    remove_leftovers(tmp_path / "missing")
