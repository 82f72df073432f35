"""A set as a torch Dataset, whose images and tables are read when they are needed, so a set may be of any size."""

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.utils.data

from tactip_twin.learning.data import checked_targets
from tactip_twin.learning.labels import labels_of
from tactip_twin.learning.quantities import QUANTITIES, quantities_of
from tactip_twin.sim.dataset.format import Dataset, read_dataset, read_meta, read_parts
from tactip_twin.tactip_model.errors import TactipError

CACHED_SHARDS = 32
"""Number of shards whose tables stay in memory: about 4 MB each of 10,000 samples [M]."""


@dataclass(frozen=True)
class _Table:
    """The table of a shard, or of a set in one folder."""

    dataset: Dataset
    targets: torch.Tensor
    """(n, k) float32."""
    quantities: torch.Tensor
    """(n, q) float32."""


class TactileDataset(torch.utils.data.Dataset[dict[str, torch.Tensor]]):
    """The n samples of a finished set, simulated or real, for a `torch.utils.data.DataLoader`.

    A sample is a dict of float32 tensors:

        image       (1, size, size), 0 to 1, as PoseNet takes it
        label       (k,), the learned components of the pose, mm and degrees
        quantities  (q,), learning/quantities.py; NaN where the set does not have them

    Networks learn label / scale. Each process reads an image when it is needed, after checking its checksum, and keeps the
    tables of the last `cached_shards` shards. A set that shuffles over more shards than that is read slowly.
    """

    def __init__(self, folder: str | Path, cached_shards: int = CACHED_SHARDS) -> None:
        """Read how many samples a set has, and where.

        Args:
            folder: Folder of the set.
            cached_shards: Number of shards whose tables stay in memory, at least 1.

        Raises:
            TactipError: If there is no finished set, it is empty, or cached_shards is below 1.
        """
        if cached_shards < 1:
            raise TactipError(f"cached_shards must be at least 1, got {cached_shards}")
        self.folder, self._cached_shards = Path(folder), cached_shards
        self.meta = read_meta(folder)
        """The set's meta.json."""
        self.labels = labels_of(self.meta["configuration"])
        """The learned components with their names, units and ranges."""
        self.scale = torch.from_numpy(self.labels.scale).float()
        """(k,) scales of the labels, mm and degrees."""
        self.quantity_scale = torch.tensor([q.scale for q in QUANTITIES])
        """(q,) scales of the quantities."""
        parts = [(part, len(own["images"])) for part, own in read_parts(folder, self.meta)]
        self._parts = [part for part, _ in parts]
        self._ends = np.cumsum([count for _, count in parts])
        if not len(self):
            raise TactipError(f"the set in {folder} has no samples: at least one is needed")
        self._tables: OrderedDict[int, _Table] = OrderedDict()
        """Tables by shard, the last used one at the end."""
        self.size = 0
        """Width of an image, px."""
        self.size = self[0]["image"].shape[-1]

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        """Return sample `index`, as the class describes it.

        Raises:
            IndexError: If there is no such sample.
            TactipError: If a file was altered, a label is outside its declared range, or an image has another size.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"the set in {self.folder} has {len(self)} samples, got the index {index}")
        row = int(index) % len(self)
        shard = int(np.searchsorted(self._ends, row, "right"))
        table, row = self._table(shard), row - int(self._ends[shard - 1] if shard else 0)
        image = table.dataset.image(row)
        if image.shape != (self.size or len(image),) * 2:
            raise TactipError(
                f"image {table.dataset.images[row]} in {table.dataset.folder} is {image.shape[1]} by {image.shape[0]} px: "
                "all images of a set must be square and of the same size"
            )
        pixels = torch.from_numpy(image)[None].float() / 255
        return {"image": pixels, "label": table.targets[row].clone(), "quantities": table.quantities[row].clone()}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, which reads its tables itself."""
        return self.__dict__ | {"_tables": OrderedDict()}

    def _table(self, shard: int) -> _Table:
        """Return the table of a shard, read if it is not in memory."""
        if shard not in self._tables:
            dataset = read_dataset(self._parts[shard])
            targets, quantities = checked_targets(dataset, self.labels), quantities_of(dataset)
            table = _Table(dataset, torch.from_numpy(targets).float(), torch.from_numpy(quantities).float())
            while len(self._tables) >= self._cached_shards:
                self._tables.popitem(last=False)
            self._tables[shard] = table
        self._tables.move_to_end(shard)
        return self._tables[shard]
