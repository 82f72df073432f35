"""Large data sets: folders of shards, each a set of its own, and a manifest that makes one set of them.

    shard-00000/ …   a set of at most `shard_samples` samples; indices continue from shard to shard
    meta.json        the manifest: configuration of the whole set, its shards, and a checksum of the meta.json of each
    run.json         when, where and how fast it was made

The memory needed to make a set and the number of files in a folder then depend on the size of a shard, not of the set.
Readers (sim/dataset/format.py) take shards as one set. A set that outgrows one shard is moved into its first.
"""

import contextlib
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tactip_twin.sim.dataset.builder import DatasetBuilder
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import PARTIAL, checksum, meta_json, read_meta
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file


def is_sharded(configuration: Configuration) -> bool:
    """Return whether a set is a folder of shards."""
    return configuration.samples > _max_samples(configuration)


def open_builder(configuration: Configuration, path: Path) -> "DatasetBuilder | ShardedDatasetBuilder":
    """Return the builder of a set in a folder."""
    return (ShardedDatasetBuilder if is_sharded(configuration) else DatasetBuilder)(configuration, path)


def shard_dir(configuration: Configuration, folder: Path, number: int) -> Path:
    """Return the folder of the set or shard to which contact `number` of the set in `folder` belongs."""
    if not is_sharded(configuration):
        return folder
    return folder / _shard_name(number * configuration.samples_per_contact // _max_samples(configuration))


def shards_of(configuration: Configuration) -> dict[str, Configuration]:
    """Return the configurations of the shards of a set, by the names of their folders."""
    each, total = _max_samples(configuration), configuration.samples
    starts = range(0, total, each)
    return {
        _shard_name(k): replace(configuration, first=first, samples=min(each, total - first))
        for k, first in enumerate(starts)
    }


def _max_samples(configuration: Configuration) -> int:
    """Return the maximum number of samples of a shard: the samples of a contact stay together."""
    return configuration.shard_samples - configuration.shard_samples % configuration.samples_per_contact


def _shard_name(k: int) -> str:
    return f"shard-{k:05d}"


@dataclass(frozen=True, repr=False)
class ShardFinalizer:
    """A worker task that finishes a shard once all of its contacts are made, so the process that assigns tasks need not."""

    name: str
    """Folder of the shard, within that of the set."""
    run_json: bytes
    """Content of the run.json of the shard."""

    def __call__(self, configuration: Configuration, folder: Path) -> None:
        """Turn the records of the shard into a finished set.

        Args:
            configuration: Configuration of the whole set.
            folder: Folder of the whole set.

        Raises:
            OSError: A file cannot be written.
        """
        part = DatasetBuilder(shards_of(configuration)[self.name], folder / self.name, alone=False)
        # Another worker may have finished it and died before its reply.
        if (folder / self.name / "meta.json").exists():
            shutil.rmtree(folder / self.name / PARTIAL, ignore_errors=True)
        else:
            part.assemble(self.run_json)

    def __repr__(self) -> str:
        return f"the completion of {self.name}"


class ShardedDatasetBuilder(DatasetBuilder):
    """The folder of a set of shards while it is made."""

    def __init__(self, configuration: Configuration, path: Path) -> None:
        """Prepare to make a set of this configuration in a folder; nothing is written yet."""
        super().__init__(configuration, path)
        parts = shards_of(configuration).items()
        self._shards = {name: DatasetBuilder(part, path / name, alone=False) for name, part in parts}

    def _existing_meta(self, identity: dict[str, Any]) -> dict[str, Any] | None:
        """Return what DatasetBuilder does. Raises TactipError also for a set larger than a shard in one folder."""
        meta = super()._existing_meta(identity)
        max_samples = _max_samples(self._configuration)
        if meta and "shards" not in meta and (existing := meta["configuration"]["samples"]) > max_samples:
            raise TactipError(
                f"the set in {self._path} cannot grow: it has {existing} samples in one folder, more than the "
                f"{max_samples} of a shard; make the larger set in another folder"
            )
        return meta

    def _begin(self, stack: contextlib.ExitStack, meta: dict[str, Any] | None) -> None:
        if meta and "shards" in meta:
            for name in ("meta.json", "run.json"):
                (self._path / name).unlink(missing_ok=True)
        # meta.json is moved first: after a kill the set is unfinished, and the next command moves what is left.
        first = self._path / _shard_name(0)
        first.mkdir(exist_ok=True)
        for name in ("meta.json", "images", "targets.csv", "pins.npz", "run.json"):
            if (self._path / name).exists():
                (self._path / name).rename(first / name)
        for shard in self._shards.values():
            stack.enter_context(shard)

    def missing(self) -> list[int]:
        """Return the numbers of the contacts of all shards that are still to be made."""
        return [] if self.finished else [number for shard in self._shards.values() for number in shard.missing()]

    def done(self, number: int, cost: tuple[float, float], workers: int, seconds: float) -> list[ShardFinalizer]:
        """Note that a contact is made, as DatasetBuilder does; return the end of its shard if it was the last."""
        self.costs.append(cost)
        name = shard_dir(self._configuration, self._path, number).name
        run_json = self._shards[name].last(number, cost, workers, seconds)
        return [ShardFinalizer(name, run_json)] if run_json else []

    def mark_shard_finished(self, name: str) -> None:
        """Note that a worker has finished a shard."""
        self._shards[name].mark_finished()

    def finish(self, workers: int, seconds: float) -> dict[str, Any]:
        """Finish the set, as DatasetBuilder does, and before it the shards that an earlier command left unfinished."""
        for shard in () if self.finished else self._shards.values():
            shard.finish(workers, seconds)
        return super().finish(workers, seconds)

    def assemble(self, run_json: bytes) -> dict[str, int]:
        """Write the manifest, once all shards are finished, as DatasetBuilder writes the tables; return the counts."""
        counts = {name: read_meta(self._path / name)["samples"] for name in self._shards}
        samples = {key: sum(count[key] for count in counts.values()) for key in ("asked", "kept", "failed")}
        write_file(self._path / "run.json", run_json)
        sums = {f"{name}/meta.json": checksum((self._path / name / "meta.json").read_bytes()) for name in counts}
        write_file(self._path / "meta.json", meta_json(self._configuration, samples, sums, {"shards": list(counts)}))
        shutil.rmtree(self._partial)
        return samples
