"""White blobs of some frames of an imported set, found at the frames' full size: in tactile images, dense pins touch.

blobs.npz:
    rows     (m,)   rows of targets.csv
    counts   (m,)   number of blobs in each of these frames
    centres  (k, 2) centres of the blobs of all of them, px of 256
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.dataset.format import read_unaltered
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.input_files import parse_arrays
from tactip_twin.tactip_model.neutral_image import reference_pixels
from tactip_twin.tactip_model.optics import REFERENCE_PX
from tactip_twin.tactip_model.pin_detection import find_blobs

BLOBS = "blobs.npz"
"""Name of the file."""

FRAMES = 240
"""Largest number of frames in it: twice as many as estimates from pins read, because some are for testing only."""


def blobs_of(image: np.ndarray) -> np.ndarray:
    """Return the centres (k, 2), px of 256, of the blobs of a cropped binary image (h, w) uint8."""
    return reference_pixels(find_blobs(image).centres, image.shape[1])


def pack_blobs(blobs: Mapping[int, np.ndarray]) -> bytes:
    """Return blobs.npz: the centres (k, 2), px of 256, of each frame by its row of targets.csv."""
    data = io.BytesIO()
    np.savez(
        data,
        allow_pickle=False,
        rows=np.array(list(blobs), np.int64),
        counts=np.array([len(centres) for centres in blobs.values()], np.int64),
        centres=np.concatenate([np.zeros((0, 2)), *blobs.values()]).astype(np.float32),
    )
    return data.getvalue()


def read_blobs(folder: Path, meta: dict[str, Any]) -> dict[int, np.ndarray] | None:
    """Return the centres (k, 2), px of 256, of the blobs of some frames of a set, by their rows of targets.csv; None if an
    earlier version imported the set, or it is simulated.

    Args:
        folder: Folder of the set.
        meta: Its meta.json.

    Raises:
        TactipError: The file is missing, altered or not what it should be.
    """
    if BLOBS not in meta["files"]:
        return None
    path = folder / BLOBS
    arrays = parse_arrays(read_unaltered(path, meta["files"][BLOBS]), str(path))
    rows, counts, centres = (arrays.get(name, np.zeros(0)) for name in ("rows", "counts", "centres"))
    whole = [(array.dtype.kind, array.ndim) for array in (rows, counts)] == [("i", 1)] * 2 and len(rows) == len(counts)
    if not whole or (rows < 0).any() or (rows >= len(meta["images"])).any() or len(set(rows.tolist())) < len(rows):
        raise TactipError(f"{path}: rows and counts must be whole numbers, and rows be different ones of targets.csv")
    fits = centres.dtype == np.float32 and centres.shape == (counts.sum(), 2) and not (counts < 0).any()
    if not fits or not (np.abs(centres) <= 2 * REFERENCE_PX).all():
        raise TactipError(f"{path}: centres must be float32 of shape ({counts.sum()}, 2), px of 256, as counts say")
    parts = np.split(centres.astype(float), np.cumsum(counts)[:-1]) if len(counts) else []
    return dict(zip(rows.tolist(), parts, strict=True))
