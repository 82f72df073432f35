"""tactip import: a set of a real sensor in the project's format."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command, last_value
from tactip_twin.sim2real.importing.column_map import ColumnMap
from tactip_twin.sim2real.importing.layout import Layout, read_layout
from tactip_twin.sim2real.sensor.preprocessing_options import ImagePreprocessing


@dataclass(frozen=True)
class Import(Command):
    """Bring a set of a real sensor, published or your own, into the project's format, and picture what was made of it."""

    source: tyro.conf.Positional[Path]
    """Folder of the set: a table, frames (or films) in it or in images/, frames/ or videos/, and a neutral image init* or
    neutral* if there is one."""
    out: Path
    """Folder to write."""
    targets: Path | None = None
    """The table of poses; if not given, SOURCE/targets.csv, or the only table there is."""
    neutral: Path | None = None
    """Image of the undeformed tip. If there is none, the middle of the shallowest frames stands for it."""
    layout: Path | None = None
    """JSON file of the options below; those that are given beside it come before its."""
    column_map: Annotated[ColumnMap, tyro.conf.arg(name="")] = field(default_factory=ColumnMap)
    """What the set's columns mean."""
    preprocessing: Annotated[ImagePreprocessing, tyro.conf.arg(name="")] = field(default_factory=ImagePreprocessing)
    """What the set's frames are like."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Import":
        """Return the defaults: those of --layout's file, where it is given."""
        file = last_value(arguments, "layout")
        layout = Layout() if file is None else read_layout(file)
        missing = tyro.MISSING
        return cls(source=missing, out=missing, column_map=layout.column_map, preprocessing=layout.preprocessing)

    def run(self) -> int:
        from tactip_twin.sim2real.importing.import_set import PICTURE, import_set
        from tactip_twin.sim2real.importing.report import report_lines
        from tactip_twin.sim2real.importing.source import read_source

        layout = Layout(self.column_map, self.preprocessing)
        source = read_source(self.source, layout.column_map, self.targets, self.neutral)
        report = import_set(source, layout, self.out)
        for line in report_lines(report):
            print(line)
        print(f"{self.out} written; look at {self.out / PICTURE}")
        return 0
