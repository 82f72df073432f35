"""tactip sliding-tip: teach a tip that predicts sliding contacts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.sliding_tip_settings import SlidingTipSettings


@dataclass(frozen=True)
class SlidingTip(Command):
    """Teach a tip that predicts how the skin slides, for `tactip servo --fidelity fast`. Rerun to resume."""

    common = ("train", "val", "out", "settings.steps", "settings.members", "threads")
    example = "tactip sliding-tip data/slides/train --val data/slides/val --out runs/sliding-tip"

    train: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the training sets, of one task and tip, made with --snapshots-per-contact and --keep-mesh."""
    val: tuple[Path, ...]
    """Folders of the validation sets, made likewise."""
    out: Path
    """Folder of the training; sliding_tip.npz in it is the learned tip."""
    threads: int | None = None
    """Number of threads, at most one per core. Default: one per core."""
    settings: Annotated[SlidingTipSettings, tyro.conf.arg(name="")] = field(default_factory=SlidingTipSettings)
    """Settings of the training."""

    def run(self) -> int:
        with DelayedStatus("reading the sets"):
            from tactip_twin.learning.device import set_threads
            from tactip_twin.learning.sliding_tip_training import SLIDING_TIP, train_sliding_tip

            set_threads(self.threads)
        tip = train_sliding_tip(self.train, self.val, self.settings, self.out, to_stderr)
        e = tip.provenance["errors"]
        print(
            f"{self.out / SLIDING_TIP} written: on validation paths, pins {e['touch_mm']:.3f} mm after touching down and "
            f"{e['slide_mm']:.3f} mm while sliding, force {e['force']:.1%} from the simulation; {e['trusted']:.0%} of the "
            "steps trusted"
        )
        return 0
