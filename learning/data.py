"""Data sets as arrays, checked before training."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.labels import Labels, labels_of
from tactip_twin.sim.dataset.format import Dataset, read_dataset
from tactip_twin.tactip_model.errors import TactipError

_ROUNDING = 1e-6
"""A label may lie this far outside its range: tables have six decimals."""


@dataclass(frozen=True)
class Samples:
    """A data set, or a part of one, in memory: n images of size by size px, k components."""

    dataset: Dataset
    """The set that the samples come from."""
    labels: Labels
    """The learned components and their ranges."""
    images: np.ndarray
    """(n, size, size) uint8."""
    targets: np.ndarray
    """(n, k) float: learned components, mm and degrees."""
    shears: np.ndarray
    """(n, 6) float, mm and degrees."""
    rows: np.ndarray
    """(n,) int, rows of the samples in the set's table."""

    @property
    def size(self) -> int:
        """Width of an image, px."""
        return self.images.shape[1]

    @property
    def folder(self) -> Path:
        """Folder of the set."""
        return self.dataset.folder

    def __len__(self) -> int:
        return len(self.images)

    def take(self, chosen: slice | np.ndarray) -> "Samples":
        """Return some of the samples. chosen: slice, or indices (m,) int."""
        arrays: dict[str, Any] = {name: getattr(self, name)[chosen] for name in ("images", "targets", "shears", "rows")}
        return replace(self, **arrays)

    def chosen(self) -> str | None:
        """Return a checksum (hex) of the samples' rows; None where they are the whole set."""
        if np.array_equal(self.rows, np.arange(len(self.dataset.images))):
            return None
        return hashlib.sha256(self.rows.astype("<i8").tobytes()).hexdigest()


def read_samples(folder: str | Path) -> Samples:
    """Read a finished set.

    Raises:
        TactipError: Where the set is empty, a label is not finite or outside the set's declared range, an image cannot be
            read, or images differ in size.
    """
    dataset = read_dataset(folder)
    labels = labels_of(dataset.meta.get("configuration") or {})
    if not dataset.images:
        raise TactipError(f"the set in {folder} is empty: there is nothing to learn from")
    targets = labels.of(dataset.poses)
    _check_targets(folder, dataset.images, labels, targets)
    if not np.isfinite(dataset.shears).all():
        row = int(np.argmin(np.isfinite(dataset.shears).all(1)))
        raise TactipError(f"the shear of {dataset.images[row]} in {folder} is not a number: every label must be finite")
    images = [dataset.image(i) for i in range(len(dataset.images))]
    shape = images[0].shape
    for name, image in zip(dataset.images, images, strict=True):
        if image.shape != shape or shape[0] != shape[1]:
            raise TactipError(
                f"the image {name} in {folder} is {image.shape[1]} by {image.shape[0]} px and the first one "
                f"{shape[1]} by {shape[0]}: all must be square and of one size"
            )
    return Samples(dataset, labels, np.stack(images), targets, dataset.shears, np.arange(len(images)))


def _check_targets(folder: str | Path, names: tuple[str, ...], labels: Labels, targets: np.ndarray) -> None:
    """Check that targets (n, k) lie in the ranges of the labels. names: of the images, for the message."""
    low, high = np.array(labels.low) - _ROUNDING, np.array(labels.high) + _ROUNDING
    good = (targets >= low) & (targets <= high)  # a NaN is neither
    if good.all():
        return
    row, column = (int(i) for i in np.argwhere(~good)[0])
    value, name = targets[row, column], labels.names[column]
    allowed = f"{labels.low[column]:g} to {labels.high[column]:g} {labels.units[column]}"
    raise TactipError(f"{name} of {names[row]} in {folder} is {value:g}: the set declares {allowed}")


def read_splits(data: str | Path) -> tuple[Samples, Samples]:
    """Return the training and validation sets of a task, DATA/train and DATA/val.

    Raises:
        TactipError: Where one is missing, or the two differ in task, image size or sensor.
    """
    data = Path(data)
    for split in ("train", "val"):
        if not (data / split).is_dir():
            raise TactipError(f"there is no folder {data / split}: training needs the sets {data}/train and {data}/val")
    train, val = read_samples(data / "train"), read_samples(data / "val")
    check_compatible(val, train.labels.task, train.size, f"the training set in {train.folder}")
    train_design, val_design = (s.dataset.meta["configuration"].get("design") for s in (train, val))
    if train_design != val_design:
        raise TactipError(f"{train.folder} and {val.folder} are of different sensors: train and validate on the same one")
    return train, val


def check_compatible(samples: Samples, task: str, size: int, whose: str) -> None:
    """Check that samples have a task and an image size.

    Args:
        samples: The samples.
        task: The expected task.
        size: The expected image width, px.
        whose: What has that task and size, for the message.

    Raises:
        TactipError: Where they have another.
    """
    if samples.labels.task != task:
        raise TactipError(f"the set in {samples.folder} is of the task {samples.labels.task!r}, {whose} of {task!r}")
    if samples.size != size:
        raise TactipError(f"the images in {samples.folder} are {samples.size} px wide, {whose} takes {size} px")
