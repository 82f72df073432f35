"""tactip protocol: the poses to record with a real sensor."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.sim2real.importing.protocol import ProtocolOptions, protocol_table
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.files import write_file


@dataclass(frozen=True)
class Protocol(Command):
    """Write the table of poses to record with a real sensor, which `tactip import` then reads beside the frames."""

    example = "tactip protocol --out recording/targets.csv --task surface --frames 300"

    out: Path
    """Table to write, CSV; targets.csv in the folder of the recording."""
    options: Annotated[ProtocolOptions, tyro.conf.arg(name="")] = field(default_factory=ProtocolOptions)
    """What to record."""

    def run(self) -> int:
        if self.out.exists():
            raise TactipError(f"{self.out} exists already: choose another name, so no recording loses its labels")
        data = protocol_table(self.options)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_file(self.out, data)
        print(
            f"{self.out} written: {self.options.frames} frames. Take a neutral image first (init_0.png). For each row: lift "
            "off, press at start_x … start_Rz, move in contact to pose_x … pose_Rz, wait until the tip is still, and save "
            "the frame in images/."
        )
        return 0
