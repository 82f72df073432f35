"""tactip transfer: networks that are trained in simulation, tested on a real sensor."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.configuration import DeviceName
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.transfer.settings import PseudoKind, TransferSettings


@dataclass(frozen=True)
class Transfer(Command):
    """Train networks on simulated contacts of a real sensor's twin, and test them on its frames. Rerun to resume."""

    common = ("experiment", "real", "out", "settings.contacts", "settings.design", "workers", "device")
    example = "tactip transfer zero-shot --real data/real --out runs/transfer"

    experiment: tyro.conf.Positional[Literal["zero-shot", "ablate", "few-shot", "gap", "pseudo-real"]]
    """Experiment: zero-shot (no real labels), ablate (one part of the simulation left out at a time), few-shot (correction
    by some real labels), gap (pins and images compared), or pseudo-real (all of these but ablate, on a hidden simulated
    sensor instead of a real one)."""
    out: Path
    """Folder for sets, networks, results.json and results.md."""
    real: Path | None = None
    """Folder of an imported set (tactip import). Not for pseudo-real, which makes its own."""
    task: Task = "surface"
    """Task of the set that pseudo-real makes."""
    pseudo_design: PseudoKind = "nominal-127"
    """Nominal design of the hidden sensor in pseudo-real."""
    frames: int = 2500
    """Number of frames of the set that pseudo-real makes."""
    json: bool = False
    """Print the results as JSON instead of text."""
    workers: str = "auto"
    """Number of worker processes that simulate contacts; auto: one per core."""
    device: DeviceName = "auto"
    """Device of the network; auto: the GPU if there is one."""
    threads: int | None = None
    """Number of threads of the network, at most one per core. Default: one per core."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)
    """Settings of the experiments."""

    def run(self) -> int:
        from json import dumps

        with DelayedStatus("loading the libraries"):
            from tactip_twin.learning.device import set_threads
            from tactip_twin.sim2real.transfer.experiments import EXPERIMENTS, Experiment
            from tactip_twin.sim2real.transfer.page import PAGE, write_page

        set_threads(self.threads)
        log = to_stderr if self.json else print
        pseudo = self.experiment == "pseudo-real"
        names = ("zero-shot", "gap", "few-shot") if pseudo else (self.experiment,)
        with DelayedStatus("reading the real set and its design"):
            experiment = Experiment(self._real_set(log), self.out, self.settings, self.workers, self.device, log)
        results = {}
        for name in names:
            results[name] = EXPERIMENTS[name](experiment)
            write_page(experiment.keep(name, results[name]), experiment.task, self.out)
        print(dumps(results if pseudo else results[self.experiment]) if self.json else f"{self.out / PAGE} written")
        return 0

    def _real_set(self, log: Callable[[str], None]) -> Path:
        """Return the folder of the real set, or make the set of a hidden sensor and return its folder."""
        from tactip_twin.sim.parallel.worker_pool import worker_count
        from tactip_twin.sim2real.transfer.pseudo_real import make_pseudo_real
        from tactip_twin.tactip_model.errors import TactipError

        if self.experiment == "pseudo-real":
            if self.real is not None:
                raise TactipError(f"pseudo-real makes its own set: leave out --real {self.real}")
            seed, workers = self.settings.seed, worker_count(self.workers)
            return make_pseudo_real(self.out / "hidden", self.task, self.pseudo_design, self.frames, seed, workers, log)
        if self.real is None:
            raise TactipError(f"{self.experiment} needs the folder of an imported set: add --real FOLDER")
        return self.real
