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
    """Import a published or your own data set of a real sensor. A picture shows the result."""

    common = ("source", "out", "find", "neutral", "layout", "column_map.task", "column_map.columns",
              "column_map.camera_rotation_deg", "column_map.tcp_behind_apex_mm", "preprocessing.crop",
              "preprocessing.threshold")  # fmt: skip
    example = "tactip import lab/set --out data/real --columns pose_z=-depth pose_Rx=roll pose_Ry=pitch"

    source: tyro.conf.Positional[Path]
    """Folder of the set: a table, frames or videos (here or in a folder images, frames, frames_bw, sensor_images,
    processed_images or videos) and perhaps a neutral image init*, neutral* or image_0, here or beside the frames."""
    out: Path
    """Folder of the imported set."""
    targets: Path | None = None
    """Table of poses. Default: targets.csv, targets_images.csv or targets_video.csv in the folder, or its only table."""
    neutral: Path | None = None
    """Image of the undeformed tip. Default: init*, neutral* or image_0 in the folder or beside the frames, if the table does
    not name it; without one, the frames whose pins have moved least replace it."""
    find: bool = False
    """Find which columns are which, their signs, the camera's rotation, the zero of depth and the tool centre by holding the
    frames against simulated contacts. Options that are given are kept and checked. Of an edge, give --task edge."""
    layout: Path | None = None
    """JSON file of the options below; options on the command line override the file."""
    column_map: Annotated[ColumnMap, tyro.conf.arg(name="")] = field(default_factory=ColumnMap)
    """Meaning of the table's columns."""
    preprocessing: Annotated[ImagePreprocessing, tyro.conf.arg(name="")] = field(default_factory=ImagePreprocessing)
    """Preprocessing of the frames."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "Import":
        """Return the defaults, from the file of --layout if it is given."""
        file = last_value(arguments, "layout")
        layout = Layout() if file is None else read_layout(file)
        missing = tyro.MISSING
        return cls(source=missing, out=missing, column_map=layout.column_map, preprocessing=layout.preprocessing)

    def run(self) -> int:
        from tactip_twin.sim2real.importing.import_set import PICTURE, import_set
        from tactip_twin.sim2real.importing.report import report_lines
        from tactip_twin.sim2real.importing.source import read_recording, with_labels

        layout, found = Layout(self.column_map, self.preprocessing), None
        recording = read_recording(self.source, layout.column_map, self.targets, self.neutral)
        if self.find:
            from tactip_twin.sim2real.importing.find_layout import find_layout

            found = find_layout(recording, layout)
            layout = found.layout
            print(*found.evidence, sep="\n")
            print(f"found: {found.options()}")
            recording = read_recording(self.source, layout.column_map, self.targets, self.neutral)
        report = import_set(with_labels(recording, layout.column_map), layout, self.out)
        if found:
            print(f"check the picture of measured and simulated pins, {found.write_picture(self.out)}")
        for line in report_lines(report):
            print(line)
        print(f"{self.out} written; check the picture {self.out / PICTURE}")
        return 0
