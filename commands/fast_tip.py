"""tactip fast-tip: teach a tip that predicts contacts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus, to_stderr
from tactip_twin.learning.fast_tip_settings import FastTipSettings


@dataclass(frozen=True)
class FastTip(Command):
    """Teach a tip that predicts contacts, for `tactip dataset make --fidelity fast`. Rerun to resume."""

    common = ("train", "val", "out", "init_from", "settings.steps", "settings.members", "threads")
    example = "tactip fast-tip data/surface/train --val data/surface/val --out runs/fast-tip"

    train: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the training sets, of one task and tip, made with --keep-mesh. The ranges of the first are those in which
    predictions are trusted."""
    val: Path
    """Folder of the validation set, made with --keep-mesh."""
    out: Path
    """Folder of the training; fast_tip.npz in it is the learned tip."""
    init_from: Path | None = None
    """Learned tip with the initial weights, such as a shipped one (assets/fast_tips/): a tip of the same task and shape, and
    of any materials, whose modes and layers then replace those of the settings. Default: random weights."""
    threads: int | None = None
    """Number of threads, at most one per core. Default: one per core."""
    settings: Annotated[FastTipSettings, tyro.conf.arg(name="")] = field(default_factory=FastTipSettings)
    """Settings of the training."""

    def run(self) -> int:
        with DelayedStatus("reading the sets"):
            from tactip_twin.learning.device import set_threads
            from tactip_twin.learning.fast_tip_training import FAST_TIP, train_fast_tip
            from tactip_twin.sim.fast_tip.fast_tip import read_fast_tip

            set_threads(self.threads)
            start = read_fast_tip(self.init_from) if self.init_from else None
        tip = train_fast_tip(self.train, self.val, self.settings, self.out, to_stderr, init_from=start)
        e = tip.provenance["errors"]
        print(
            f"{self.out / FAST_TIP} written: pins {e['pins_mm']:.3f} mm and force {e['force']:.1%} from the simulation on "
            f"validation contacts; {e['trusted']:.0%} of them trusted"
        )
        return 0
