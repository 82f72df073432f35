"""tactip tune: a search for a network."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.configuration import DeviceName, TuneSettings
from tactip_twin.tactip_model.errors import TactipError


@dataclass(frozen=True)
class Tune(Command):
    """Search for network hyperparameters by TPE; each trial is one training. Rerun to resume."""

    common = ("data", "out", "settings.trials", "settings.space.max_filters", "jobs", "device")
    example = "tactip tune --data data/surface --out runs/tune-surface --trials 50 --max-filters 64"

    data: Path
    """Folder of a task's sets: DATA/train and DATA/val."""
    out: Path
    """Folder of the search."""
    jobs: int = 1
    """Number of simultaneous trainings."""
    cluster: str | None = None
    """Address of a Ray cluster (auto: this machine's; local: this machine alone). Needs the extra `cluster`."""
    device: DeviceName = "auto"
    """Device of the networks; auto: the GPU if there is one."""
    threads: int | None = None
    """Number of threads of each training, at most one per core. Default: the cores divided by --jobs."""
    settings: Annotated[TuneSettings, tyro.conf.arg(name="")] = field(default_factory=TuneSettings)
    """Search."""

    def run(self) -> int:
        with DelayedStatus("loading the libraries"):
            from tactip_twin.learning.device import device_named, set_threads
            from tactip_twin.learning.tune import tune

        device_named(self.device)
        set_threads(self.threads)
        if self.jobs < 1:
            raise TactipError(f"--jobs must be at least 1, got {self.jobs}")
        if self.cluster and self.threads is not None:
            raise TactipError("--threads does not apply to a cluster, where each trial has one core: leave it out")
        if self.cluster:
            from tactip_twin.learning.tune_ray import tune_on_cluster

            results = tune_on_cluster(self.data, self.out, self.settings, self.jobs, self.cluster, self.device)
        else:
            results = tune(self.data, self.out, self.settings, self.jobs, self.device, to_stderr, self.threads)
        good = [r for r in results if r["status"] == "ok"]
        print(f"{len(results)} trials, {len(good)} successful; {self.out / 'best.json'} and tune.png written")
        return 0
