"""A seeded fuzzer: whatever is done to a file, readers refuse it in one sentence, or their result is unchanged."""

import shutil
import time

import numpy as np
import pytest

from helpers.damage import damage
from helpers.file_kinds import KINDS, write_kinds
from helpers.memory import MIB, Peak, memory_limit
from tactip_twin.tactip_model.errors import TactipError

QUICK, SLOW = 480, 10_000

MAX_SECONDS, MAX_MIB = 10, 2048


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """One folder of each kind of file that commands read."""
    return write_kinds(tmp_path_factory.mktemp("originals"))


@pytest.fixture(scope="module")
def expected(originals):
    """What is read of each kind, where checksums protect it."""
    return {name: kind.read(originals / name, originals) for name, kind in KINDS.items()}


def mutated_is_refused_or_unchanged(originals, expected, place, name, seed):
    """Damage one file of a kind and assert what its reader does; return whether it was refused, and the peak memory, MiB."""
    rng = np.random.default_rng((seed, sorted(KINDS).index(name)))
    shutil.rmtree(place, ignore_errors=True)
    folder = place / "copy"
    shutil.copytree(originals / name, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in ("run.json", ".lock"))
    path = files[int(rng.integers(len(files)))]
    damage(path, rng)
    before = sorted(folder.rglob("*"))
    start, refused, result = time.monotonic(), False, None
    with Peak() as peak, memory_limit(MAX_MIB * MIB):
        try:
            result = KINDS[name].read(folder, originals)
        except TactipError as error:
            assert str(error)
            assert "\n" not in str(error).strip()
            refused = True
    assert time.monotonic() - start < MAX_SECONDS
    assert peak.mib < MAX_MIB
    assert sorted(folder.rglob("*")) == before
    if not refused:
        assert result == expected[name], f"{path.name}: another result without an error"
    return refused, peak.mib


def run(originals, expected, place, name, seeds):
    """Make a mutation for each seed; print how many were refused, and the greatest peak of the memory."""
    results = [mutated_is_refused_or_unchanged(originals, expected, place, name, seed) for seed in seeds]
    refused = sum(one for one, _ in results)
    print(f"{name}: {len(results)} mutations, {refused} refused; at most {max(mib for _, mib in results):.0f} MiB more")


@pytest.mark.parametrize("name", KINDS)
def test_mutated_file_is_refused_or_read_unchanged(originals, expected, tmp_path, name):
    run(originals, expected, tmp_path / "place", name, range(QUICK // len(KINDS)))


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_many_mutated_files_are_refused_or_read_unchanged(originals, expected, tmp_path, name):
    run(originals, expected, tmp_path / "place", name, range(QUICK, QUICK + SLOW // len(KINDS)))


def test_memory_limit_and_peak_see_large_arrays():
    """Without this, a reader that takes too much memory would pass."""
    with Peak() as peak, memory_limit(MAX_MIB * MIB):
        array = np.ones(256 * MIB // 8)
        with pytest.raises(MemoryError):
            np.ones(MAX_MIB * MIB // 8)
    assert array.all() and 250 < peak.mib < 300
