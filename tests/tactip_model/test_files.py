"""Files that are written whole or not at all, and images in them."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactip_twin.sim.dataset.format import encode_image
from tactip_twin.tactip_model.design_file import read_design, write_design
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.presets import design_named


def test_what_cannot_be_written_leaves_what_was_there(tmp_path, monkeypatch):
    """Of a design as of any file; and nothing beside it."""
    path = tmp_path / "design.json"
    write_design(path, design_named("nominal-127"), {})

    def full(self, data):
        os.close(os.open(self, os.O_CREAT | os.O_WRONLY))
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="no space left"):
        write_design(path, design_named("nominal-331"), {})
    assert read_design(path) == design_named("nominal-127")
    assert list(tmp_path.iterdir()) == [path]


def test_the_new_file_takes_the_place_of_the_old(tmp_path):
    for data in (b"old", b"new"):
        write_file(tmp_path / "file", data)
        assert (tmp_path / "file").read_bytes() == data


def test_an_image_that_cannot_be_a_png_is_a_sentence(monkeypatch):
    monkeypatch.setattr(cv2, "imencode", lambda kind, image: (False, None))
    with pytest.raises(TactipError, match=r"an image of uint8 \(2, 3\) cannot be written as PNG"):
        encode_image(np.zeros((2, 3), np.uint8))
