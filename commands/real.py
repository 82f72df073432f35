"""tactip import and transfer: sets of real sensors, and what a network of simulation makes of them."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from learning.transfer_settings import TransferSettings
from sim.layout import Layout


@dataclass(frozen=True)
class Import:
    """Bring a set of a real sensor, published or your own, into the project's format, and picture what was made of it."""

    source: tyro.conf.Positional[Path]
    """Folder of the set: a table, frames in it or in images/ or frames/, and a neutral image init* or neutral* if there is
    one."""
    out: Path
    """Folder to write."""
    targets: Path | None = None
    """The table of poses; SOURCE/targets.csv if not given."""
    neutral: Path | None = None
    """Image of the undeformed tip."""
    layout: Path | None = None
    """JSON file of the options below; those that are given beside it come before its."""
    told: Annotated[Layout, tyro.conf.arg(name="")] = field(default_factory=Layout)

    def run(self):
        from sim.importing import PICTURE, import_set, read_source, report_lines

        layout = self._layout()
        source = read_source(self.source, layout, self.targets, self.neutral)
        report = import_set(source, layout, self.out)
        for line in report_lines(report):
            print(line)
        print(f"{self.out} written; look at {self.out / PICTURE}")
        return 0

    def _layout(self):
        from dataclasses import fields, replace

        from sim.layout import read_layout

        if self.layout is None:
            return self.told
        plain = Layout()
        given = {f.name: getattr(self.told, f.name) for f in fields(Layout)}
        return replace(read_layout(self.layout), **{k: v for k, v in given.items() if v != getattr(plain, k)})


@dataclass(frozen=True)
class Transfer:
    """From simulation to a real sensor: train on simulated contacts of its twin, test on its frames. Run again, it goes on
    where it stopped."""

    experiment: tyro.conf.Positional[str]
    """zero-shot (no real label is used) or few-shot."""
    real: Path
    """Folder of an imported set (tactip import)."""
    out: Path
    """Folder for sets, networks, results.json and results.md."""
    json: bool = False
    """Print the results, as JSON, in the place of words."""
    workers: str = "auto"
    """Worker processes that make contacts; auto is one a core."""
    device: str = "auto"
    """auto, cpu or cuda."""
    settings: Annotated[TransferSettings, tyro.conf.arg(name="")] = field(default_factory=TransferSettings)

    def run(self):
        from json import dumps

        from learning.transfer import EXPERIMENTS, Experiment
        from learning.transfer_page import PAGE, write_page
        from tactip_model.errors import choose

        run = choose("experiment", self.experiment, EXPERIMENTS)
        say = (lambda line: print(line, file=sys.stderr)) if self.json else print
        experiment = Experiment(self.real, self.out, self.settings, self.workers, self.device, say)
        results = run(experiment)
        record = experiment.keep(self.experiment, results)
        write_page(record, experiment.task, self.out)
        print(dumps(results) if self.json else f"{self.out / PAGE} written")
        return 0
