"""Large data sets: folders of shards, each a set of its own, and a manifest that makes one set of them.

    shard-00000/ …   a set of at most `shard_samples` samples; indices continue from shard to shard
    meta.json        the manifest: configuration of the whole set, its shards, and a checksum of the meta.json of each
    run.json         when, where and how fast it was made

The memory needed to make a set and the number of files in a folder then depend on the size of a shard, not of the set.
Readers (sim/dataset/format.py) take shards as one set. A set that outgrows one shard is moved into its first.
"""

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactip_twin.sim.dataset.builder import DatasetBuilder
from tactip_twin.sim.dataset.configuration import Configuration
from tactip_twin.sim.dataset.format import PARTIAL, checksum, meta_json, parse_meta
from tactip_twin.sim.dataset.partial_record import contact_numbers
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file
from tactip_twin.tactip_model.input_files import read_file


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
    return folder / shard_name(shard_index(configuration, number))


def shard_index(configuration: Configuration, number: int) -> int:
    """Return the number of the shard to which contact `number` of a set belongs."""
    return number * configuration.samples_per_contact // _max_samples(configuration)


MAX_SHARDS = 100_000
"""Maximum number of shards, which the manifest lists with their checksums."""


def shard_count(configuration: Configuration) -> int:
    """Return the number of shards of a set."""
    return -(-configuration.samples // _max_samples(configuration))


def shards_of(configuration: Configuration) -> Iterator[tuple[str, Configuration]]:
    """Yield the folder and the configuration of each shard of a set."""
    for k in range(shard_count(configuration)):
        yield shard_name(k), _shard_configuration(configuration, k)


def _shard_configuration(configuration: Configuration, k: int) -> Configuration:
    each = _max_samples(configuration)
    return replace(configuration, first=k * each, samples=min(each, configuration.samples - k * each))


def _max_samples(configuration: Configuration) -> int:
    """Return the maximum number of samples of a shard: the samples of a contact stay together."""
    return configuration.shard_samples - configuration.shard_samples % configuration.samples_per_contact


def shard_name(k: int) -> str:
    """Return the folder of shard `k`, within that of the set."""
    return f"shard-{k:05d}"


@dataclass(frozen=True, repr=False)
class ShardFinalizer:
    """A worker task that finishes a shard once all of its contacts are made, so the process that assigns tasks need not."""

    shard: int
    """Number of the shard."""
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
        path = folder / shard_name(self.shard)
        # Another worker may have finished it and died before its reply.
        if (path / "meta.json").exists():
            shutil.rmtree(path / PARTIAL, ignore_errors=True)
        else:
            DatasetBuilder(_shard_configuration(configuration, self.shard), path, alone=False).assemble(self.run_json)

    def __repr__(self) -> str:
        return f"the completion of {shard_name(self.shard)}"


class ShardedDatasetBuilder(DatasetBuilder):
    """The folder of a set of shards while it is made. Only the shards in progress are in memory."""

    def __init__(self, configuration: Configuration, path: Path) -> None:
        """Prepare to make a set of this configuration in a folder; nothing is written yet."""
        super().__init__(configuration, path)
        self._open_shards: dict[int, DatasetBuilder] = {}
        """Shards of which contacts are being made, by number."""
        self._partly_done: dict[int, np.ndarray] = {}
        """Numbers of the missing contacts of shards that an earlier command began. Other shards lack all or none."""
        self._finished_shards: set[int] = set()
        self._all_made: list[int] = []
        """Shards that an earlier command left with all contacts made, but unfinished."""

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
        first = self._path / shard_name(0)
        first.mkdir(exist_ok=True)
        for name in ("meta.json", "images", "targets.csv", "pins.npz", "mesh.npz", "run.json"):
            if (self._path / name).exists():
                (self._path / name).rename(first / name)

    def _shard(self, k: int) -> DatasetBuilder:
        """Return the builder of shard `k`, whose folder need not be locked, because that of the set is."""
        return DatasetBuilder(_shard_configuration(self._configuration, k), self._path / shard_name(k), alone=False)

    def plan(self) -> tuple[int, int]:
        """Return the numbers of contacts and of samples that are still to be made, in all shards.

        Raises:
            TactipError: A shard's folder cannot be written to, or holds something else.
        """
        contacts = samples = 0
        for k in range(0 if self.finished else shard_count(self._configuration)):
            part = _shard_configuration(self._configuration, k)
            if not (self._path / shard_name(k)).exists():
                contacts, samples = contacts + len(contact_numbers(part)), samples + part.samples
                continue
            with self._shard(k) as shard:
                own = shard.plan()
                if shard.finished:
                    self._finished_shards.add(k)
                elif own[0] == 0:
                    self._all_made.append(k)
                elif own[0] < len(contact_numbers(part)):
                    self._partly_done[k] = np.array(shard.missing(), np.int32)
            contacts, samples = contacts + own[0], samples + own[1]
        return contacts, samples

    def missing(self) -> Iterator[int]:
        """Yield the numbers of the contacts of all shards that are still to be made, after `plan`.

        A shard's folder is prepared before its first contact is yielded. Raises TactipError as `plan` does.
        """
        for k in range(0 if self.finished else shard_count(self._configuration)):
            if k in self._finished_shards or k in self._all_made:
                continue
            with self._shard(k) as shard:
                known = self._partly_done.pop(k, None)
                shard.set_missing(contact_numbers(_shard_configuration(self._configuration, k)) if known is None else known)
                self._open_shards[k] = shard
                yield from shard.missing()

    def done(self, number: int, cost: tuple[float, float], workers: int, seconds: float) -> list[ShardFinalizer]:
        """Note that a contact is made, as DatasetBuilder does; return the end of its shard if it was the last."""
        self._costs.add(*cost)
        k = shard_index(self._configuration, number)
        run_json = self._open_shards[k].last(number, cost, workers, seconds)
        return [ShardFinalizer(k, run_json)] if run_json else []

    def mark_shard_finished(self, shard: int) -> None:
        """Note that a worker has finished a shard."""
        del self._open_shards[shard]

    def finish(self, workers: int, seconds: float) -> dict[str, Any]:
        """Finish the set, as DatasetBuilder does, and before it the shards that an earlier command left unfinished."""
        for k in self._all_made:
            with self._shard(k) as shard:
                shard.finish(workers, seconds)
        return super().finish(workers, seconds)

    def assemble(self, run_json: bytes) -> dict[str, int]:
        """Write the manifest, once all shards are finished, as DatasetBuilder writes the tables; return the counts."""
        samples, sums, names = {"asked": 0, "kept": 0, "failed": 0}, {}, []
        for k in range(shard_count(self._configuration)):
            path = self._path / shard_name(k) / "meta.json"
            data = read_file(path)
            own = parse_meta(data, path)["samples"]
            samples = {key: samples[key] + own[key] for key in samples}
            sums[f"{shard_name(k)}/meta.json"] = checksum(data)
            names.append(shard_name(k))
        write_file(self._path / "run.json", run_json)
        write_file(self._path / "meta.json", meta_json(self._configuration, samples, sums, {"shards": names}))
        shutil.rmtree(self._partial)
        return samples
