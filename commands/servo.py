"""tactip servo: follow an object by touch."""

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tactip_twin.commands._parsing import Command
from tactip_twin.commands._progress import DelayedStatus
from tactip_twin.control.options import ServoOptions

if TYPE_CHECKING:
    from tactip_twin.control.sensed_tip import Step


@dataclass(frozen=True)
class Servo(ServoOptions, Command):
    """Follow a surface or an edge by touch, with the soft tip on an arm. Writes a recording, a score and a figure."""

    common = ("task", "object", "out", "model", "depth_mm", "fidelity", "arm", "video", "route.kind", "route.length_mm",
              "settings.step_mm", "seed")  # fmt: skip
    example = "tactip servo --task edge --object rim-round --out runs/rim"

    json: bool = False
    """Print the score as one JSON object and nothing else."""

    def run(self) -> int:
        from json import dumps

        from tqdm import tqdm

        bars, waiting = [], DelayedStatus("loading the object, the network and the arm")

        def progress(step: "Step") -> None:
            waiting.cancel()
            if not bars:  # the bar is shown at the first step, so an earlier error prints one line only
                bars.append(tqdm(unit="step", file=sys.stderr, mininterval=0.5 if sys.stderr.isatty() else 15))
            bars[0].set_postfix_str(f"{step.phase}, {1e3 * abs(float(step.estimate.label[2])):.1f} mm deep", refresh=False)
            bars[0].update()

        try:
            with waiting:
                from tactip_twin.control.score import summary
                from tactip_twin.control.servo_run import FIGURE, SCORE, run_servo

                score = run_servo(self, progress, log=(lambda line: None) if self.json else print)
        finally:
            for bar in bars:
                bar.close()
        # A run that never followed anything has failed, whatever it recorded.
        status = 0 if score["depth_mae_mm"] is not None else 1
        if self.json:
            print(dumps(score))
            return status
        print("\n".join(summary(score)))
        print(f"{self.out / SCORE}{f' and {self.out / FIGURE}' if self.renderer != 'raster' else ''} written")
        return status
