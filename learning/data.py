"""Data sets as arrays, checked before anything is learned from them."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactip_twin.learning.labels import Labels, labels_of
from tactip_twin.sim.dataset.format import Dataset, read_dataset
from tactip_twin.tactip_model.errors import TactipError

_ROUNDING = 1e-6
"""A label may lie this far outside its range: tables have six decimals."""


@dataclass(frozen=True)
class Samples:
    """A data set in memory. n images of size by size pixels, k components."""

    dataset: Dataset
    """The set that they are of."""
    labels: Labels
    """The components that are learned, and their ranges."""
    images: np.ndarray
    """(n, size, size) uint8."""
    targets: np.ndarray
    """(n, k) float: learned components, mm and degrees."""
    shears: np.ndarray
    """(n, 6) float, mm and degrees."""
    rows: np.ndarray
    """(n,) int, their rows in the set's table."""

    @property
    def size(self):
        """Width of an image, px."""
        return self.images.shape[1]

    @property
    def folder(self):
        """Path of the set."""
        return self.dataset.folder

    def __len__(self):
        return len(self.images)

    def take(self, chosen):
        """Samples of some: chosen is a slice, or indices (m,)."""
        arrays = {name: getattr(self, name)[chosen] for name in ("images", "targets", "shears", "rows")}
        return replace(self, **arrays)

    def chosen(self):
        """What tells these samples from all of their set: None, or a checksum (hex str) of their rows."""
        if np.array_equal(self.rows, np.arange(len(self.dataset.images))):
            return None
        return hashlib.sha256(self.rows.astype("<i8").tobytes()).hexdigest()


def read_samples(folder):
    """Read a finished set (path) into Samples.

    Raises TactipError on an empty set, a label that is no number or outside the range that the set declares, an image that
    cannot be read, and images of different sizes.
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


def _check_targets(folder, names, labels, targets):
    low, high = np.array(labels.low) - _ROUNDING, np.array(labels.high) + _ROUNDING
    good = (targets >= low) & (targets <= high)  # a NaN is neither
    if good.all():
        return
    row, column = (int(i) for i in np.argwhere(~good)[0])
    value, name = targets[row, column], labels.names[column]
    allowed = f"{labels.low[column]:g} to {labels.high[column]:g} {labels.units[column]}"
    raise TactipError(f"{name} of {names[row]} in {folder} is {value:g}: the set declares {allowed}")


def read_splits(data):
    """Samples of a task's training and validation sets, DATA/train and DATA/val. data: path.

    Raises TactipError where one is missing, and where they differ in task, image size or sensor.
    """
    data = Path(data)
    for split in ("train", "val"):
        if not (data / split).is_dir():
            raise TactipError(f"there is no folder {data / split}: training needs the sets {data}/train and {data}/val")
    train, val = read_samples(data / "train"), read_samples(data / "val")
    check_alike(val, train.labels.task, train.size, f"the training set in {train.folder}")
    ours, theirs = (s.dataset.meta["configuration"].get("design") for s in (train, val))
    if ours != theirs:
        raise TactipError(f"{train.folder} and {val.folder} are of different sensors: train and validate on the same one")
    return train, val


def check_alike(samples, task, size, whose):
    """Raise TactipError where Samples are not of a task (str) and image size (int) that `whose` (str) has."""
    if samples.labels.task != task:
        raise TactipError(f"the set in {samples.folder} is of the task {samples.labels.task!r}, {whose} of {task!r}")
    if samples.size != size:
        raise TactipError(f"the images in {samples.folder} are {samples.size} px wide, {whose} takes {size} px")
