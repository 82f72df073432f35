"""tactip protocol: the poses of a recording, for the program of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command, last_value
from tactip_twin.sim.dataset.sampling import POSE_RANGES
from tactip_twin.sim.labels import Task
from tactip_twin.sim2real.importing.protocol import Protocol


@dataclass(frozen=True)
class WriteProtocol(Command):
    """Write the poses of a recording with a real sensor. The table of the recording is the same file."""

    common = ("out", "task", "protocol.frames", "protocol.taps", "protocol.seed", "protocol.pose.depth_mm",
              "protocol.pose.roll_deg", "protocol.pose.pitch_deg", "protocol.shear.x_mm", "protocol.shear.y_mm")  # fmt: skip
    example = "tactip protocol --out lab/set/targets.csv"

    out: Path
    """Table to write (.csv); an existing file is not overwritten."""
    task: Task = "surface"
    """Stimulus: a flat surface or a straight edge."""
    protocol: Annotated[Protocol, tyro.conf.arg(name="")] = field(default_factory=Protocol)
    """Contents of the table."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> "WriteProtocol":
        """Return the defaults for a task."""
        task = "edge" if last_value(arguments, "task") == "edge" else "surface"
        return cls(out=tyro.MISSING, protocol=Protocol(pose=POSE_RANGES[task]))

    def run(self) -> int:
        from tactip_twin.sim2real.importing.protocol import protocol_table
        from tactip_twin.tactip_model.errors import TactipError
        from tactip_twin.tactip_model.files import write_file

        if self.out.exists():
            raise TactipError(f"{self.out} exists and is not overwritten: give another --out")
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_file(self.out, protocol_table(self.protocol))
        print(
            f"{self.out} written: {self.protocol.frames} contacts, the first {self.protocol.taps} upright and without shear"
        )
        return 0
