"""Contact sheet: images of a data set with their labels."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from tactip_twin.sim.dataset.format import encode_image, read_dataset
from tactip_twin.sim.labels import COMPONENTS, LEARNED
from tactip_twin.tactip_model.bounds import require
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file

_MARGIN = 6
_TEXT = 34


def contact_sheet(folder: str | Path, count: int = 24, columns: int = 6) -> np.ndarray:
    """Return an image (h, w) uint8 of samples spread over a set, each above the components of its label that are learned.

    Args:
        folder: Folder of the set.
        count: Maximum number of samples.
        columns: Maximum number of samples per row.

    Raises:
        TactipError: The set or an image cannot be read, or `count` or `columns` is below 1.
    """
    require(count >= 1, "count", count, "at least 1")
    require(columns >= 1, "columns", columns, "at least 1")
    dataset = read_dataset(folder)
    if not dataset.images:
        raise TactipError(f"the set in {folder} has no images to show")
    chosen = np.unique(np.linspace(0, len(dataset.images) - 1, min(count, len(dataset.images))).round().astype(int))
    names = LEARNED.get(dataset.meta["configuration"]["task"], COMPONENTS)
    tiles = [_tile(dataset.image(i), dict(zip(COMPONENTS, dataset.poses[i], strict=True)), names) for i in chosen]
    height, width = max(t.shape[0] for t in tiles), max(t.shape[1] for t in tiles)
    columns = min(columns, len(tiles))
    lines = -(-len(tiles) // columns)
    sheet = np.full((lines * (height + _MARGIN) + _MARGIN, columns * (width + _MARGIN) + _MARGIN), 255, np.uint8)
    for k, tile in enumerate(tiles):
        top = _MARGIN + (k // columns) * (height + _MARGIN)
        left = _MARGIN + (k % columns) * (width + _MARGIN)
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet


def write_sheet(folder: str | Path, out: Path, count: int = 24, columns: int = 6) -> None:
    """Write `contact_sheet` to a PNG file. Raises TactipError and OSError."""
    if out.suffix.lower() != ".png":
        raise TactipError(f"the file of a contact sheet must end in .png, got {out}")
    sheet = contact_sheet(folder, count, columns)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_file(out, encode_image(sheet))


def _tile(image: np.ndarray, pose: Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """Return an image (size, size) uint8 above the named components of its pose, mm and degrees."""
    width = max(image.shape[1], 144)
    tile = np.full((image.shape[0] + _TEXT, width), 255, np.uint8)
    tile[: image.shape[0], : image.shape[1]] = image
    millimetres = " ".join(f"{name} {pose[name]:.1f}" for name in names if name[0] != "R")
    degrees = " ".join(f"{name} {round(pose[name])}" for name in names if name[0] == "R")
    for k, text in enumerate((f"{millimetres} mm", f"{degrees} deg")):
        place = (2, image.shape[0] + 13 + 15 * k)
        cv2.putText(tile, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.36, 0, 1, cv2.LINE_AA)
    return tile
