"""Data sets as arrays, validated before training."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.learning.labels import Labels, labels_of
from tactip_twin.learning.quantities import quantities_of
from tactip_twin.sim.dataset.configuration import has_grey_images
from tactip_twin.sim.dataset.format import Dataset, read_dataset
from tactip_twin.tactip_model.errors import TactipError

_ROUNDING = 1e-6
"""Tolerance of a label's range, because tables have six decimals."""


@dataclass(frozen=True)
class Samples:
    """A data set, or part of one, in memory: n images of size by size px, k components."""

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
    quantities: np.ndarray
    """(n, q) float: quantities.QUANTITIES, NaN where the set does not have them."""
    rows: np.ndarray
    """(n,) int, rows of the samples in the set's table."""

    @property
    def size(self) -> int:
        """Width of an image, px."""
        return self.images.shape[1]

    @property
    def grey(self) -> bool:
        """Whether the images are grey, not binary."""
        return has_grey_images(self.dataset.meta["configuration"])

    @property
    def folder(self) -> Path:
        """Folder of the set."""
        return self.dataset.folder

    def __len__(self) -> int:
        return len(self.images)

    def take(self, chosen: slice | np.ndarray) -> "Samples":
        """Return some of the samples. chosen: slice, or indices (m,) int."""
        names = ("images", "targets", "shears", "quantities", "rows")
        arrays: dict[str, Any] = {name: getattr(self, name)[chosen] for name in names}
        return replace(self, **arrays)

    def subset_sha256(self) -> str | None:
        """Return a checksum (hex) of the samples' rows, or None if they are the whole set."""
        if np.array_equal(self.rows, np.arange(len(self.dataset.images))):
            return None
        return hashlib.sha256(self.rows.astype("<i8").tobytes()).hexdigest()


def read_samples(folder: str | Path) -> Samples:
    """Read a finished set.

    Raises:
        TactipError: If the set is empty, a label is not finite or outside its declared range, an image cannot be read, or
            images differ in size.
    """
    dataset = read_dataset(folder)
    labels = labels_of(dataset.meta.get("configuration") or {})
    if not dataset.images:
        raise TactipError(f"the set in {folder} has no samples: at least one is needed")
    targets = checked_targets(dataset, labels)
    images = [dataset.image(i) for i in range(len(dataset.images))]
    shape = images[0].shape
    for name, image in zip(dataset.images, images, strict=True):
        if image.shape != shape or shape[0] != shape[1]:
            raise TactipError(
                f"image {name} in {folder} is {image.shape[1]} by {image.shape[0]} px, but the first image is "
                f"{shape[1]} by {shape[0]} px: all must be square and of the same size"
            )
    rows = np.arange(len(images))
    return Samples(dataset, labels, np.stack(images), targets, dataset.shears, quantities_of(dataset), rows)


def checked_targets(dataset: Dataset, labels: Labels) -> np.ndarray:
    """Return the learned components (n, k) of a set's samples, mm and degrees.

    Raises:
        TactipError: If a label is not finite or outside its declared range, or a shear is not finite.
    """
    folder, names, targets = dataset.folder, dataset.images, labels.of(dataset.poses)
    if not np.isfinite(dataset.shears).all():
        row = int(np.argmin(np.isfinite(dataset.shears).all(1)))
        raise TactipError(f"shear of {names[row]} in {folder} must be finite, got {dataset.shears[row].tolist()}")
    low, high = np.array(labels.low) - _ROUNDING, np.array(labels.high) + _ROUNDING
    good = (targets >= low) & (targets <= high)  # False for NaN
    if good.all():
        return targets
    row, column = (int(i) for i in np.argwhere(~good)[0])
    value, name = targets[row, column], labels.names[column]
    allowed = f"{labels.low[column]:g} to {labels.high[column]:g} {labels.units[column]}"
    raise TactipError(f"{name} of {names[row]} in {folder} must be from {allowed} (range in meta.json), got {value:g}")


def read_splits(data: str | Path) -> tuple[Samples, Samples]:
    """Return the training and validation sets of a task, DATA/train and DATA/val.

    Raises:
        TactipError: If one is missing, or the two differ in task, images or sensor.
    """
    data = Path(data)
    for split in ("train", "val"):
        if not (data / split).is_dir():
            raise TactipError(f"folder {data / split} does not exist: training needs the sets {data}/train and {data}/val")
    train, val = read_samples(data / "train"), read_samples(data / "val")
    check_compatible(val, train.labels.task, train.size, train.grey, f"the training set in {train.folder}")
    train_design, val_design = (s.dataset.meta["configuration"].get("design") for s in (train, val))
    if train_design != val_design:
        raise TactipError(f"the sets in {train.folder} and {val.folder} must have the same sensor design")
    return train, val


def check_compatible(samples: Samples, task: str, size: int, grey: bool, whose: str) -> None:
    """Check the task and the images of samples.

    Args:
        samples: The samples.
        task: Expected task.
        size: Expected image width, px.
        grey: Whether grey images are expected, not binary ones.
        whose: Model or set that has this task and such images, for the message.

    Raises:
        TactipError: If either differs.
    """
    if samples.labels.task != task:
        raise TactipError(f"the set in {samples.folder} has the task {samples.labels.task!r}, but {whose} has {task!r}")
    if samples.size != size:
        raise TactipError(f"the images in {samples.folder} are {samples.size} px wide, but {whose} uses {size} px")
    if samples.grey != grey:
        raise TactipError(
            f"the images in {samples.folder} are {kind_of(samples.grey)}, but {whose} uses {kind_of(grey)} ones"
        )


def kind_of(grey: bool) -> str:
    """Return the word for grey images, or for binary ones."""
    return "grey" if grey else "binary"
